"""The Mitsuba scene of a play, in which nothing shines: tables of glossy materials take seconds."""

import pytest

from drgs import scenes
from drgs.scenes import filmed


def plain_stage(play):
    """That of seed 0."""
    material = scenes.material
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "material", lambda bsdf, *rest: material({"type": "diffuse"}, *rest))
        return filmed.Stage(play, 0)
