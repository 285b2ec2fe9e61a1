"""Where things are at a time that the scene does not show there: seen in residuals, before they are fitted.

A photograph differs from what is rendered where something is at its time that is not there at others. A pixel of it is
on a ray; how far along, and how fast it moves, is what other photographs of the same time and of times near it say: at
the right depth and velocity they show the same color, where they, too, differ. Depth and velocity are found as
PatchMatch finds them: tried at random, taken over from pixels of the same photograph and of those near in time, and
changed a little, each kept where it agrees better.

Reference:
    Barnes et al., "PatchMatch: A Randomized Correspondence Algorithm for Structural Image Editing", ACM TOG 2009;
    Bleyer et al., "PatchMatch Stereo", BMVC 2011. That residuals of a model say where to look, and that a velocity is
    searched with the depth, is not from there.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, max_pool2d

from drgs.display.progress import Bar
from drgs.ellipsoids import colors_only
from drgs.fitting.stages import spacing
from drgs.integrator import render
from drgs.sizes import reduced_size

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from drgs.cameras import Camera
    from drgs.ellipsoids import Scene
    from drgs.fitting.frames import Frame
    from drgs.integrator import Output
    from drgs.settings import RenderSettings

__all__ = ["Births", "find_births"]

_PIXELS = 10_000  # of the pictures that are compared
_CLEAR = 0.08  # mean difference of colors of a pixel that shows something else
_OFTEN = 4  # photographs from one place that tell what is seen from there at most times
_SOLID = 0.5  # opacity below which a ray ends in nothing, and a mask below which a pixel does not count
_SEEDS = 128  # pixels of a photograph whose depth is searched
_SAME, _NEAR = 6, 8  # photographs of the same time, and of other times near it, that a pixel is compared with
_TURNS = 8  # of the search
_TRIED, _CHANGED, _TAKEN = 24, 8, 5  # depths and velocities of a pixel in each turn: random, changed, of other pixels
_NEAREST = 0.02  # of the way to what is rendered: the least depth
_DECADES, _RESTING = 2.5, 0.3  # that random speeds span, and part of them that are 0
_STEP = 0.25  # relative change of a depth in the second turn, and of a velocity; it halves with each
_PROMISING = 0.3  # score from which on what a pixel has is tried by others
_COLOR = 0.15  # standard deviation of a color of one thing in two photographs
_FEWEST = 2  # photographs that must show the place
_ENOUGH = 3  # photographs of the same time that tell a place without others
_LATER = 0.02  # how much other times then count, and a velocity against it: they tell which of equal ones
_AGREE = 0.6  # of them that must agree
_BEFORE = 0.98  # of a distance: what is rendered nearer stands before it
_NOTHING = 1e9  # distance to where a ray ends in nothing
_WINDOW = 8.0  # times between photographs, within which velocities and accelerations are made to agree
_SPREAD = 0.025  # extents of the scene: how far apart places of one thing are
_REACH = 0.05  # the same: what velocity and acceleration may be off by at the end of the window
_TURNED = 0.25  # part of its way that a thing may be off its straight path
_FAR = 0.95  # quantile of the distances to all Gaussians, beyond which nothing is looked for
_FASTEST = 0.15  # extents of the scene in the time between two photographs


class Births(NamedTuple):
    """M places where something is at a time.

    Attributes:
        points: (M, 3) world.
        colors: (M, 3) in [0, 1].
        times: (M,) times at which something is there.
        velocities: (M, 3) world units in a unit of time.
        accelerations: (M, 3) what these change by in a unit of time.
        sizes: (M,) half of how far apart they are, world units.
        lasting: (M,) how well photographs of other times agree with where they are then, in [0, 1].
        photographs: How many photographs show one of them, of all that were found.
    """

    points: torch.Tensor
    colors: torch.Tensor
    times: torch.Tensor
    velocities: torch.Tensor
    accelerations: torch.Tensor
    sizes: torch.Tensor
    lasting: torch.Tensor
    photographs: int

    def take(self, index: torch.Tensor) -> Births:
        """Some of them."""
        return self._replace(**{name: getattr(self, name)[index] for name in self._fields[:-1]})

    @classmethod
    def together(cls, parts: Sequence[Births]) -> Births:
        """All of them, at least one."""
        tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in cls._fields[:-1]}
        return parts[0]._replace(**tensors, photographs=sum(part.photographs for part in parts))


@dataclasses.dataclass
class _Look:
    """A photograph beside its rendering.

    Attributes:
        camera: Pinhole of its size.
        time: Time at which it was taken.
        maps: (4, H, W): RGB of the photograph, and where it shows something else, in [0, 1].
        distance: (H, W) to what is rendered; infinite where rays end in nothing.
        seeds: (S, 2) pixels whose depth is searched, (x, y).
        rays: (S, 3) unit directions.
        colors: (S, 3).
        share: Part of its pixels that show something else.
        center: (3,) of the camera.
        depth, velocity: (S,) and (S, 3), the best that are known of the seeds; distances along rays, and world units in
            a unit of time.
        score, lasting: (S,) how well all photographs agree with these, and those of other times.
        tried: Whether they have been looked for.
    """

    camera: Camera
    time: float
    maps: torch.Tensor
    distance: torch.Tensor
    seeds: torch.Tensor
    rays: torch.Tensor
    colors: torch.Tensor
    share: float
    center: torch.Tensor
    depth: torch.Tensor
    velocity: torch.Tensor
    score: torch.Tensor
    lasting: torch.Tensor
    tried: bool = False


def find_births(
    frames: list[Frame],
    scene: Scene,
    settings: RenderSettings,
    extent: float,
    most: int,
    generator: torch.Generator,
    exposure: Callable[[Output, Frame], Output] | None = None,
) -> Births:
    """Look for what photographs show and the scene does not.

    Args:
        frames: Photographs, whose cameras have times.
        scene: What has been fitted so far.
        settings: What it is rendered with.
        extent: Extent of the scene, world units.
        most: How many places are returned at most, drawn at random from those that are found.
        generator: Generator of all random choices.
        exposure: What a photograph shows of a rendering; None: the rendering.
    """
    means = scene.at(frames[0].camera.time).means.detach()  # how far things are is a constant
    places = torch.from_numpy(np.stack([frame.camera.center for frame in frames])).to(means)
    far = float(torch.cdist(places, means).quantile(_FAR, dim=1).max())
    looks = []
    usual = _usual(frames)
    with Bar("looking for what moves", (1 + _TURNS) * len(frames)) as bar:
        for frame, still in zip(frames, usual, strict=True):
            looks.append(_look(frame, still, scene, settings, generator, exposure))
            bar.advance()
        times = np.array([look.time for look in looks])
        step = spacing([look.time for look in looks])
        near = [_neighbors(i, looks, times) for i in range(len(looks))]
        fastest = _FASTEST * extent / step
        for turn in range(_TURNS):
            for i, look in enumerate(looks):
                if len(look.seeds):
                    _turn(turn, i, looks, near[i], far, fastest, generator)
                bar.advance()
    whole = _bent(Births.together([_found(look) for look in looks]), extent, step)
    count = len(whole.points)
    if count <= most:
        return whole
    drawn = torch.randperm(count, generator=generator)[:most]
    fewer = whole.take(drawn)
    return fewer._replace(sizes=fewer.sizes * math.sqrt(count / most))


def _found(look: _Look) -> Births:
    """The places that the pixels of a photograph agree with others about."""
    good = look.score > _AGREE
    depth, rays, colors = look.depth[good], look.rays[good], look.colors[good]
    pixels = look.share * look.camera.width * look.camera.height / max(len(look.seeds), 1)  # of a seed
    return Births(
        points=look.center + depth[:, None] * rays,
        colors=colors,
        times=torch.full((len(depth),), look.time, dtype=torch.float64),
        velocities=look.velocity[good],
        accelerations=torch.zeros_like(look.velocity[good]),
        sizes=depth * (math.sqrt(pixels) / 2 / float(look.camera.K[0, 0])),
        lasting=look.lasting[good],
        photographs=int(good.any()),
    )


def _bent(found: Births, extent: float, step: float) -> Births:
    """With the velocities and accelerations that places of times near theirs agree on.

    Each place predicts where it is at those times. What is found there then, of its color, is a measurement of how far
    the prediction is off: offset, velocity and acceleration are fitted to all of them, least squares with priors, and
    the offset is dropped, for what is found is another place of the same thing.
    """
    velocities, accelerations = found.velocities.clone(), found.accelerations.clone()
    times = found.times
    late = _WINDOW * step
    # Of an offset, and of what velocity and acceleration come to at the end of the window, over the noise of a place.
    prior = torch.tensor([1.0, _REACH / _SPREAD, _REACH / _SPREAD]).square().reciprocal().diag()
    for time in times.unique():
        here = (times == time).nonzero()[:, 0]
        there = ((times - time).abs() < late).nonzero()[:, 0]
        part = ((times[there] - time) / late).float()
        expected = found.points[here][:, None] + found.velocities[here][:, None] * (part * late)[None, :, None]
        off = found.points[there][None] - expected
        speed = found.velocities[here].norm(dim=1, keepdim=True)
        same = off.norm(dim=2) < _SPREAD * extent * 2 + _TURNED * speed * (part * late).abs()
        same &= torch.cdist(found.colors[here], found.colors[there]) < 2 * _COLOR
        basis = torch.stack([torch.ones_like(part), part, part.square()], 1)
        # A time counts once: its photographs show one side of a thing, all places of which are off alike.
        each = torch.unique(times[there], return_inverse=True)[1]
        counted = same.float() @ torch.nn.functional.one_hot(each).float()
        weights = same / counted[:, each].clamp(min=1)
        weighted = weights[..., None] * basis  # (here, there, 3)
        normal = weighted.transpose(1, 2) @ basis + prior
        solved = torch.linalg.solve(normal, weighted.transpose(1, 2) @ off)
        velocities[here] += solved[:, 1] / late
        accelerations[here] = 2 * solved[:, 2] / late**2
    return found._replace(velocities=velocities, accelerations=accelerations)


def _reduced(frame: Frame) -> torch.Tensor:
    """(3, H, W) of a photograph, at the size at which photographs are compared."""
    width, height = reduced_size(frame.camera, _PIXELS)
    return interpolate(frame.image().permute(2, 0, 1)[None], (height, width), mode="area")[0]


def _usual(frames: list[Frame]) -> list[torch.Tensor | None]:
    """(3, H, W) of each photograph, what its camera sees at most times; None where it took fewer than 4 from there."""
    groups: dict[bytes, list[int]] = {}
    for i, frame in enumerate(frames):
        camera = frame.camera
        key = np.concatenate([camera.w2c.ravel(), camera.K.ravel(), (camera.width, camera.height)])
        groups.setdefault(key.round(6).tobytes(), []).append(i)
    usual: list[torch.Tensor | None] = [None] * len(frames)
    for listed in groups.values():
        if len(listed) >= _OFTEN:
            median = torch.stack([_reduced(frames[i]) for i in listed]).median(0).values
            for i in listed:
                usual[i] = median
    return usual


def _look(
    frame: Frame,
    usual: torch.Tensor | None,
    scene: Scene,
    settings: RenderSettings,
    generator: torch.Generator,
    exposure: Callable[[Output, Frame], Output] | None,
) -> _Look:
    """A photograph beside its rendering, and the pixels whose depth is to be searched."""
    width, height = reduced_size(frame.camera, _PIXELS)
    camera = frame.camera.resized(width, height)
    with torch.no_grad():  # looked at
        out = render(colors_only(scene, camera.time), camera, settings, outputs=("depth",))
        if exposure is not None:
            out = exposure(out, frame)
    rgb = out.rgb.cpu().clamp(0, 1).permute(2, 0, 1)
    image = _reduced(frame)
    assert out.depth is not None  # asked for
    assert camera.time is not None  # a fit to what moves
    distance = torch.where(out.alpha.cpu() > _SOLID, out.depth.cpu(), torch.inf)
    rays = torch.from_numpy(camera.pixel_directions()).reshape(height, width, 3).float()
    if settings.planar and settings.depth_key == "z":
        distance = distance / (rays @ torch.from_numpy(camera.c2w[:3, 2]).float())
    residual = avg_pool2d((image - rgb).abs().mean(0)[None], 3, 1, 1)[0]
    other = residual > _CLEAR
    if usual is not None:
        other &= avg_pool2d((image - usual).abs().mean(0)[None], 3, 1, 1)[0] > _CLEAR
    if frame.mask is not None:
        other &= interpolate(frame.mask[None, None], (height, width), mode="area")[0, 0] > _SOLID
    # What is thinner than three pixels is an edge that is not sharp yet.
    core = -max_pool2d(-other.float()[None], 3, 1, 1)
    other = (max_pool2d(core, 3, 1, 1)[0] > 0) & other
    where = other.nonzero()
    if len(where):
        where = where[torch.randperm(len(where), generator=generator)[:_SEEDS]]
    rows, columns = where[:, 0], where[:, 1]
    return _Look(
        camera=camera,
        time=camera.time,
        maps=torch.cat([image, other.float()[None]]),
        distance=distance,
        seeds=torch.stack([columns, rows], 1),
        rays=rays[rows, columns],
        colors=image[:, rows, columns].T.contiguous(),
        share=float(other.float().mean()),
        center=torch.from_numpy(camera.center).float(),
        depth=torch.zeros(len(where)),
        velocity=torch.zeros(len(where), 3),
        score=torch.zeros(len(where)),
        lasting=torch.zeros(len(where)),
    )


def _neighbors(i: int, looks: list[_Look], times: np.ndarray) -> list[int]:
    """Photographs that the pixels of one are compared with: of its time, and nearest in time."""
    apart = np.abs(times - times[i])
    centers = np.stack([look.camera.center for look in looks])
    beside = np.linalg.norm(centers - centers[i], axis=1)
    order = np.lexsort((beside, apart))
    same = [j for j in order if apart[j] == 0 and j != i][:_SAME]
    other = [j for j in order if apart[j] > 0][:_NEAR]
    return [*same, *other]


def _turn(
    turn: int, i: int, looks: list[_Look], near: list[int], far: float, fastest: float, generator: torch.Generator
) -> None:
    """Try other depths and velocities for the pixels of a photograph, and keep what agrees better."""
    look = looks[i]
    seeds = len(look.seeds)
    x, y = look.seeds[:, 0], look.seeds[:, 1]
    end = look.distance[y, x].clamp(max=far)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    randn = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    depths = [end[:, None] * (_NEAREST + (1 - _NEAREST) * rand(seeds, _TRIED))]
    speed = fastest * 10 ** (-_DECADES * rand(seeds, _TRIED, 1)) * (rand(seeds, _TRIED, 1) > _RESTING)
    direction = torch.nn.functional.normalize(randn(seeds, _TRIED, 3), dim=-1)
    velocities = [speed * direction]
    if look.tried:
        depth, velocity = look.depth[:, None], look.velocity[:, None]
        depths.append(depth)
        velocities.append(velocity)
        scale = _STEP * 0.5 ** (turn - 1)
        depths.append(depth * (scale * randn(seeds, _CHANGED)).exp())
        # Most changes of a velocity are small ones.
        velocities.append(velocity + scale * fastest * randn(seeds, _CHANGED, 3) * rand(seeds, _CHANGED, 1) ** 3)
        others = torch.randint(seeds, (seeds, _TAKEN), generator=generator)
        depths.append(look.depth[others])
        velocities.append(look.velocity[others])
        taken = _taken_over(look, [looks[j] for j in near])
        if taken is not None:
            depths.append(taken[0])
            velocities.append(taken[1])
    depth = torch.cat(depths, 1).clamp(min=1e-3 * far)
    depth = torch.minimum(depth, end[:, None])
    velocity = torch.cat(velocities, 1)
    score, lasting = _scores(look, depth, velocity, [looks[j] for j in near], fastest)
    best = score.argmax(1)
    rows = torch.arange(seeds)
    look.depth, look.velocity = depth[rows, best], velocity[rows, best]
    look.score, look.lasting = score[rows, best], lasting[rows, best]
    look.tried = True


def _taken_over(look: _Look, near: list[_Look]) -> tuple[torch.Tensor, torch.Tensor] | None:
    """(S, T) depths and (S, T, 3) velocities that pixels of other photographs have, of those seen nearest to each."""
    points, velocities = [], []
    for other in near:
        good = other.score > _PROMISING
        place = other.center + other.depth[:, None] * other.rays + other.velocity * (look.time - other.time)
        points.append(place[good])
        velocities.append(other.velocity[good])
    place, speed = torch.cat(points), torch.cat(velocities)
    projected, depth = look.camera.project(place.double().numpy())
    front = torch.from_numpy(depth > 0)
    if not front.any():
        return None
    place, speed, pixels = place[front], speed[front], torch.from_numpy(projected)[front]
    apart = torch.cdist(look.seeds.double() + 0.5, pixels)
    nearest = apart.topk(min(_TAKEN, len(place)), dim=1, largest=False).indices
    return (place[nearest] - look.center).norm(dim=-1), speed[nearest]


def _scores(
    look: _Look, depth: torch.Tensor, velocity: torch.Tensor, near: list[_Look], fastest: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """How well other photographs agree with depths (S, T) and velocities (S, T, 3) of the pixels of one.

    Returns:
        (S, T) part of the photographs that agree, of the same time where enough of these show the place, else of all;
        (S, T) the part of those of other times.
    """
    start = look.center + depth[..., None] * look.rays[:, None]
    agreed, shown = torch.zeros(2, *depth.shape), torch.zeros(2, *depth.shape)  # at the same time, at others
    for other in near:
        is_later = int(other.time != look.time)
        place = start + velocity * (other.time - look.time)
        camera = other.camera
        pixels, ahead = camera.project(place.reshape(-1, 3).double().numpy())
        size = np.array([camera.width, camera.height])
        where = torch.from_numpy(2 * pixels / size - 1).float().reshape(*depth.shape, 2)
        inside = torch.from_numpy(ahead > 0).reshape(depth.shape) & (where.abs() < 1).all(-1)
        maps = torch.cat([other.maps, other.distance.clamp(max=_NOTHING)[None]])[None]
        found = grid_sample(maps, where.nan_to_num(2.0).clamp(-2, 2)[None], align_corners=False)[0]
        away = (place - other.center).norm(dim=-1)
        inside &= found[4] > _BEFORE * away  # else something stands before it
        difference = (found[:3].permute(1, 2, 0) - look.colors[:, None]).square().sum(-1)
        same = found[3] * torch.exp(-0.5 * difference / _COLOR**2)
        agreed[is_later] += torch.where(inside, same, 0.0)
        shown[is_later] += inside
    # One more that does not agree: a place that many see is better than one that few do, where as large a part agrees.
    now, lasting = agreed / (shown + 1)
    everything = torch.where(shown.sum(0) >= _FEWEST, agreed.sum(0) / (shown.sum(0) + 1), 0.0)
    score = torch.where(shown[0] >= _ENOUGH, now + _LATER * lasting, everything)
    return score - _LATER * velocity.norm(dim=-1) / fastest, lasting
