"""A region of a scene: the views that matter are those that show it, by how much of each pixel it makes up.

A region says of each Gaussian i how far it belongs to it, m_i in [0, 1]: its mean is in a box or a sphere; masks of
some photographs show it; or its features are of a class. A pixel p with compositing weights w_ip shows the region by
the share

    s_p = sum_i w_ip m_i + (1 - alpha_p) v_p

v_p = 1 where the ray crosses the volume of a box or a sphere, else 0: what no Gaussian covers there may be the region.
Everything that sums over pixels weighs each by its share: as squares of derivatives are multiplied by the square of a
mask, sqrt(s) is the mask that does so. docs/maths.md has the equations.

Where no Gaussian of the region is in sight yet, as early in a fit, s_p = v_p: the model says nothing about the volume,
but all rays through it would show what is in there.

Imports nothing heavy, for configurations check the text of a region by it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    import torch

    from drgs.cameras import Camera
    from drgs.data import View
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.features.decoder import Decoder
    from drgs.features.segmentation import Classes
    from drgs.settings import RenderSettings

REGION_FORMS = ("box:X0,Y0,Z0,X1,Y1,Z1", "sphere:X,Y,Z,R", "masks:FOLDER", "class:NAME")
"""How the text of a region is written."""

_NUMBERS = {"box": 6, "sphere": 4}
# Pixels that the region must make up in all views together: less is rounding of the shares, not something to look at.
_LEAST_PIXELS = 1e-3

Membership = Callable[["float | None"], "torch.Tensor"]
"""Time -> (N,) float32 in [0, 1]: how far each Gaussian belongs to a region then."""


class NothingOfRegion(ValueError):  # noqa: N818  # a state of the model that a fit goes on from
    """No view shows anything of a region."""


@dataclasses.dataclass(frozen=True)
class RegionText:
    """The text of a region, taken apart.

    Attributes:
        kind: `box`, `sphere`, `masks` or `class`.
        name: Folder of the masks, or name of the class; "" of a box and a sphere.
        numbers: Of a box, its lowest and its highest corner; of a sphere, center and radius; world units.
    """

    kind: str
    name: str = ""
    numbers: tuple[float, ...] = ()

    @classmethod
    def of(cls, text: object, where: str = "select") -> RegionText:
        """What a text says.

        Args:
            text: In one of `REGION_FORMS`.
            where: What an error begins with.
        Raises:
            ValueError: If it is in none of these, or a number is none, or corners or the radius cannot be.
        """
        forms = f"{', '.join(REGION_FORMS[:-1])} or {REGION_FORMS[-1]}"
        kind, _, rest = text.partition(":") if isinstance(text, str) else ("", "", "")
        if kind in ("masks", "class") and rest.strip():
            return cls(kind, rest.strip())
        if kind not in _NUMBERS:
            raise ValueError(f"{where}: region must be {forms}, got {text!r}; correct it")
        try:
            numbers = tuple(float(x) for x in rest.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != _NUMBERS[kind] or not all(map(math.isfinite, numbers)):
            form = next(form for form in REGION_FORMS if form.startswith(kind))
            raise ValueError(f"{where}: region must be {form} with {_NUMBERS[kind]} numbers, got {text!r}; correct it")
        _check_volume(where, kind, numbers)
        return cls(kind, numbers=numbers)

    def __str__(self) -> str:
        return f"{self.kind}:{self.name or ','.join(f'{x:.15g}' for x in self.numbers)}"

    def region(
        self,
        photographs: Callable[[Path], tuple[Sequence[torch.Tensor], Sequence[Camera]]],
        labels: Callable[[], tuple[Classes | None, Decoder | None]],
        settings: RenderSettings | None = None,
        where: str = "select",
    ) -> Region:
        """The region that it describes.

        Args:
            photographs: Folder -> the masks in it and the cameras of their photographs, as `masked_photographs`.
            labels: -> the classes of the scene and the decoder of its features; None where there are none.
            settings: Settings of the renderer, by which masks are put on Gaussians; default as for `Region.masks`.
            where: What an error begins with.
        Raises:
            ValueError: If the scene does not have what it names.
        """
        if self.kind == "box":
            return Region.box(self.numbers[:3], self.numbers[3:])
        if self.kind == "sphere":
            return Region.sphere(self.numbers[:3], self.numbers[3])
        if self.kind == "masks":
            found = Region.masks(*photographs(Path(self.name)), settings=settings)
            return dataclasses.replace(found, text=str(self))
        classes, decoder = labels()
        if classes is None:
            raise ValueError(
                f"{where}: region {self} must be of a scene with classes, this one has none; fit a data set with a "
                "teacher's maps (drgs teach), or use a box, a sphere or masks"
            )
        return Region.of_class(self.name, classes, decoder)


def _check_volume(where: str, kind: str, numbers: Sequence[float]) -> None:
    """Refuse a box whose corners are swapped, and a sphere of no radius."""
    if kind == "sphere" and not numbers[3] > 0:
        raise ValueError(f"{where}: region must have a radius > 0, got {numbers[3]:g}; correct it")
    for axis, low, high in zip("xyz", numbers[:3], numbers[3:], strict=False) if kind == "box" else ():
        if not low < high:
            raise ValueError(
                f"{where}: region must have the lowest corner of its box before the highest, got {axis} from {low:g} "
                f"to {high:g}; swap them"
            )


class RegionShares(NamedTuple):
    """How much of each pixel of some views shows a region.

    Attributes:
        shares: (H, W) float32 in [0, 1] on the CPU, of each view.
        note: What is to be said of them, a sentence; "" where there is nothing.
    """

    shares: list[torch.Tensor]
    note: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Region:
    """A part of a scene, by the constructors `box`, `sphere`, `masks` and `of_class`.

        chair = drgs.Region.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
        drgs.select_views(g, candidates=cameras[2:], train=cameras[:2], region=chair)

    Attributes:
        text: As the option --region writes it.
        of_scene: Scene -> `Membership`.
        crossed: Camera -> (H, W) bool, where rays cross its volume; None where it has none.
    """

    text: str
    of_scene: Callable[[Scene], Membership] = dataclasses.field(repr=False)
    crossed: Callable[[Camera], np.ndarray] | None = dataclasses.field(default=None, repr=False)

    @classmethod
    def box(cls, low: Sequence[float], high: Sequence[float]) -> Region:
        """Gaussians whose means are in a box.

        Args:
            low, high: Corners (x, y, z) in world coordinates, those of the data set's cameras: a Gaussian's mean plus
                `Gaussians.origin`.
        Raises:
            ValueError: If a corner is not three finite numbers, or `low` is not below `high`.
        """
        numbers = (*_point("low", low), *_point("high", high))
        _check_volume("Region.box", "box", numbers)

        def inside(means: torch.Tensor) -> torch.Tensor:
            return ((means >= means.new_tensor(numbers[:3])) & (means <= means.new_tensor(numbers[3:]))).all(1)

        return cls(str(RegionText("box", numbers=numbers)), _by_means(inside), lambda x: _crosses_box(x, numbers))

    @classmethod
    def sphere(cls, center: Sequence[float], radius: float) -> Region:
        """Gaussians whose means are in a sphere.

        Args:
            center: (x, y, z) in world coordinates, see `box`.
            radius: World units, > 0.
        Raises:
            ValueError: If these are not finite numbers, or the radius is not above 0.
        """
        numbers = (*_point("center", center), float(radius))
        _check_volume("Region.sphere", "sphere", numbers)

        def inside(means: torch.Tensor) -> torch.Tensor:
            return (means - means.new_tensor(numbers[:3])).norm(dim=1) <= numbers[3]

        return cls(str(RegionText("sphere", numbers=numbers)), _by_means(inside), lambda x: _crosses_sphere(x, numbers))

    @classmethod
    def masks(
        cls, masks: Sequence[torch.Tensor], cameras: Sequence[Camera], settings: RenderSettings | None = None
    ) -> Region:
        """Gaussians that lie in masks of some photographs: m_i = sum_p w_ip mask_p / sum_p w_ip over their pixels.

        Gaussians that no such photograph shows are outside.

        Args:
            masks: (H, W) in [0, 1], 1 in the region, of each photograph.
            cameras: Their cameras.
            settings: Settings of the renderer that has the weights w; default `RenderSettings.preset("fast")`.
        Raises:
            ValueError: If there are none, or one is of another size than its camera's image.
        """
        from drgs.checks.arguments import ArgumentError
        from drgs.information.inputs import mask_list

        given = [mask for mask in mask_list("Region.masks", list(masks), list(cameras)) if mask is not None]
        if not given or len(given) < len(cameras):
            raise ArgumentError(
                f"Region.masks: there must be a mask for each of one camera or more, got {len(given)} for "
                f"{len(cameras)}; leave cameras without one out"
            )
        return cls(f"masks of {len(given)}", lambda scene: _by_masks(scene, given, list(cameras), settings))

    @classmethod
    def of_class(cls, name: str, classes: Classes, decoder: Decoder | None = None) -> Region:
        """Gaussians whose features are of a class, as `drgs query --class` selects them.

        Args:
            name: Name of the class.
            classes: All classes of the scene, with the embeddings of their names.
            decoder: What makes a teacher's features of those of the Gaussians; None: they are these.
        Raises:
            ValueError: If there is no such class (all are listed), or the classes have no embeddings.
        """
        from drgs.features.query import TextQuery

        query = TextQuery.of_classes(classes, [name])

        def of_scene(scene: Scene) -> Membership:
            def members(time: float | None) -> torch.Tensor:
                seen = scene.at(time)
                if seen.features is None:
                    raise ValueError(
                        f"region class:{name}: Gaussians must have semantic features, have none; fit a data set with a "
                        "teacher's maps (drgs teach)"
                    )
                return query.score(seen.features.detach().cpu(), decoder)[1].float()

            return members

        return cls(f"class:{name}", of_scene)

    def members(self, scene: Scene, time: float | None = None) -> torch.Tensor:
        """(N,) float32 in [0, 1]: how far each Gaussian of a scene belongs to it, at a time."""
        return self.of_scene(scene)(time)

    def shares(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        settings: RenderSettings | None = None,
        where: str = "region",
    ) -> RegionShares:
        """How much of each pixel of some views shows it, see the module's text.

        Args:
            scene: The scene, seen by each camera at its time.
            cameras: One or more cameras.
            settings: Default `RenderSettings.preset("fast")`.
            where: What an error begins with.
        Raises:
            NothingOfRegion: If no view shows anything of it.
        """
        import torch

        members = self.of_scene(scene)
        shown, opened, total = [], [], 0.0
        for camera in cameras:
            composited, alpha = _composited(scene.at(camera.time), camera, members(camera.time), settings)
            total += float(composited.sum(dtype=torch.float64))
            if self.crossed is not None:
                crossed = torch.from_numpy(self.crossed(camera)).float()
                composited = composited + (1 - alpha).clamp(min=0) * crossed
                opened.append(crossed)
            shown.append(composited.clamp(0, 1))
        if total > _LEAST_PIXELS:
            return RegionShares(shown)
        if any(bool(crossed.any()) for crossed in opened):
            note = f"region {self.text}: no Gaussian of it is in sight yet; the pixels whose rays cross it count"
            return RegionShares(opened, note)
        raise NothingOfRegion(
            f"{where}: region {self.text} must be in sight of a view, none of {len(cameras)} shows any of it"
            + ("; correct it" if self.crossed is None else f"; {_where_cameras_are(cameras)}")
        )

    def is_crossed(self, cameras: Sequence[Camera]) -> bool:
        """Whether rays of a camera cross its volume; True of a region without one, whose place only a model knows."""
        return self.crossed is None or any(bool(self.crossed(camera).any()) for camera in cameras)


def masked_photographs(
    folder: Path, views: Sequence[View], cameras: Sequence[Camera], where: str = "select"
) -> tuple[list[torch.Tensor], list[Camera]]:
    """The masks of those photographs that have one in a folder, as large as their cameras' images, and these cameras.

    Args:
        folder: Masks named as the photographs: NAME.png, or with the photograph's suffix in it, NAME.jpg.png.
        views: The photographs; masks are undistorted as they are.
        cameras: Their cameras, as the scene is seen.
        where: What an error begins with.
    Raises:
        FileNotFoundError: If there is no such folder.
        NothingOfRegion: If no photograph has a mask.
        ValueError: If a mask is damaged, or has another shape than its photograph.
    """
    import torch

    masks, seen = [], []
    for view, camera in zip(views, cameras, strict=True):
        if (path := _mask_of(folder, view, where)) is None:
            continue
        # Not the mask of the data set, which says where the photograph counts.
        mask = dataclasses.replace(view.checked(), mask_path=path).mask(camera.width, camera.height)
        assert mask is not None  # it has a file
        masks.append(torch.from_numpy(mask))
        seen.append(camera)
    if not masks:
        raise NothingOfRegion(f"{where}: {_no_mask(folder, views)}")
    return masks, seen


def check_masks(folder: Path, views: Sequence[View], where: str = "select") -> None:
    """Raise unless a photograph has a mask in a folder, of which nothing is read; see `masked_photographs`."""
    if all(_mask_of(folder, view, where) is None for view in views):
        raise ValueError(f"{where}: {_no_mask(folder, views)}")


def _mask_of(folder: Path, view: View, where: str) -> Path | None:
    """The file of a photograph's mask; None where it has none."""
    from drgs.data.masks import mask_file

    if not folder.is_dir():
        raise FileNotFoundError(f"{where}: region masks:{folder} must be a folder, is none; name that of the masks")
    names = [view.name] if view.image_path is None else [view.image_path.name, view.name]
    return next((found for name in names if (found := mask_file(folder, name)) is not None), None)


def _no_mask(folder: Path, views: Sequence[View]) -> str:
    """That no photograph has a mask, for a message."""
    example = f", e.g. {views[0].name}.png" if views else ""
    return (
        f"region masks:{folder} must have a mask named as one of {len(views)} training photographs{example}, has none; "
        "rename them"
    )


def _point(name: str, values: Any) -> tuple[float, float, float]:
    """Three finite numbers."""
    from drgs.checks.arguments import ArgumentError, kind_of

    try:
        x, y, z = (float(x) for x in values)
    except (TypeError, ValueError):
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise ArgumentError(f"Region: {name} must be three finite numbers x, y, z, got {kind_of(values)}; correct it")
    return x, y, z


def _by_means(inside: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[Scene], Membership]:
    """The membership of Gaussians whose means (N, 3), float64 world, are inside of something."""
    import torch

    def of_scene(scene: Scene) -> Membership:
        def members(time: float | None) -> torch.Tensor:
            with torch.no_grad():
                seen = scene.at(time)
                means = seen.means.double().cpu() + torch.tensor(seen.origin.tolist(), dtype=torch.float64)
                return inside(means).float()

        return members

    return of_scene


def _by_masks(
    scene: Scene, masks: Sequence[torch.Tensor], cameras: Sequence[Camera], settings: RenderSettings | None
) -> Membership:
    """The share of each Gaussian's weight that lies in masks: the gradient of a feature image by its features."""
    import torch

    sums: Any = 0
    for mask, camera in zip(masks, cameras, strict=True):
        with torch.enable_grad():
            features = torch.zeros(len(scene.at(camera.time)), 2, requires_grad=True)
            image = _features(scene.at(camera.time), camera, features, settings)[0]
            weights = torch.stack([mask.float().cpu(), torch.ones(mask.shape)], 2)
            (sums_of_view,) = torch.autograd.grad((image * weights).sum(), features)
        sums = sums + sums_of_view.double()
    members = torch.where(sums[:, 1] > 0, sums[:, 0] / sums[:, 1], 0.0).clamp(0, 1).float()
    return lambda time: members


def _composited(
    seen: Gaussians, camera: Camera, members: torch.Tensor, settings: RenderSettings | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W) float32 each: sum_i w_ip m_i, and alpha_p."""
    import torch

    if not len(seen):
        nothing = torch.zeros(camera.height, camera.width)
        return nothing, nothing
    with torch.no_grad():
        image, alpha = _features(seen, camera, members[:, None], settings)
    return image[..., 0], alpha


def _features(
    seen: Gaussians, camera: Camera, features: torch.Tensor, settings: RenderSettings | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, D) composited features, and (H, W) alpha, on the CPU; differentiated by the features alone."""
    from drgs.integrator import render  # loads Dr.Jit, which the text of a region need not have
    from drgs.settings import RenderSettings

    seen = seen.detach()
    shown = seen.replace(sh=seen.sh[:, :1], features=features.to(seen.means.device, seen.sh.dtype))
    out = render(shown, camera, settings or RenderSettings.preset("fast"), outputs=())
    assert out.features is not None  # some were given
    return out.features.cpu(), out.alpha.cpu()


# -------------------------------------------------- rays through volumes


def _rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) float64 origins and unit directions."""
    return camera.pixel_origins(), camera.pixel_directions()


def _crosses_box(camera: Camera, numbers: Sequence[float]) -> np.ndarray:
    """(H, W) bool: where rays meet a box in front of the camera, or begin in it."""
    import numpy as np

    start, along = _rays(camera)
    low, high = np.array(numbers[:3]), np.array(numbers[3:])
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray along a face: 0 / 0, which no bound is
        ends = np.stack([(low - start) / along, (high - start) / along])
    enter = np.nan_to_num(ends.min(0), nan=-np.inf, posinf=np.inf, neginf=-np.inf).max(-1)
    leave = np.nan_to_num(ends.max(0), nan=np.inf, posinf=np.inf, neginf=-np.inf).min(-1)
    return (enter <= leave) & (leave > 0)


def _crosses_sphere(camera: Camera, numbers: Sequence[float]) -> np.ndarray:
    """(H, W) bool: where rays meet a sphere in front of the camera, or begin in it."""
    import numpy as np

    start, along = _rays(camera)
    towards = np.array(numbers[:3]) - start
    nearest = (towards * along).sum(-1)
    squared = (towards**2).sum(-1)
    radius = numbers[3] ** 2
    return (squared <= radius) | ((nearest > 0) & (squared - nearest**2 <= radius))


def _where_cameras_are(cameras: Sequence[Camera]) -> str:
    """Advice for a volume that is out of sight: coordinates that are in the scene."""
    import numpy as np

    centers = np.stack([camera.center for camera in cameras])
    spans = ", ".join(f"{x:.3g}..{y:.3g}" for x, y in zip(centers.min(0), centers.max(0), strict=True))
    return f"give world coordinates, in which the cameras are within {spans}"
