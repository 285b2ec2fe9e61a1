"""The engine's parts fit together: responses by name, protocols, and nothing that hangs on an order of calls."""

from __future__ import annotations

import typing

from drgs import reference, settings
from drgs.tracing.responses import RESPONSES


def test_responses_are_known_by_the_same_names():
    """Settings, engine and oracle have the same responses."""
    names = typing.get_args(typing.get_type_hints(settings.RenderSettings)["response"])
    assert tuple(RESPONSES) == names == tuple(reference._FORMS)
    assert {name for name in names if settings.RenderSettings(response=name).planar} == set(settings._PLANAR)
