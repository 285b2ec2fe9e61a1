"""Which paths of a rasterizer were tested: a row a path, with what was said of it or why it was not tested.

A rasterizer has more ways to an image than the one that is compared view by view: depths, several cameras in a call,
packed arrays, a lens. Each has code of its own, where a gradient can be lost although that of the colors is right. Two
kinds of comparison:

- with the model, as colors are (verdicts.py): depth, hit distances, antialiasing, alpha, wide channels, lenses;
- with the rasterizer itself, whose single view the model has confirmed: several cameras, batches, packed arrays,
  culled Gaussians in front, the near plane, SH of lower degree and backgrounds must give the images and gradients of
  plain calls that amount to the same.

A path that raises is refused by the rasterizer and is not tested; one that draws another image, or has another
gradient, is wrong.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal

import torch

from drgs.cameras import Camera
from drgs.integrator import render
from drgs.lab.conventions import ReferenceModel
from drgs.lab.parameters import BACKGROUNDS, COLORS, MOTIONS, POSE, depth_of, gaussians_of, posed
from drgs.lab.rasterizers import Dump, Rasterizer, cotangents, one_line
from drgs.lab.verdicts import VERDICTS, Case, Compared, GroupRow, compared, gradient_row, judge
from drgs.oracle import float64

Status = Literal["agrees", "wrong", "not tested"]

_SEVERAL = "several cameras in a call"
PATHS = (
    "pinhole",
    "lens",
    "rolling shutter",
    "depth RGB+D",
    "depth RGB+ED",
    "hit distance d",
    "hit distance Ed",
    "SH by degree",
    "backgrounds",
    _SEVERAL,
    "batches",
    "packed",
    "culled Gaussians in front",
    "near plane",
    "antialiasing",
    "gradient of alpha",
    "wide channels",
)
_DEPTHS = {"depth RGB+D": "RGB+D", "depth RGB+ED": "RGB+ED", "hit distance d": "d", "hit distance Ed": "Ed"}
_SAME = 1e-4  # RMS of two images that one rasterizer draws of the same scene: float32 sums in another order
_FAINT = 0.02  # alpha below which an expected depth, divided by it, is rounding
_EPS = 1e-10  # alpha that expected depths are divided by at least, as gsplat does
_CULLED = 3  # Gaussians behind the camera that are put in front of the others in the list
_GROWN = 0.1  # log of the factor by which the Gaussians of a second batch are larger
_APART = 0.02  # radians and median depths by which a second camera is moved

Drawn = tuple[torch.Tensor, torch.Tensor]
"""Image and alpha."""
Draw = Callable[[dict, Camera, tuple], Drawn]


@dataclasses.dataclass(frozen=True)
class PathRow:
    """What is known of one path.

    Attributes:
        path: One of `PATHS`.
        status: `agrees`, `wrong` or `not tested`.
        why: What is wrong, why it was not tested, or what the agreement is of.
        how: Command that would test it, or what the rasterizer needs for that; empty of what was tested.
        verdict: One of `crossval.VERDICTS`, None of what was not tested.
    """

    path: str
    status: Status
    why: str = ""
    how: str = ""
    verdict: str | None = None

    def line(self) -> str:
        """The row in one line."""
        return ": ".join(x for x in (self.path, self.status, self.why) if x)


def status_of(verdict: str) -> Status:
    """The status of a path that has this verdict."""
    if verdict == "undecided":
        return "not tested"
    return "wrong" if verdict in ("gradient bug", "model difference") else "agrees"


def _judged(path: str, verdict: str, why: str = "") -> PathRow:
    if verdict == "undecided":
        return PathRow(path, "not tested", why or "undecided", "drgs crossval with other views")
    return PathRow(path, status_of(verdict), why, "", verdict)


class _NotTested(Exception):
    """Why a path is not tested, and what would test it."""


def path_rows(
    case: Case,
    model: ReferenceModel,
    rgb: Compared,
    verdict: str,
    not_wide: str,
    lens: PathRow | None = None,
) -> list[PathRow]:
    """A row for each of `PATHS`.

    Args:
        case: What was compared in RGB.
        model: The model at the conventions that were found.
        rgb: The comparison in RGB, with the rows of an image of many channels.
        verdict: Its verdict.
        not_wide: Why `rgb` has no rows of an image of many channels.
        lens: Row of the lens, where it was compared apart from `case`, whose cameras are pinholes.
    """
    tests = _Tests(case, model, rgb)
    rows = [*_camera_rows(case, verdict, lens)]
    for path in PATHS[len(rows) : -1]:
        case.say(f"path: {path}")
        rows.append(tests.row(path))
    wide = {name: row for name, row in rgb.groups.items() if name == COLORS or name.endswith("channels")}
    if not_wide or not wide:
        rows.append(PathRow(PATHS[-1], "not tested", not_wide or "not asked for", "a function of (N, D) colors"))
    else:
        rows.append(_worst(PATHS[-1], wide))
    return rows


def _camera_rows(case: Case, verdict: str, lens: PathRow | None) -> Iterator[PathRow]:
    """Pinhole, lens and shutter: what was compared in RGB, by its cameras."""
    command = f"drgs crossval SCENE --cameras DATA --preset 3dgut --rasterizer {case.rasterizer.name}"
    here = {
        "pinhole": any(not c.is_distorted and not c.is_rolling for c in case.cameras),
        "lens": any(c.is_distorted for c in case.cameras),
        "rolling shutter": any(c.is_rolling for c in case.cameras),
    }
    for path, is_here in here.items():
        if is_here and verdict == "model difference":
            # No fault: `drgs crossval` has always left another model, whose gradients are its own, to --strict.
            yield PathRow(
                path, "agrees", "its gradients are those of its image, which is of another model", "", verdict
            )
        elif is_here:
            yield _judged(path, verdict, "the groups say which gradients" if verdict == "gradient bug" else "")
        elif path == "lens" and lens is not None:
            yield lens
        else:
            why = "every camera has a lens or a shutter" if path == "pinhole" else "no camera has one"
            data = {"pinhole": "PINHOLES.json", "lens": "DATA_WITH_LENSES", "rolling shutter": "DATA_WITH_SHUTTERS"}
            yield PathRow(path, "not tested", why, command.replace("DATA", data[path]))


def _worst(path: str, groups: dict[str, GroupRow]) -> PathRow:
    """The row of a path of the rows of its groups."""
    names = sorted(groups, key=lambda name: VERDICTS.index(groups[name].verdict or "agreement"))
    worst = groups[names[0]]
    if worst.verdict == "agreement":
        return _judged(path, "agreement", f"gradients differ by {max(x.relative for x in groups.values()):.1g} at most")
    same = [name for name in names if groups[name].verdict == worst.verdict]
    return _judged(path, worst.verdict or "undecided", f"{', '.join(same)}: {worst.verdict}: {worst.why}")


@dataclasses.dataclass(frozen=True)
class _DepthModel(ReferenceModel):
    """A model whose image has the depth as its last channel, in units of `unit`; or the distance to the hits alone.

    Attributes:
        mode: gsplat's `render_mode`.
        unit: World units of a depth of 1.
    """

    mode: str = "RGB+D"
    unit: float = 1.0

    def _pieces(self, raw: dict, camera: Camera, oracle: bool) -> Iterator[tuple]:
        moved = self._camera(posed(raw, camera))
        if self.mode in ("d", "Ed"):
            g, _ = gaussians_of(self._parameters(raw, moved))
            out = render(g, moved, self.settings, outputs=("depth",))
            assert out.depth is not None  # asked for
            alpha = out.alpha.double()
            depth = out.depth.double() / self.unit * (alpha if self.mode == "d" else 1)
            yield (0, 0), depth[..., None], alpha
            return
        w2c = float64(moved.w2c)
        local = raw["means"] @ w2c[:3, :3].T + w2c[:3, 3]
        own = local[:, 2:] if self.settings.depth_key == "z" else local.norm(dim=1, keepdim=True)
        plain = {name: x for name, x in raw.items() if name != "sh"} | {COLORS: own / self.unit}
        pieces = ReferenceModel._pieces(self, raw, camera, oracle), ReferenceModel._pieces(self, plain, camera, oracle)
        for (corner, image, alpha), (_, depth, _) in zip(*pieces, strict=True):
            expected = depth / alpha[..., None].clamp_min(_EPS) if self.mode == "RGB+ED" else depth
            yield corner, torch.cat([image, expected], -1), alpha


@dataclasses.dataclass(frozen=True)
class _AlphaModel(ReferenceModel):
    """A model whose image is its alpha."""

    def _pieces(self, raw: dict, camera: Camera, oracle: bool) -> Iterator[tuple]:
        for corner, _, alpha in ReferenceModel._pieces(self, raw, camera, oracle):
            yield corner, alpha[..., None], alpha


@dataclasses.dataclass(frozen=True)
class _Tests:
    """The tests of paths; arguments of `path_rows`."""

    case: Case
    model: ReferenceModel
    rgb: Compared

    def row(self, path: str) -> PathRow:
        """The row of a path that has a test of its own."""
        test = {
            "SH by degree": self._degrees,
            "backgrounds": self._backgrounds,
            _SEVERAL: self._cameras,
            "batches": self._batches,
            "packed": self._packed,
            "culled Gaussians in front": self._culled,
            "near plane": self._near,
            "antialiasing": self._antialiased,
            "gradient of alpha": self._alpha,
        }.get(path, self._depth)
        try:
            if isinstance(self.case.rasterizer, Dump):
                raise _NotTested("a dump cannot be called again", "the function, on the machine that it runs on")
            if self.case.rasterizer.several is None:
                raise _NotTested(
                    "presets are drawn without gsplat's arguments",
                    "drgs crossval SCENE --rasterizer drgs.rasterize:rasterization",
                )
            if not self.rgb.agrees:
                raise _NotTested("its image of one view is of another model", "the same command, once that agrees")
            return test(path)
        except _NotTested as reason:
            return PathRow(path, "not tested", *reason.args)
        except Exception as error:  # whatever a function raises that does not know the path
            return self._failed(path, error)

    def _failed(self, path: str, error: Exception) -> PathRow:
        """What a path says that raises: it has no graph, returns another shape, or is refused."""
        text = one_line(error).removeprefix(f"--rasterizer {self.case.rasterizer.name}: ")
        if "has no graph" in text:
            return _judged(path, "gradient bug", "its image has no gradient")
        if "must have shape" in text and (path == _SEVERAL or self._names(path)):
            return _judged(path, "model difference", text)
        return PathRow(path, "not tested", f"refused: {text}", "the same command, once it takes that")

    def _names(self, path: str) -> bool:
        """Whether the signature names the argument of a path: who takes any argument may ignore this one."""
        return path in _DEPTHS and "render_mode" in self._own.named

    @property
    def _own(self) -> Rasterizer:
        assert isinstance(self.case.rasterizer, Rasterizer)  # `row` refuses dumps
        return self.case.rasterizer

    @property
    def _view(self) -> Camera:
        return self.case.cameras[self.case.first]

    def _called(
        self,
        raws: list[dict],
        cameras: list[Camera],
        backgrounds: list[tuple],
        changed: dict | None = None,
        channels: int = 3,
    ) -> Drawn:
        """Images of one call, below each other: (B C H, W, channels) and (B C H, W)."""
        assert self._own.several is not None  # `row` refuses what has none
        images, alphas = self._own.several(raws, cameras, backgrounds, changed or {}, channels)
        return images.flatten(0, 1), alphas.flatten(0, 1)

    def _with(self, **changed: Any) -> Draw:
        """A call of one view with arguments of its own."""
        return lambda raw, camera, background: self._called([raw], [camera], [background], changed)

    # ------------------------------------------------------------------------------------------ beside the model

    def _beside(self, path: str, draw: Draw, model: ReferenceModel, channels: int, least_alpha: float = 0) -> PathRow:
        """The verdict on one view's image of some other kind, as on its colors."""
        case = self.case
        rasterizer = dataclasses.replace(self._own, draw=draw)
        picture, alpha = rasterizer.image(case.raw, self._view, case.background)
        drawn = model.draw({k: x.detach() for k, x in case.raw.items()}, self._view, case.oracle)
        drawn = tuple(x.detach().cpu() for x in drawn)
        signs = cotangents([self._view], case.seed, channels) * (alpha >= least_alpha)[..., None]
        other = case.of_view(rasterizer=rasterizer)
        found = compared(other, model, signs, [picture], [alpha], [drawn])
        right = [k for k, row in self.rgb.groups.items() if row.verdict in ("agreement", "known deviation")]
        found.groups = {k: row for k, row in found.groups.items() if k in right}
        if not found.groups:
            raise _NotTested("no gradient of its colors is right", "the same command, once they are")
        judge(other, model, found)
        row = _worst(path, found.groups)
        if not found.agrees and row.verdict != "gradient bug":
            return _judged(path, "model difference", f"its image is not the model's: RMS {found.views[0].rms:.1e}")
        return row

    def _depth(self, path: str) -> PathRow:
        mode = _DEPTHS[path]
        camera, settings = self._view, self.model.settings
        hits = mode in ("d", "Ed")
        if hits and settings.planar:
            command = f"drgs crossval SCENE --preset 3dgut --rasterizer {self._own.name}"
            raise _NotTested("distances to hits are of Gaussians along rays", command)
        if camera.is_rolling:
            raise _NotTested("the view has a rolling shutter", "views that stand still")
        if self.model.channels != "rgb" or self.model.transfer != "none" or self.model._needs_oracle:
            raise _NotTested("its conventions have no depth in the model", "none")
        unit = depth_of(self.case.raw, camera)
        channels = 1 if hits else 4

        def draw(raw: dict, camera: Camera, background: tuple) -> Drawn:
            image, alpha = self._called([raw], [camera], [background], {"render_mode": mode}, channels)
            return torch.cat([image[..., :-1], image[..., -1:] / unit], -1), alpha

        model = _DepthModel(**vars(self.model), mode=mode, unit=unit)
        return self._beside(path, draw, model, channels, _FAINT if "E" in mode else 0)

    def _alpha(self, path: str) -> PathRow:
        def draw(raw: dict, camera: Camera, background: tuple) -> Drawn:
            _, alpha = self._own.draw(raw, camera, background)
            return alpha[..., None], alpha

        with torch.enable_grad():
            leaves = {k: x.requires_grad_() for k, x in self._own.prepared(self.case.raw).items() if k not in MOTIONS}
            if not draw(leaves, self._view, self.case.background)[0].requires_grad:
                raise _NotTested("its alpha has no gradient", "a function whose alpha has one")
        return self._beside(path, draw, _AlphaModel(**vars(self.model)), 1)

    def _antialiased(self, path: str) -> PathRow:
        if not self.model.settings.planar or self.model.compensation != "none":
            raise _NotTested("it is a mode of the image plane's model", "drgs crossval SCENE --preset gsplat")
        draw = self._with(rasterize_mode="antialiased")
        if "rasterize_mode" not in self._own.named:
            self._refuse_ignored("rasterize_mode", draw)
        return self._beside(path, draw, self.model.replace(compensation="at least 0.005"), 3)

    # ---------------------------------------------------------------------------------------- beside its own calls

    def _refuse_ignored(self, argument: str, draw: Draw) -> None:
        """Raise if an argument that the signature does not name changes nothing."""
        raw, camera, background = self.case.raw, self._view, self.case.background
        images = [dataclasses.replace(self._own, draw=d).image(raw, camera, background) for d in (draw, self._own.draw)]
        if torch.equal(images[0][0], images[1][0]):
            raise _NotTested(f"{argument} changes nothing", f"a function whose signature names {argument}")

    def _require(self, argument: str) -> None:
        """Raise if the signature does not name an argument."""
        if argument not in self._own.named:
            raise _NotTested(f"its signature does not name {argument}", "a function that does")

    def _alike(self, path: str, varied: Draw, plain: Draw, what: str = "", raw: dict | None = None) -> PathRow:
        """Whether a call's image and gradients are those of plain calls that amount to the same."""
        raw = raw or self.case.raw
        camera, background = self._view, self.case.background
        both = [dataclasses.replace(self._own, draw=draw) for draw in (varied, plain)]
        images = [x.image(raw, camera, background)[0] for x in both]
        error = float((images[0] - images[1]).square().mean().sqrt())
        if not error <= _SAME:  # nor is NaN
            return _judged(path, "model difference", f"its image is not that of plain calls: RMS {error:.1e}")
        generator = torch.Generator().manual_seed(self.case.seed)
        u = torch.randint(0, 2, images[0].shape, generator=generator).double() * 2 - 1
        ours = both[1].gradient(raw, camera, background, u)
        theirs = both[0].gradient(raw, camera, background, u)
        groups = {
            k: gradient_row(theirs[k], torch.zeros_like(raw[k]) if x is None else x, self.case.tolerance)
            for k, x in ours.items()
            if x is not None or theirs[k] is not None
        }
        wrong = [name for name, row in groups.items() if row.verdict != "agreement"]
        if wrong:
            relative = max(groups[name].relative for name in wrong)
            why = f"the gradient of {', '.join(wrong)} is not that of plain calls, by {relative:.2g} of its size"
            return _judged(path, "gradient bug", why)
        return _judged(path, "agreement", what)

    def _degrees(self, path: str) -> PathRow:
        if COLORS in self.case.raw or self.case.raw["sh"].shape[1] == 1:
            raise _NotTested("the scene has SH of degree 0 alone", "a scene with higher ones")
        self._require("sh_degree")
        highest = round(self.case.raw["sh"].shape[1] ** 0.5) - 1
        for degree in range(highest):

            def plain(raw: dict, camera: Camera, background: tuple, degree: int = degree) -> Drawn:
                return self._own.draw(raw | {"sh": raw["sh"][:, : (degree + 1) ** 2]}, camera, background)

            row = self._alike(path, self._with(sh_degree=degree), plain)
            if row.status != "agrees":
                return dataclasses.replace(row, why=f"degree {degree}: {row.why}")
        return _judged(path, "agreement", f"0 to {highest}, the scene's")

    def _backgrounds(self, path: str) -> PathRow:
        self._require("backgrounds")
        black = (0.0, 0.0, 0.0)
        behind = torch.tensor([(0.3, 0.9, 0.6)], dtype=torch.float64)

        def plain(raw: dict, camera: Camera, background: tuple) -> Drawn:
            own = {name: x for name, x in raw.items() if name != BACKGROUNDS}
            image, alpha = self._own.draw(own, camera, black)
            return image + (1 - alpha[..., None]) * raw[BACKGROUNDS], alpha

        return self._alike(path, self._with(), plain, "values and gradient", self.case.raw | {BACKGROUNDS: behind})

    def _cameras(self, path: str) -> PathRow:
        first = self._view
        others = [c for c in self.case.cameras if c is not first and c.model == first.model and not c.is_rolling]
        if first.is_rolling:
            raise _NotTested("the view has a rolling shutter", "views that stand still")
        still = {"means": self.case.raw["means"], POSE: torch.full((6,), _APART, dtype=torch.float64)}
        second = others[0] if others else posed(still, first)

        def varied(raw: dict, camera: Camera, background: tuple) -> Drawn:
            return self._called([raw], [camera, second], [background, background[::-1]])

        def plain(raw: dict, camera: Camera, background: tuple) -> Drawn:
            return _below(self._own.draw(raw, *x) for x in ((camera, background), (second, background[::-1])))

        return self._alike(path, varied, plain, "two")

    def _batches(self, path: str) -> PathRow:
        def raws(raw: dict) -> list[dict]:
            return [raw, raw | {"log_scales": raw["log_scales"] + _GROWN, "sh": 0.8 * raw["sh"]}]

        def varied(raw: dict, camera: Camera, background: tuple) -> Drawn:
            return self._called(raws(raw), [camera], [background])

        def plain(raw: dict, camera: Camera, background: tuple) -> Drawn:
            return _below(self._own.draw(x, camera, background) for x in raws(raw))

        return self._alike(path, varied, plain, "two")

    def _packed(self, path: str) -> PathRow:
        self._require("packed")
        return self._alike(path, self._with(packed=True), self._own.draw)

    def _culled(self, path: str) -> PathRow:
        w2c = float64(self._view.w2c).detach()
        depth = depth_of(self.case.raw, self._view)
        center = -w2c[:3, :3].T @ w2c[:3, 3]
        behind = center - torch.linspace(1.5, 2.5, _CULLED)[:, None].double() * depth * w2c[2, :3]
        unusual = {
            "means": behind,
            "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(_CULLED, 1),
            "log_scales": torch.full((_CULLED, 3), depth * 1e-2).log(),
            "logit_opacities": torch.full((_CULLED,), 2.0),
            "sh": torch.full((_CULLED, *self.case.raw["sh"].shape[1:]), 0.7),
        }

        def varied(raw: dict, camera: Camera, background: tuple) -> Drawn:
            longer = {k: torch.cat([x.to(raw[k]), raw[k]]) for k, x in unusual.items()}
            longer |= {k: _posed_as(raw, longer, camera, k) for k in MOTIONS if k in raw}
            return self._called([longer], [camera], [background])

        return self._alike(path, varied, self._own.draw, f"{_CULLED} behind the camera")

    def _near(self, path: str) -> PathRow:
        w2c = float64(self._view.w2c).detach()
        depths = self.case.raw["means"] @ w2c[2, :3] + w2c[2, 3]
        ahead = depths[depths > self.model.settings.near].sort().values
        k = len(ahead) // 3
        if self._view.is_rolling or len(ahead) < 3 or ahead[k] - ahead[k - 1] < 1e-5 * ahead[k]:
            raise _NotTested("no plane lies between the Gaussians of the view", "another view")
        near = float(0.5 * (ahead[k - 1] + ahead[k]))
        beyond = torch.nonzero(depths > near)[:, 0]

        def plain(raw: dict, camera: Camera, background: tuple) -> Drawn:
            fewer = {k: x if k in MOTIONS else x[beyond.to(x.device)] for k, x in raw.items()}
            fewer |= {k: _posed_as(raw, fewer, camera, k) for k in MOTIONS if k in raw}
            return self._own.draw(fewer, camera, background)

        if "near_plane" not in self._own.named:
            self._refuse_ignored("near_plane", self._with(near_plane=near))
        return self._alike(path, self._with(near_plane=near), plain, f"at {near:.3g}")


def _below(pairs: Iterable[Drawn]) -> Drawn:
    """Several images and alphas, below each other."""
    images, alphas = zip(*pairs, strict=True)
    return torch.cat(images), torch.cat(alphas)


def _posed_as(raw: dict, other: dict, camera: Camera, name: str) -> torch.Tensor:
    """The twist of `raw` in the units of `other`, whose median depth is another."""
    factor = depth_of(raw, camera) / depth_of(other, camera)
    return raw[name] * torch.tensor([1.0] * 3 + [factor] * 3).to(raw[name])
