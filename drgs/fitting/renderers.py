"""Which renderers a fit must look right in: a preset a step, taken in turn.

Gaussians that are fitted with one renderer alone fit its approximations, too: what another one shows of them may be
several dB worse, where they are large and near above all, whose order the renderers disagree about. Gaussians that have
met each of them agree with all. The preset of a step depends on its number alone, so that a resumed fit has the same
ones; views come in another random order every epoch, so that each view meets every renderer,
whatever their number is. Imports nothing heavy: options are checked here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from drgs.settings import PRESETS, Preset, RenderSettings

AUTO = ("auto",)
"""`any`; where a fit has other settings than those of preset `fast`, these alone."""
ANY: tuple[Preset, ...] = ("exact", "fast", "inria", "gsplat", "3dgut")
"""The presets that a fit is measured with where nothing else is said."""
VIEWERS: Preset = "gsplat"
"""The preset that viewers of PLY files draw with."""

_MEANINGS: dict[str, tuple[Preset, ...]] = {"any": ANY, "drgs": ("exact", "fast"), "viewers": ("gsplat", "inria")}
# Of steps with `exact` among other renderers, in units of colors: gradients are within 1 % (docs/tradeoff.md), in about
# half of the time, of which steps without a tolerance take up to 0.6 (docs/one-model.md).
_TOLERANCE = 0.01

# Name -> presets in turn. `exact` takes three to six times as long as the others, so that one step of ten makes a fit
# 1.2 to 1.4 times as long as one with `fast` alone.
# `inria` differs from `gsplat` in cut-offs only, and looks right where that does.
_CYCLES: dict[str, tuple[Preset, ...]] = {
    "any": (*("gsplat", "fast", "3dgut") * 3, "exact"),
    "drgs": ("fast", "fast", "fast", "exact"),
    "viewers": ("gsplat", "inria"),
}


def check_renderers(names: Sequence[str], settings: RenderSettings) -> None:
    """Raise ValueError unless names and settings are of one fit.

    Args:
        names: Presets, each once, or one of `auto`, `any`, `drgs` and `viewers`.
        settings: The fit's own: those of a single renderer, or a preset's, but for the background, beside several.
    """
    _check_names(names)
    if tuple(names) == AUTO:
        return
    got = ",".join(names)
    nearest, differences = settings.nearest_preset()
    if _is_single(names):
        if nearest != names[0] and not differences:
            raise ValueError(
                f"fit: renderers {got} must have the settings of that preset, got those of {nearest}; leave one of the "
                f"two out, or say preset {got}"
            )
    elif differences:
        field, value = next(iter(differences.items()))
        raise ValueError(
            f"fit: renderers {got} must have the settings of presets, got {field}={value}; name a single renderer, or "
            f"leave {field} as it is"
        )


def named_renderers(names: Sequence[str], settings: RenderSettings) -> tuple[str, ...]:
    """The names that a fit's `renderers` and settings mean: without `auto`, and of a single renderer the nearest
    preset's.
    """
    if tuple(names) == AUTO and settings.nearest_preset() == ("fast", {}):
        return ("any",)
    if tuple(names) == AUTO or _is_single(names):
        return (settings.nearest_preset()[0],)
    return tuple(names)


def own_preset(names: Sequence[str]) -> str:
    """The preset of a fit's own pictures and numbers where nothing else is said: `fast`, or else the first.

    Raises:
        ValueError: As `check_renderers` does of names.
    """
    _check_names(names)
    meant = _MEANINGS["any"] if tuple(names) == AUTO else _MEANINGS.get(names[0], tuple(names))
    return "fast" if "fast" in meant else meant[0]


def planar_of(names: Sequence[str], settings: RenderSettings) -> list[str]:
    """The presets among what a fit's `renderers` and settings mean that are models of a pinhole's image plane."""
    named = named_renderers(names, settings)
    meant = _MEANINGS.get(named[0], named)
    drawn = [name for name in meant if RenderSettings.preset(name).planar]
    return drawn or [settings.response] * settings.planar


def renderers_to_measure(
    names: Sequence[str], settings: RenderSettings, wanted_preset: str | None = None, lenses: bool = False
) -> dict:
    """Name -> settings of the renderers that a fit is measured with, beside its own.

    Args:
        names: The fit's `renderers`.
        settings: Its own settings; all have their background.
        wanted_preset: A preset, or `all`; None: those that the fit is for, and what viewers draw with.
        lenses: Photographs have lenses: without models of a pinhole's image plane, unless it is `wanted_preset`.
    """
    background = settings.background
    if wanted_preset is None:
        named = named_renderers(names, settings)
        wanted = () if _is_single(named) else _MEANINGS.get(named[0], named)
        wanted = tuple(dict.fromkeys([*wanted, VIEWERS]))
    else:
        wanted = ANY if wanted_preset == "all" else (wanted_preset,)
    found = {name: RenderSettings.preset(name, background=background) for name in wanted}
    if lenses and wanted_preset in (None, "all"):
        found = {name: x for name, x in found.items() if not x.planar}
    if settings in found.values():
        return found
    name, differences = settings.nearest_preset()
    return {" ".join([name, *(f"{field}={value}" for field, value in differences.items())]): settings, **found}


@dataclasses.dataclass(frozen=True)
class RendererSchedule:
    """What each step of a fit is rendered with: `cycle`, settings taken in turn."""

    cycle: tuple[RenderSettings, ...]

    @classmethod
    def of(cls, names: Sequence[str], settings: RenderSettings) -> RendererSchedule:
        """That of a fit.

        Args:
            names: Its `renderers`, as `check_renderers` takes them.
            settings: Its own: all there is with a single renderer, else only their background counts.
        """
        named = named_renderers(names, settings)
        if _is_single(named):
            return cls((settings,))
        # `exact` has a tolerance where it takes turns with others.
        fields = {"exact": {"tolerance": _TOLERANCE}}
        cycle = _CYCLES.get(named[0], named)
        return cls(tuple(RenderSettings.preset(x, background=settings.background, **fields.get(x, {})) for x in cycle))

    def settings_at(self, step: int) -> RenderSettings:
        """The settings that a step, from 0 on, is rendered with."""
        return self.cycle[step % len(self.cycle)]

    @property
    def all_settings(self) -> tuple[RenderSettings, ...]:
        """All settings of its steps, each once, in the order of their first turn."""
        return tuple(dict.fromkeys(self.cycle))


def _is_single(names: Sequence[str]) -> bool:
    """Whether names, none of them `auto`, mean one renderer."""
    return len(names) == 1 and names[0] in PRESETS


def _check_names(names: Sequence[str]) -> None:
    """Raise ValueError unless these are presets, each once, or one name of several."""
    groups = (*AUTO, *_MEANINGS)
    if unknown := [name for name in names if name not in (*groups, *PRESETS)]:
        raise ValueError(
            f"fit: renderers must be one of {', '.join(groups)}, or of {', '.join(PRESETS)}, got {unknown[0]!r}"
        )
    if not names or len(set(names)) < len(names) or (len(names) > 1 and set(names) & set(groups)):
        raise ValueError(
            f"fit: renderers must be one of {', '.join(groups)}, or presets, each once, got {','.join(names) or 'none'}"
        )
