"""Where photographs show what a scene does not at their time: the places, and how they move.

A photograph differs from its rendering where something is at its time that is not there at others. A pixel of it is on
a ray; how far along, and how fast it moves, is what other photographs of the same time and of times near it say: at the
right depth and velocity they show the same color, where they, too, differ. Depth and velocity are found as PatchMatch
finds them: candidates are drawn at random, taken from pixels of the same photograph and of those near in time, and
changed a little, and each pixel keeps the one that photographs agree with best.

Reference:
    Barnes et al., "PatchMatch: A Randomized Correspondence Algorithm for Structural Image Editing", ACM TOG 2009;
    Bleyer et al., "PatchMatch Stereo", BMVC 2011. That residuals of a model say where to look, and that a velocity is
    searched with the depth, is not from there.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, max_pool2d

from drgs.cameras.sizes import reduced_size
from drgs.display.progress import Bar
from drgs.ellipsoids import Scene, colors_only
from drgs.fitting.depths import renders_z
from drgs.fitting.resolution import averaged
from drgs.fitting.stages import spacing
from drgs.integrator import Output, render

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.fitting.frames import Frame
    from drgs.settings import RenderSettings

# Units of times are the median time between a photograph and the next one; docs/dynamic-data.md was measured so.
_PIXELS = 10_000  # of the pictures that are compared, at most: few enough that the search takes seconds
_DIFFERENCE = 0.08  # mean difference of colors, in [0, 1], from which on a pixel shows something else: above noise
# Photographs from one place from which on their median is what is seen there at most times; fewer have no majority.
_BACKGROUND_PHOTOGRAPHS = 4
_SAMPLES = 128  # pixels of a photograph whose depth is searched, at most
_SAME_TIME, _OTHER_TIMES = 6, 8  # photographs of the same time, and of the nearest others, that they are compared with
_ITERATIONS = 8  # rounds of the search
_RANDOM, _CHANGED, _NEIGHBORS = 24, 8, 5  # candidates in a round: drawn at random, its own with a change, of others
_LEAST_DEPTH = 0.02  # least random depth, as part of the way to what is rendered: nothing stands before the lens
_DECADES, _RESTING = 2.5, 0.3  # powers of ten that random speeds span below the fastest, and part of them that are 0
_CHANGE = 0.25  # relative change of depths and velocities in the second round; it halves with each
_PROPAGATED = 0.3  # score in [0, 1] from which on other photographs take over a pixel's depth and velocity
_ACCEPTED = 0.6  # score in [0, 1] from which on a new Gaussian is added: most photographs agree
_COLOR = 0.15  # standard deviation of the color of one thing in two photographs, in [0, 1]
_FEWEST = 2  # photographs that must show a place
_ENOUGH = 3  # photographs of the same time that say where something is without those of others
_MINOR = 0.02  # weight of what decides only between equals: agreement of other times, and a low speed
_OCCLUDED = 0.98  # part of the distance to a place below which what is rendered stands before it; 1 up to rounding
_FAR = 0.95  # quantile of the distances to all Gaussians beyond which nothing is looked for
_FASTEST = 0.15  # largest speed, in extents of the scene in the time between two photographs
_SOLID = 0.5  # opacity below which a ray meets no surface, and value of a mask below which a pixel does not count
_NO_SURFACE = 1e9  # distance in world units of a ray that meets no surface: farther than any surface, and finite
# Of trajectories that are made to agree.
_WINDOW = 16.0  # times within which velocities and accelerations agree
_SPREAD = 0.06  # how far apart places of one thing are, in extents of the scene
_ROUNDS = 2  # how often they are made to agree, each time with what is found along what they agreed on before
_REACH = 0.05  # what velocity and acceleration may be off by at the end of the window, in extents of the scene
_TURNED = 0.25  # part of its way that a thing may be off its straight path
_TOGETHER = 256  # places whose trajectories are corrected at once, so that they need little memory


class NewGaussians(NamedTuple):
    """M places where something is at a time.

    Attributes:
        points: (M, 3), relative to the origin of the Gaussians beside which they were found.
        colors: (M, 3) in [0, 1].
        times: (M,) times at which something is there.
        velocities: (M, 3) world units in a unit of time.
        accelerations: (M, 3) what these change by in a unit of time.
        sizes: (M,) half of how far apart they are, world units.
        confirmed: (M,) how well photographs of other times agree with where they are then, in [0, 1].
        photographs: How many photographs show one of them, of all that were found.
    """

    points: torch.Tensor
    colors: torch.Tensor
    times: torch.Tensor
    velocities: torch.Tensor
    accelerations: torch.Tensor
    sizes: torch.Tensor
    confirmed: torch.Tensor
    photographs: int

    def take(self, index: torch.Tensor) -> NewGaussians:
        """Some of them."""
        return self._replace(**{name: getattr(self, name)[index] for name in self._fields[:-1]})

    @classmethod
    def joined(cls, several: Sequence[NewGaussians]) -> NewGaussians:
        """All of them, at least one."""
        tensors = {name: torch.cat([getattr(part, name) for part in several]) for name in cls._fields[:-1]}
        return several[0]._replace(**tensors, photographs=sum(part.photographs for part in several))


@dataclasses.dataclass
class _Comparison:
    """A photograph beside its rendering.

    Attributes:
        camera: Pinhole of its size, relative to the origin of the Gaussians, as all that is compared.
        time: Time at which it was taken.
        maps: (4, H, W): RGB of the photograph, and where it shows something else, in [0, 1].
        distance: (H, W) to what is rendered; infinite where rays end in nothing.
        samples: (S, 2) pixels whose depth is searched, (x, y).
        rays: (S, 3) unit directions.
        colors: (S, 3).
        share: Part of its pixels that show something else.
        center: (3,) of the camera.
        depth, velocity: (S,) and (S, 3), the best that are known of the samples: distances along rays, and world
            units in a unit of time.
        score, confirmed: (S,) how well all photographs agree with these, and those of other times.
        is_searched: Whether they have been looked for.
    """

    camera: Camera
    time: float
    maps: torch.Tensor
    distance: torch.Tensor
    samples: torch.Tensor
    rays: torch.Tensor
    colors: torch.Tensor
    share: float
    center: torch.Tensor
    depth: torch.Tensor
    velocity: torch.Tensor
    score: torch.Tensor
    confirmed: torch.Tensor
    is_searched: bool = False


def find_new_gaussians(
    frames: list[Frame],
    scene: Scene,
    settings: RenderSettings,
    extent: float,
    most: int,
    generator: torch.Generator,
    shown: Callable[[Output, Frame], Output] | None = None,
) -> NewGaussians:
    """Look for what photographs show and the scene does not.

    Args:
        frames: Photographs, whose cameras have times.
        scene: What has been fitted so far.
        settings: What it is rendered with.
        extent: Extent of the scene, world units.
        most: How many places are returned at most, drawn at random from those that are found.
        generator: Generator of all random choices.
        shown: What a photograph shows of a rendering; None: the rendering.
    """
    beside = scene.at(frames[0].camera.time)
    means = beside.means.detach()  # how far things are is a constant
    places = torch.from_numpy(np.stack([frame.camera.center - beside.origin for frame in frames])).to(means)
    far = float(torch.cdist(places, means).quantile(_FAR, dim=1).max())
    comparisons = []
    background = _backgrounds(frames)
    with Bar("looking for what moves", (1 + _ITERATIONS) * len(frames)) as bar:
        for frame, still in zip(frames, background, strict=True):
            comparisons.append(_compared(frame, still, scene, beside.origin, settings, generator, shown))
            bar.advance()
        times = np.array([comparison.time for comparison in comparisons])
        step = spacing([comparison.time for comparison in comparisons])
        neighbors = [_neighbors(i, comparisons, times) for i in range(len(comparisons))]
        fastest = _FASTEST * extent / step
        for iteration in range(_ITERATIONS):
            for i, comparison in enumerate(comparisons):
                if len(comparison.samples):
                    near = [comparisons[j] for j in neighbors[i]]
                    _search_round(iteration, comparison, near, far, fastest, generator)
                bar.advance()
    found = NewGaussians.joined([_accepted(comparison) for comparison in comparisons])
    count = len(found.points)
    if count > most:
        found = found.take(torch.randperm(count, generator=generator)[:most])
        found = found._replace(sizes=found.sizes * math.sqrt(count / most))
    return agreed_trajectories(found, extent, step)


def _accepted(comparison: _Comparison) -> NewGaussians:
    """The places that the pixels of a photograph agree with others about."""
    good = comparison.score > _ACCEPTED
    depth, rays, colors = comparison.depth[good], comparison.rays[good], comparison.colors[good]
    camera = comparison.camera
    pixels = comparison.share * camera.width * camera.height / max(len(comparison.samples), 1)  # of one sample
    return NewGaussians(
        points=comparison.center + depth[:, None] * rays,
        colors=colors,
        times=torch.full((len(depth),), comparison.time, dtype=torch.float64),
        velocities=comparison.velocity[good],
        accelerations=torch.zeros_like(comparison.velocity[good]),
        sizes=depth * (math.sqrt(pixels) / 2 / float(camera.K[0, 0])),
        confirmed=comparison.confirmed[good],
        photographs=int(good.any()),
    )


def agreed_trajectories(places: NewGaussians, extent: float, step: float) -> NewGaussians:
    """Places with the velocities and accelerations that those of times near theirs agree on.

    Each place predicts where it is at those times. What else is there then, of its color, is a measurement of how far
    the prediction is off: corrections of offset, velocity and acceleration are fitted to all of them, least squares
    with priors, and the offset is dropped, for what was measured is another place of the same thing. The next round
    finds what is there along the corrected trajectories.

    Args:
        places: What is known of each.
        extent: Extent of the scene, world units.
        step: Time between one photograph and the next.
    """
    with Bar("how it moves", _ROUNDS * len(places.times.unique())) as bar:
        for _ in range(_ROUNDS):
            places = _corrected(places, extent, step, bar)
    return places


def _corrected(places: NewGaussians, extent: float, step: float, bar: Bar) -> NewGaussians:
    """A round of `agreed_trajectories`; `bar` advances with each time."""
    velocities, accelerations = places.velocities.clone(), places.accelerations.clone()
    times = places.times
    late = _WINDOW * step
    # Of an offset, and of what velocity and acceleration come to at the end of the window, over the noise of a place.
    ratio = _REACH / _SPREAD
    prior = torch.tensor([1.0, ratio, ratio]).square().reciprocal().diag()
    for time in times.unique():
        there = ((times - time).abs() < late).nonzero()[:, 0]
        part = ((times[there] - time) / late).float()
        ahead = (part * late)[:, None]
        basis = torch.stack([torch.ones_like(part), part, part.square()], 1)
        each = torch.nn.functional.one_hot(torch.unique(times[there], return_inverse=True)[1])
        for here in (times == time).nonzero()[:, 0].split(_TOGETHER):
            bent = places.velocities[here][:, None] + 0.5 * ahead * places.accelerations[here][:, None]
            off = places.points[there][None] - (places.points[here][:, None] + ahead * bent)  # (here, there, 3)
            speed = places.velocities[here].norm(dim=1, keepdim=True)
            same = off.norm(dim=2) < _SPREAD * extent * 2 + _TURNED * speed * ahead[:, 0].abs()
            same &= torch.cdist(places.colors[here], places.colors[there]) < 2 * _COLOR
            # A time counts once: its photographs show one side of a thing, all places of which are off alike.
            counted = same.float() @ each.float() @ each.float().T
            weighted = (same / counted.clamp(min=1))[..., None] * basis
            normal = weighted.transpose(1, 2) @ basis + prior
            solved = torch.linalg.solve(normal, weighted.transpose(1, 2) @ off)
            velocities[here] += solved[:, 1] / late
            accelerations[here] += 2 * solved[:, 2] / late**2
        bar.advance()
    return places._replace(velocities=velocities, accelerations=accelerations)


def _reduced(frame: Frame) -> torch.Tensor:
    """(3, H, W) of a photograph, at the size at which photographs are compared."""
    width, height = reduced_size(frame.camera, _PIXELS)
    return interpolate(frame.image().permute(2, 0, 1)[None], (height, width), mode="area")[0]


def _backgrounds(frames: list[Frame]) -> list[torch.Tensor | None]:
    """(3, H, W) of each photograph, what its camera sees at most times; None where it took fewer than 4 from there."""
    groups: dict[bytes, list[int]] = {}
    for i, frame in enumerate(frames):
        camera = frame.camera
        key = np.concatenate([camera.w2c.ravel(), camera.K.ravel(), (camera.width, camera.height)])
        groups.setdefault(key.round(6).tobytes(), []).append(i)
    background: list[torch.Tensor | None] = [None] * len(frames)
    for listed in groups.values():
        if len(listed) >= _BACKGROUND_PHOTOGRAPHS:
            median = torch.stack([_reduced(frames[i]) for i in listed]).median(0).values
            for i in listed:
                background[i] = median
    return background


def _compared(
    frame: Frame,
    background: torch.Tensor | None,
    scene: Scene,
    origin: np.ndarray,
    settings: RenderSettings,
    generator: torch.Generator,
    shown: Callable[[Output, Frame], Output] | None,
) -> _Comparison:
    """A photograph beside its rendering, and the pixels whose depth is to be searched."""
    width, height = reduced_size(frame.camera, _PIXELS)
    camera = frame.camera.resized(width, height)
    image = _reduced(frame)
    with torch.no_grad():  # compared, not optimized
        out = render(colors_only(scene, camera.time), camera, settings, outputs=("depth",))
        if shown is not None:
            # What exposure does to a pixel depends on the photograph's, so that both have one size.
            mask, alpha = (None if x is None else averaged(x, (width, height)) for x in (frame.mask, frame.alpha))
            small = dataclasses.replace(frame, camera=camera, pixels=image.permute(1, 2, 0), mask=mask, alpha=alpha)
            out = shown(out, small)
    rgb = out.rgb.cpu().clamp(0, 1).permute(2, 0, 1)
    assert out.depth is not None  # an output of this rendering
    assert camera.time is not None  # a fit to what moves
    distance = torch.where(out.alpha.cpu() > _SOLID, out.depth.cpu(), torch.inf)
    rays = torch.from_numpy(camera.pixel_directions()).reshape(height, width, 3).float()
    if renders_z(settings):
        distance = distance / (rays @ torch.from_numpy(camera.c2w[:3, 2]).float())
    other = _is_other(image, rgb, background, frame.mask)
    where = other.nonzero()
    if len(where):
        where = where[torch.randperm(len(where), generator=generator)[:_SAMPLES]]
    rows, columns = where[:, 0], where[:, 1]
    moved = camera.relative_to(origin)
    return _Comparison(
        camera=moved,
        time=camera.time,
        maps=torch.cat([image, other.float()[None]]),
        distance=distance,
        samples=torch.stack([columns, rows], 1),
        rays=rays[rows, columns],
        colors=image[:, rows, columns].T.contiguous(),
        share=float(other.float().mean()),
        center=torch.from_numpy(moved.center).float(),
        depth=torch.zeros(len(where)),
        velocity=torch.zeros(len(where), 3),
        score=torch.zeros(len(where)),
        confirmed=torch.zeros(len(where)),
    )


def _is_other(
    image: torch.Tensor, rgb: torch.Tensor, background: torch.Tensor | None, mask: torch.Tensor | None
) -> torch.Tensor:
    """(H, W) bool, where a photograph shows something else than its rendering does, and than it does at most times.

    Args:
        image, rgb, background: (3, H, W) photograph, rendering, and what is seen from there at most times.
        mask: Of the photograph, of any size.
    """
    other = avg_pool2d((image - rgb).abs().mean(0)[None], 3, 1, 1)[0] > _DIFFERENCE
    if background is not None:
        other &= avg_pool2d((image - background).abs().mean(0)[None], 3, 1, 1)[0] > _DIFFERENCE
    if mask is not None:
        other &= interpolate(mask[None, None], other.shape, mode="area")[0, 0] > _SOLID
    # What is thinner than three pixels is an edge that is not sharp yet.
    core = -max_pool2d(-other.float()[None], 3, 1, 1)
    return (max_pool2d(core, 3, 1, 1)[0] > 0) & other


def _neighbors(i: int, comparisons: list[_Comparison], times: np.ndarray) -> list[int]:
    """Photographs that the pixels of one are compared with: of its time, and nearest in time."""
    apart = np.abs(times - times[i])
    centers = np.stack([comparison.camera.center for comparison in comparisons])
    beside = np.linalg.norm(centers - centers[i], axis=1)
    order = np.lexsort((beside, apart))
    same = [j for j in order if apart[j] == 0 and j != i][:_SAME_TIME]
    other = [j for j in order if apart[j] > 0][:_OTHER_TIMES]
    return [*same, *other]


def _search_round(
    iteration: int,
    comparison: _Comparison,
    neighbors: list[_Comparison],
    far: float,
    fastest: float,
    generator: torch.Generator,
) -> None:
    """Try other depths and velocities for the pixels of a photograph, and keep what agrees better."""
    x, y = comparison.samples[:, 0], comparison.samples[:, 1]
    end = comparison.distance[y, x].clamp(max=far)
    depth, velocity = _candidates(iteration, comparison, neighbors, end, fastest, generator)
    depth = torch.minimum(depth.clamp(min=1e-3 * far), end[:, None])
    score, confirmed = _agreement(comparison, depth, velocity, neighbors, fastest)
    best = score.argmax(1)
    rows = torch.arange(len(best))
    comparison.depth, comparison.velocity = depth[rows, best], velocity[rows, best]
    comparison.score, comparison.confirmed = score[rows, best], confirmed[rows, best]
    comparison.is_searched = True


def _candidates(
    iteration: int,
    comparison: _Comparison,
    neighbors: list[_Comparison],
    end: torch.Tensor,
    fastest: float,
    generator: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor]:
    """(S, T) depths and (S, T, 3) velocities that are tried: random ones up to a depth `end` (S,), and from the second
    round on those that are known, with a change and of other pixels.
    """
    samples = len(comparison.samples)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    randn = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    depths = [end[:, None] * (_LEAST_DEPTH + (1 - _LEAST_DEPTH) * rand(samples, _RANDOM))]
    speed = fastest * 10 ** (-_DECADES * rand(samples, _RANDOM, 1))
    speed = speed * (rand(samples, _RANDOM, 1) > _RESTING)
    direction = torch.nn.functional.normalize(randn(samples, _RANDOM, 3), dim=-1)
    velocities = [speed * direction]
    if comparison.is_searched:
        depth, velocity = comparison.depth[:, None], comparison.velocity[:, None]
        depths.append(depth)
        velocities.append(velocity)
        scale = _CHANGE * 0.5 ** (iteration - 1)
        depths.append(depth * (scale * randn(samples, _CHANGED)).exp())
        # Most changes of a velocity are small ones.
        change = scale * fastest * randn(samples, _CHANGED, 3)
        velocities.append(velocity + change * rand(samples, _CHANGED, 1) ** 3)
        others = torch.randint(samples, (samples, _NEIGHBORS), generator=generator)
        depths.append(comparison.depth[others])
        velocities.append(comparison.velocity[others])
        taken = _propagated(comparison, neighbors)
        if taken is not None:
            depths.append(taken[0])
            velocities.append(taken[1])
    return torch.cat(depths, 1), torch.cat(velocities, 1)


def _propagated(comparison: _Comparison, neighbors: list[_Comparison]) -> tuple[torch.Tensor, torch.Tensor] | None:
    """(S, T) depths and (S, T, 3) velocities that pixels of other photographs have, of those seen nearest to each."""
    points, velocities = [], []
    for other in neighbors:
        good = other.score > _PROPAGATED
        place = other.center + other.depth[:, None] * other.rays + other.velocity * (comparison.time - other.time)
        points.append(place[good])
        velocities.append(other.velocity[good])
    place, speed = torch.cat(points), torch.cat(velocities)
    projected, depth = comparison.camera.project(place.double().numpy())
    front = torch.from_numpy(depth > 0)
    if not front.any():
        return None
    place, speed, pixels = place[front], speed[front], torch.from_numpy(projected)[front]
    apart = torch.cdist(comparison.samples.double() + 0.5, pixels)
    nearest = apart.topk(min(_NEIGHBORS, len(place)), dim=1, largest=False).indices
    return (place[nearest] - comparison.center).norm(dim=-1), speed[nearest]


def _agreement(
    comparison: _Comparison,
    depth: torch.Tensor,
    velocity: torch.Tensor,
    neighbors: list[_Comparison],
    fastest: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """How well other photographs agree with depths (S, T) and velocities (S, T, 3) of the pixels of one.

    Returns:
        (S, T) part of the photographs that agree, of the same time where enough of these show the place, else of all;
        (S, T) the part of those of other times.
    """
    start = comparison.center + depth[..., None] * comparison.rays[:, None]
    agreed, shown = torch.zeros(2, *depth.shape), torch.zeros(2, *depth.shape)  # at the same time, at others
    for other in neighbors:
        is_later = int(other.time != comparison.time)
        place = start + velocity * (other.time - comparison.time)
        camera = other.camera
        pixels, ahead = camera.project(place.reshape(-1, 3).double().numpy())
        size = np.array([camera.width, camera.height])
        where = torch.from_numpy(2 * pixels / size - 1).float().reshape(*depth.shape, 2)
        inside = torch.from_numpy(ahead > 0).reshape(depth.shape) & (where.abs() < 1).all(-1)
        maps = torch.cat([other.maps, other.distance.clamp(max=_NO_SURFACE)[None]])[None]
        sampled = grid_sample(maps, where.nan_to_num(2.0).clamp(-2, 2)[None], align_corners=False)[0]
        away = (place - other.center).norm(dim=-1)
        inside &= sampled[4] > _OCCLUDED * away  # else something stands before it
        difference = (sampled[:3].permute(1, 2, 0) - comparison.colors[:, None]).square().sum(-1)
        same = sampled[3] * torch.exp(-0.5 * difference / _COLOR**2)
        agreed[is_later] += torch.where(inside, same, 0.0)
        shown[is_later] += inside
    # One more that does not agree: a place that many see is better than one that few do, where as large a part agrees.
    now, confirmed = agreed / (shown + 1)
    everything = torch.where(shown.sum(0) >= _FEWEST, agreed.sum(0) / (shown.sum(0) + 1), 0.0)
    score = torch.where(shown[0] >= _ENOUGH, now + _MINOR * confirmed, everything)
    return score - _MINOR * velocity.norm(dim=-1) / fastest, confirmed
