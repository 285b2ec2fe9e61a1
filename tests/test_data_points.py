"""Initial points: given, from depth, triangulated, random; and the views that they may look at."""

from __future__ import annotations

import dataclasses
import os
import re

import numpy as np
import pytest

import drgs
from drgs.cameras import Camera, intrinsics, look_at
from drgs.data import Dataset, View, load
from drgs.data.point_ply import read_point_ply
from drgs.fitting.active import ActiveViews
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import load_frames
from drgs.sfm import match_cache
from drgs.sfm.guided import Matches
from drgs.sfm.matching import nearby_pairs, sequential_pairs
from drgs.sfm.points import added_points, initial_points, shared_points
from drgs.sfm.proposals import propose_near_triangulated

cv2 = pytest.importorskip("cv2")
WIDTH, HEIGHT = 320, 240


def texture(rng) -> np.ndarray:
    """Blobs of several sizes: what SIFT finds."""
    layers = [
        cv2.resize(
            rng.uniform(0, 1, (n, n, 3)).astype(np.float32),
            (512, 512),
            interpolation=cv2.INTER_CUBIC,
        )
        for n in (16, 48, 128)
    ]
    image = sum(layers)
    return np.clip((image - image.min()) / np.ptp(image), 0, 1)


def render_plane(camera: Camera, image: np.ndarray, half: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """The textured square |x|, |y| <= half in the plane z = 0: image and z-depth (0 where
    missed).
    """
    directions = camera.pixel_directions()
    t = -camera.center[2] / directions[..., 2]
    points = camera.center + t[..., None] * directions
    u = ((points[..., :2] / half + 1) * 0.5 * 511).astype(np.float32)
    hit = (t > 0) & (np.abs(points[..., :2]) <= half).all(axis=-1)
    color = cv2.remap(image, u[..., 0].copy(), u[..., 1].copy(), cv2.INTER_LINEAR)
    depth = ((points - camera.center) @ camera.c2w[:3, 2]) * hit
    return color * hit[..., None], depth


def plane_views(folder, rng, count: int = 5, depth: bool = False, mask=None) -> list[View]:
    """Views of a textured square, with depth maps and masks if wanted."""
    image, views = texture(rng), []
    for index in range(count):
        angle = -0.3 + 0.6 * index / max(count - 1, 1)
        w2c = look_at((4 * np.sin(angle), -0.6, 4 * np.cos(angle)), (0, 0, 0), (0, 1, 0))
        # The principal point is off center on purpose.
        camera = Camera(intrinsics(300, 300, 150.5, 128.0), w2c, WIDTH, HEIGHT, name=f"{index}")
        color, z = render_plane(camera, image)
        path = folder / f"{index}.png"
        assert cv2.imwrite(str(path), np.round(color[..., ::-1] * 255).astype(np.uint8))
        view = View(camera, f"{index}", image_path=path)
        if depth:
            view.depth_path, view.depth_scale = folder / f"{index}_depth.png", 1e-3
            assert cv2.imwrite(str(view.depth_path), np.round(z * 1000).astype(np.uint16))
        if mask is not None:
            view.mask_path = folder / f"{index}_mask.png"
            inside = (z > 0) & (mask(camera, z)) if callable(mask) else mask
            assert cv2.imwrite(str(view.mask_path), inside.astype(np.uint8) * 255)
        views.append(view)
    return views


def test_given_points_come_first_and_are_thinned_by_seed(tmp_path, rng):
    """The data set knows best; the seed decides what is left out."""
    points, colors = rng.normal(size=(100, 3)), rng.uniform(size=(100, 3)).astype(np.float32)
    views = plane_views(tmp_path, rng, count=1)
    dataset = Dataset(tmp_path, "test", views, points, colors, "cloud, 100 points")
    got, got_colors, source = initial_points(dataset)
    np.testing.assert_array_equal(got, points)
    np.testing.assert_array_equal(got_colors, colors)
    assert source == "cloud, 100 points"
    few, _, source = initial_points(dataset, seed=3, max_points=10)
    assert (len(few), source) == (10, "cloud, 100 points, 10 kept")
    np.testing.assert_array_equal(few, initial_points(dataset, seed=3, max_points=10)[0])


def test_depth_maps_give_the_surface_with_its_colors(tmp_path, rng):
    """Points lie on the surface, where depth is known, and have the color they project to."""
    views = plane_views(tmp_path, rng, count=3, depth=True)
    points, colors, source = initial_points(views, max_points=3000)
    assert source == f"back-projected from 3 depth maps, holes filled, {len(points)} points"
    assert 1500 < len(points) <= 3000
    known = np.mean([(view.depth() > 0).mean() for view in views])
    assert known < 1  # around the square there is no depth: the nearest one stands in
    assert np.mean(np.abs(points[:, 2]) < 2e-3) > known - 0.02
    assert colors.dtype == np.float32
    # The colors are the picture's where the points project to.
    dense, dense_colors, _ = initial_points(views[:1], max_points=10**6)
    pixels, _ = views[0].camera.project(dense)
    columns, rows = pixels.astype(int).T
    np.testing.assert_allclose(views[0].image()[rows, columns], dense_colors, atol=1e-6)


def test_depth_respects_masks(tmp_path, rng):
    """Nothing comes from outside a mask."""
    left = np.zeros((HEIGHT, WIDTH), bool)
    left[:, :100] = True
    views = plane_views(tmp_path, rng, count=1, depth=True, mask=left)
    points, _, _ = initial_points(views)
    assert views[0].camera.project(points)[0][:, 0].max() <= 100


def on_plane(points) -> float:
    """The share of points that lie on the textured square, to 1 % of the cameras' distance."""
    return float(((np.abs(points[:, 2]) < 0.05) & (np.abs(points[:, :2]).max(axis=1) < 2.05)).mean())


def test_triangulates_with_the_given_poses(tmp_path, rng):
    """Points lie on the plane, in the given poses' frame."""
    stages = []
    views = plane_views(tmp_path, rng)
    points, colors, source = initial_points(views, progress=lambda *step: stages.append(step))
    found = int(re.match(r"triangulated from 5 given poses, (\d+) points", source).group(1))
    assert found >= 50
    assert np.median(np.abs(points[:found, 2])) < 0.01
    assert on_plane(points[:found]) > 0.98  # one match in a hundred is a chance one along its line
    assert (colors >= 0).all()
    assert (colors <= 1).all()
    assert ("features", 5, 5) in stages
    assert ("matching", 10, 10) in stages


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Where matches are kept; nothing yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "drgs" / "matches"


def matched(views) -> tuple[bool, list[np.ndarray]]:
    """Whether features were looked for, and the points."""
    stages = []
    points, colors, _ = initial_points(views, progress=lambda stage, *_: stages.append(stage))
    return "features" in stages, [points, colors]


def test_matches_are_kept(tmp_path, rng, cache):
    """The same photographs are matched once, with the same bits; other pixels, poses and masks are matched anew."""
    views = plane_views(tmp_path, rng, count=3)
    is_new, first = matched(views)
    assert is_new
    (file,) = cache.iterdir()
    is_new, again = matched(views)
    assert not is_new
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert matched(views[:2])[0]
    mask = tmp_path / "mask.png"
    assert cv2.imwrite(str(mask), np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert matched([dataclasses.replace(views[0], mask_path=mask), *views[1:]])[0]
    moved = look_at((0.1, -0.6, 4), (0, 0, 0), (0, 1, 0))
    assert matched([dataclasses.replace(views[0], camera=dataclasses.replace(views[0].camera, w2c=moved)), *views[1:]])[
        0
    ]
    image, status = cv2.imread(str(views[0].image_path)), views[0].image_path.stat()
    assert cv2.imwrite(str(views[0].image_path), 255 - image)
    os.utime(views[0].image_path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert matched(views)[0]
    assert len(list(cache.iterdir())) == 5
    assert file.is_file()


@pytest.mark.parametrize("damage", ["cut", "text", "foreign", "shape", "pipe"])
def test_kept_matches_that_are_damaged_are_not_used(tmp_path, rng, cache, damage):
    """They are found anew, without a word, and others' files beside them stay."""
    views = plane_views(tmp_path, rng, count=3)
    _, first = matched(views)
    (file,) = cache.iterdir()
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:-200])
    elif damage == "text":
        file.write_text("mine")
    elif damage == "foreign":
        np.savez(file, numbers=np.zeros(3))
    elif damage == "shape":
        np.savez(file, points=np.zeros((2, 3)), colors=np.zeros((2, 3), np.float32), shown=np.zeros((9, 1), np.uint8))
    else:
        file.unlink()
        os.mkfifo(file)
    (cache / "notes.txt").write_text("mine")
    is_new, again = matched(views)
    assert is_new
    np.testing.assert_array_equal(first[0], again[0])
    assert not matched(views)[0]
    assert (cache / "notes.txt").read_text() == "mine"


def test_kept_matches_are_bounded(tmp_path, rng, cache, monkeypatch):
    """Those used longest ago give way, and files of others do not; where nothing can be kept, a fit goes on."""
    views = plane_views(tmp_path, rng, count=2)
    assert matched(views)[0]
    (used,) = cache.iterdir()
    others = [cache / f"{number:040x}.npz" for number in range(3)]
    for age, path in enumerate([*others, cache / "notes.npz"]):
        path.write_bytes(bytes(1000))
        os.utime(path, (1000 - age, 1000 - age))
    os.utime(used, (1, 1))
    assert not matched(views)[0]  # used last now
    monkeypatch.setattr(match_cache, "_LARGEST", used.stat().st_size + 2000)
    match_cache._bound(cache)
    assert sorted(cache.iterdir()) == sorted([used, *others[:2], cache / "notes.npz"])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "0.png"))  # a file
    assert matched(views)[0]


def test_triangulates_views_far_apart(tmp_path, rng):
    """Two views 70 degrees apart: known poses say where to look for each feature's partner; guesses as far away make up
    for the few that there are.
    """
    image, views = texture(rng), []
    for index, angle in enumerate(np.radians([-35.0, 35.0])):
        w2c = look_at((4 * np.sin(angle), -0.6, 4 * np.cos(angle)), (0, 0, 0), (0, 1, 0))
        camera = Camera(intrinsics(300, 300, 150.5, 128.0), w2c, WIDTH, HEIGHT, name=f"{index}")
        views.append(View(camera, f"{index}", image_path=tmp_path / f"{index}.png"))
        color, _ = render_plane(camera, image)
        assert cv2.imwrite(str(views[-1].image_path), np.round(color[..., ::-1] * 255).astype(np.uint8))
    points, _, source = initial_points(views)
    found, total = re.fullmatch(
        r"triangulated from 2 given poses, (\d+) points; (\d+) with proposed ones where there are none", source
    ).groups()
    assert int(found) > 200
    assert on_plane(points[: int(found)]) > 0.9
    assert len(points) == int(total) >= 2000
    # Guesses are mostly around the square, where nothing matches, and not all as far away as what is beside them.
    assert np.median(np.abs(points[int(found) :, 2])) < 0.5
    assert len(initial_points(views, max_points=100)[0]) == 100


@pytest.mark.slow
def test_one_view_more_costs_its_own_pairs(tmp_path, rng):
    """What was found in earlier views is kept: the same points as from all at once, and only those that the last view
    shows; random ones after them.
    """
    views, matches, done = plane_views(tmp_path, rng, count=4), Matches(), []
    all_at_once, _, count = added_points(views, 0, Matches())
    added_points(views[:3], 0, matches)
    later, colors, found = added_points(views, 0, matches, lambda *step: done.append(step))
    assert ("features", 1, 1) in done
    assert ("matching", 3, 3) in done
    assert 200 < count == found < len(later)
    np.testing.assert_array_equal(later, all_at_once)
    assert on_plane(later[:found]) > 0.95 > on_plane(later[found:])
    assert np.median(np.abs(later[found:, 2])) < 0.3
    inside = views[3].camera.project(later[found:])[0]
    assert ((inside > 0) & (inside < (WIDTH, HEIGHT))).all(), "along rays of the last view"
    pixels, _ = views[3].camera.project(later[:found])
    columns, rows = pixels.astype(int).T
    # A track's color is the mean of its pictures', at features: edges, where half a pixel changes it.
    assert np.median(np.abs(views[3].image()[rows, columns] - colors[:found])) < 0.1


@pytest.mark.slow
def test_points_do_not_depend_on_how_many_views_came_at_once(tmp_path, rng, monkeypatch):
    """Where cameras are matched with the nearest ones only, those that were nearest before others came do not count:
    a fit that was killed and resumed, which matches all views at once, has the points of one that was not.
    """
    monkeypatch.setattr("drgs.sfm.points._MATCHED_NEIGHBORS", 1)
    views, matches = plane_views(tmp_path, rng, count=5), Matches()
    for count in (2, 4):
        added_points([views[i] for i in (0, 4, 1, 3, 2)[:count]], 0, matches)
    one_by_one = added_points([views[i] for i in (0, 4, 1, 3, 2)], 0, matches)
    at_once = added_points([views[i] for i in (0, 4, 1, 3, 2)], 0, Matches())
    assert one_by_one[2] == at_once[2] > 100
    np.testing.assert_array_equal(one_by_one[0], at_once[0])


def test_picked_views_bring_triangulated_points(tmp_path, rng):
    """A wall that hides everything, as random points may grow to, keeps no triangulated points out; views that are not
    picked are not read.
    """
    views = plane_views(tmp_path, rng, count=5)
    views[1].image_path.unlink()
    config = FitConfig().replace(max_pixels=10**6, max_gaussians=600, max_steps=10)
    plan = ActiveViews(views, config.replace(initial=2, add=1, every=1))
    plan.chosen.append(2)
    wall = drgs.Gaussians.from_arrays([[0.0, 0, 1.5]], [[1.0, 0, 0, 0]], [[9, 9, 0.1]], [0.99], np.zeros((1, 1, 3)))
    (frame,) = load_frames([views[2]], config.data.max_pixels)
    points, colors, dense = plan.points(frame, wall)
    assert not dense
    assert len(points) == len(colors) == 200
    assert on_plane(points.numpy()) > 0.95


def test_fits_begin_again_where_views_show_more(tmp_path, rng):
    """`auto` until a start has had 1,000 points, `always` wherever something matches, `never`, nor with points of the
    whole data set; what is recorded says so.
    """
    views = plane_views(tmp_path, rng, count=5)
    for view in views[:2]:  # nothing to match
        assert cv2.imwrite(str(view.image_path), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))

    def starts(restart, init_points="views"):
        config = FitConfig().replace(max_pixels=10**6, max_gaussians=3000, max_steps=10, init_points=init_points)
        plan = ActiveViews(views, config.replace(initial=2, add=3, every=1, restart=restart))
        plan.chosen, found = [0, 1], []
        for index in (2, 3, 4):
            plan.chosen.append(index)
            plan.picks.append({"index": index})
            start = plan.new_start()
            found.append(None if start is None else len(start[0]))
            if start is not None:
                assert len(start[0]) == len(start[1]) <= config.density.max_gaussians - plan.reserved
                assert float(start[0][:, 2].abs().median()) < 0.3
        return found, [pick.get("restarted") for pick in plan.picks], [pick.get("triangulated") for pick in plan.picks]

    found, told, count = starts("always")
    assert told == [False, True, True]
    assert count[0] == 0
    assert min(count[1:]) > 100
    assert found[0] is None
    assert starts("auto")[1] == [False, True, count[1] < 1000]
    assert starts("never") == starts("always", "all") == ([None] * 3,) * 3


def test_a_sure_start_asks_for_no_proposals(tmp_path, rng, monkeypatch):
    """Where the answer is to go on, only the count that is recorded is found, the same as ever."""
    views, config = (
        plane_views(tmp_path, rng, count=4),
        FitConfig().replace(max_pixels=10**6, max_gaussians=3000, max_steps=10),
    )

    def told(restart, began):
        plan = ActiveViews(views, config.replace(initial=2, add=2, every=1, restart=restart))
        plan.chosen, plan.picks, plan._began = [0, 1, 2], [{"index": 2}], began
        return plan.new_start() is not None, plan.picks[0]

    again, record = told("auto", 999)
    assert again
    assert record["restarted"]
    assert record["triangulated"] > 100
    monkeypatch.setattr("drgs.sfm.points.propose_near_triangulated", None)
    assert told("auto", 1000) == (False, record | {"restarted": False})


def test_triangulation_stays_inside_the_masks(tmp_path, rng):
    """Features outside the masks are dropped."""

    def left_half(camera, z):
        directions = camera.pixel_directions()
        t = -camera.center[2] / directions[..., 2]
        return (camera.center + t[..., None] * directions)[..., 0] < 0

    points, _, source = initial_points(plane_views(tmp_path, rng, mask=left_half))
    assert source.startswith("triangulated")
    assert np.quantile(points[:, 0], 0.98) < 0.0


def test_random_points_lie_in_the_common_view(tmp_path, rng):
    """Without texture: random, seen by several cameras, near the center."""
    views = plane_views(tmp_path, rng)
    for view in views:  # nothing to match
        assert cv2.imwrite(str(view.image_path), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    points, colors, source = initial_points(views, max_points=500)
    assert source == "random where 5 cameras look, 500 points (triangulation gave 0)"
    assert len(points) == 500
    np.testing.assert_allclose(colors, 128 / 255, atol=1e-6)
    seen = np.zeros(500)
    for view in views:
        pixels, _ = view.camera.project(points)
        seen += (pixels >= 0).all(axis=1) & (pixels < (WIDTH, HEIGHT)).all(axis=1)
    assert seen.min() >= 2
    assert np.linalg.norm(np.median(points, axis=0)) < 1.5


def test_points_of_a_view_list_read_only_these_views(tmp_path, rng):
    """An active run must not touch the files of other views."""
    views = plane_views(tmp_path, rng, count=3, depth=True)
    views[2].image_path.unlink()
    views[2].depth_path.unlink()
    points, _, source = initial_points(views[:2], max_points=100)
    assert len(points) <= 100
    assert "2 depth maps" in source
    with pytest.raises(ValueError, match="there must be at least one view, got none"):
        initial_points([])


def test_pairs():
    """Neighbors in time and in space."""
    assert sequential_pairs(list("abcd"), 1) == [
        ("a", "b"), ("a", "c"), ("b", "c"), ("b", "d"), ("c", "d")
    ]  # fmt: skip
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    outward = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    pairs = nearby_pairs(4 * outward, -outward, 2)
    assert pairs == sorted({tuple(sorted((i, (i + 1) % 12))) for i in range(12)})
    assert len(nearby_pairs(4 * outward[:4], -outward[:4], 5)) == 6


def test_real_office_depth_agrees_between_views(data_dir):
    """One view's depth predicts another's."""
    if not (data_dir / "office").is_dir():
        pytest.skip(f"no office data set in {data_dir}")
    views = load(data_dir / "office").views
    assert len(views) == 47
    # Two views of one place, a step apart: the depth of one predicts the other's.
    first, second = views[33], views[34]
    points, _, _ = initial_points([first], max_points=20_000)
    pixels, z = second.camera.project(points)
    inside = (pixels >= 0).all(axis=1) & (pixels < (540, 360)).all(axis=1)
    columns, rows = pixels[inside].astype(int).T
    depth = second.depth()[rows, columns]
    known = depth > 0
    error = np.abs(depth[known] - z[inside][known])
    assert known.sum() > 2000
    assert np.median(error) < 0.05


def test_real_banana_and_head_load(data_dir):
    """Real COLMAP and transforms data sets load."""
    for name, kind, count in (("banana", "colmap", 14), ("head", "transforms", 33)):
        if not (data_dir / name).is_dir():
            pytest.skip(f"no {name} data set in {data_dir}")
        dataset = load(data_dir / name)
        assert (dataset.format, len(dataset.views)) == (kind, count)
        assert dataset.views[0].image(90, 60).shape == (60, 90, 3)
    assert 0.1 < dataset.views[0].mask(90, 90).mean() < 0.9


def test_guesses_are_as_far_away_as_what_is_beside_them(tmp_path, rng):
    """Two walls, left 2 and right 6 away: each pixel gets the distance of its side; a view that shows none of them gets
    both; a masked pixel gets none, nor does a cell with a triangulated point.
    """
    camera = Camera(intrinsics(300, 300, 150.5, 128.0), np.eye(4), WIDTH, HEIGHT)
    views = []
    for index in range(2):
        path, mask = tmp_path / f"{index}.png", tmp_path / f"{index}_mask.png"
        assert cv2.imwrite(str(path), rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
        inside = np.full((HEIGHT, WIDTH), 255, np.uint8)
        inside[:50] = 0
        assert cv2.imwrite(str(mask), inside)
        views.append(View(camera, f"{index}", image_path=path, mask_path=mask))
    at = rng.uniform((0, 50), (WIDTH, HEIGHT), (60, 2))
    near = at[:, 0] < WIDTH / 2
    depth = np.where(near, 2.0, 6.0)
    points = np.c_[(at - (150.5, 128.0)) / 300 * depth[:, None], depth]
    shown = np.stack([np.ones(60, bool), np.zeros(60, bool)])
    found, colors = propose_near_triangulated(views, points, shown, 1000, rng)
    pixels, z = camera.project(found)
    assert len(found) == len(colors) == 1000
    assert pixels[:, 1].min() >= 50

    def cell(places):
        return [tuple(c) for c in (places // (WIDTH // 16, HEIGHT // 16)).astype(int)]

    # The first view has fewer open cells than the second, of which it shows no point.
    centers = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(50, HEIGHT)), axis=-1).reshape(-1, 2) + 0.5
    taken = set(cell(at))
    open_pixels = sum(c not in taken for c in cell(centers))
    first = int(1000 * open_pixels / (open_pixels + len(centers)))
    assert 200 < first < 500
    left = pixels[:first, 0] < WIDTH / 2
    far = np.abs(pixels[:first, 0] - WIDTH / 2) > 60  # from the edge between the walls
    assert (np.abs(np.log(z[:first] / np.where(left, 2.0, 6.0)))[far] < 0.3).all()
    assert not taken & set(cell(pixels[:first]))
    assert taken & set(cell(pixels[first:]))
    assert np.mean(z[first:] < 4) == pytest.approx(near.mean(), abs=0.1)
    columns, rows = pixels.astype(int).T
    np.testing.assert_allclose(views[0].image()[rows[:first], columns[:first]], colors[:first], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ((b"0 255 0 0\n", b"0 -1 0 0\n"), "out of bounds|out of range"),
        ((b"end_header", b"element face 4000000000\nend_header"), "'face' of a PLY must have a property"),
        ((b"element vertex", b"element face 4000000000\nelement vertex"), "'face' of a PLY must have a property"),
        ((b"format ascii", b"format " + b"x" * 9999), "header must be well-formed, got .{9,100}$"),
    ],
)
def test_damaged_point_clouds(tmp_path, change, told):
    """Numbers that are none of their type, rows that take no byte, words of any length: one line of bearable length."""
    columns = "".join(f"property {kind}\n" for kind in ("float x", "float y", "float z", "uchar red", "uchar green"))
    head = f"ply\nformat ascii 1.0\nelement vertex 1\n{columns}property uchar blue\nend_header\n"
    path = tmp_path / "points.ply"
    path.write_bytes(head.encode() + b"1 2 0 255 0 0\n")
    assert read_point_ply(path)[1].tolist() == [[1, 0, 0]]
    path.write_bytes(path.read_bytes().replace(*change))
    with pytest.raises(ValueError, match=told) as error:
        read_point_ply(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("kind", ["float", "f4"])
def test_headers_as_programs_write_them(tmp_path, newline, kind):
    """All line ends, also where the data begins like one, NumPy's names of types, control characters in comments."""
    lines = ["ply", "format binary_little_endian 1.0", "comment a\fb", "element vertex 1"]
    lines += [*(f"property {kind} {axis}" for axis in "xyz"), "end_header", ""]
    point = np.frombuffer(b"\n\n\n?" * 3, "<f4")
    (tmp_path / "points.ply").write_bytes(newline.join(lines).encode() + point.tobytes())
    assert read_point_ply(tmp_path / "points.ply")[0][0].tolist() == point.tolist()


def test_what_is_hidden_is_not_shared(tmp_path, rng):
    """Points on both sides of a slab, with tracks of one to three photographs of their side: all of this side show
    them, and those of the other side do not, where projections alone would be inside the picture.
    """
    views = []
    for i in range(6):
        eye = (0.1 * (i % 3), 0.0, 4.0 if i < 3 else -4.0)
        camera = Camera(intrinsics(300, 300, 160, 120), look_at(eye, (0, 0, 0), (0, 1, 0)), WIDTH, HEIGHT)
        views.append(View(camera, f"{i}"))
    points = np.concatenate([rng.uniform(-1, 1, (400, 2)), np.repeat([0.5, -0.5], 200)[:, None]], axis=1)
    tracks = {f"{i}": np.arange(0, 200, 1 + i % 3) + (0 if i < 3 else 200) for i in range(6)}
    got, shown = shared_points(Dataset(tmp_path, "colmap", views, points, tracks=(points, tracks)), views)
    np.testing.assert_array_equal(got, points)
    assert min(shown[:3, :200].mean(), shown[3:, 200:].mean()) > 0.75  # their own tracks: 0.61
    assert not shown[:3, 200:].any()
    assert not shown[3:, :200].any()


def test_depth_maps_say_what_is_hidden(tmp_path, rng):
    """A square that five depth maps agree about, and one map that sees something nearer in front of all of it."""
    views = plane_views(tmp_path, rng, depth=True)
    views[2].depth_scale /= 2
    points, shown = shared_points(Dataset(tmp_path, "transforms", views), views)
    nearer = np.abs(points[:, 2]) > 0.5
    assert 0.1 < nearer.mean() < 0.3
    assert not shown[2, ~nearer].any()
    assert shown[np.ix_([0, 1, 3, 4], ~nearer)].mean() > 0.9
    assert not shown[np.ix_([0, 1, 3, 4], nearer)].any()


def test_nothing_is_shared_where_nobody_knows(tmp_path, rng):
    """Points without tracks, as of a PLY file, and no matches: photographs are not compared by what may be hidden."""
    views = plane_views(tmp_path, rng, count=2)
    assert shared_points(Dataset(tmp_path, "transforms", views, np.zeros((3, 3))), views) is None
    assert shared_points(Dataset(tmp_path, "llff", views), views, matches=Matches())[1].sum() > 50


def test_given_points_get_guesses_where_there_are_none(tmp_path, rng):
    """Of a square whose model has points on its left alone, as of a clock on a white wall: guesses on its right, as far
    away, from the training views; without tracks, or views that may be read, the model's points are all there is.
    """
    views = plane_views(tmp_path, rng)
    points = np.stack([rng.uniform(-1.5, -0.2, 300), rng.uniform(-1, 1, 300), np.zeros(300)], axis=1)
    model = Dataset(
        tmp_path,
        "colmap",
        views,
        points,
        point_source="model",
        tracks=(points, {v.name: np.arange(300) for v in views}),
    )
    got, colors, source = initial_points(model, max_points=3000, train=views[1:])
    assert len(got) == len(colors)
    np.testing.assert_array_equal(got[:300], points)
    right = got[300:][got[300:, 0] > 0]
    assert len(right) > 300
    assert np.median(np.abs(right[:, 2])) < 0.3
    assert source == f"model; {len(got)} with proposed ones where there are none"
    few = initial_points(model, max_points=100, train=views)[0]
    assert len(few) <= 100
    model.tracks = None
    np.testing.assert_array_equal(initial_points(model, max_points=3000, train=views)[0], points)
