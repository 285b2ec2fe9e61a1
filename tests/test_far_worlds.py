"""A scene at map coordinates, millions of units from 0, is what it is near 0, but for where it stands.

Means are relative to the origin of the Gaussians; cameras and all places that a user reads are in the world. What a
format or a page holds is relative to that origin, and says so.
"""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from test_share import told, viewer  # noqa: F401 (a fixture)

import drgs
from drgs import fisher, reference
from drgs.cameras import Camera, intrinsics, look_at
from drgs.data.camera_lists import camera_from_json, camera_to_json
from drgs.ellipsoids import Gaussians
from drgs.select import Refine, Scoring, select
from drgs.settings import RenderSettings

PLACES = {"utm": np.array([500000.0, 5400000.0, 120.0]), "far": np.array([5e6, -3e6, 120.0])}
FAR = PLACES["far"]
FAST = RenderSettings.preset("fast")


def shell(count: int = 150, seed: int = 0) -> Gaussians:
    """Gaussians on a sphere of radius 0.8 around their origin."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Gaussians.from_arrays(
        (0.8 * normals).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.uniform(0.08, 0.3, (count, 3)).astype(np.float32),
        rng.uniform(0.3, 0.95, count).astype(np.float32),
        (0.3 * rng.normal(size=(count, 4, 3))).astype(np.float32),
    )


def around(count: int, place: np.ndarray | None = None, size: int = 24, seed: int = 1) -> list[Camera]:
    """Cameras about 3 away from a place, that of 0, which look at it."""
    rng = np.random.default_rng(seed)
    K = intrinsics(1.1 * size, 1.1 * size, size / 2, size / 2)
    cameras = []
    for k in range(count):
        eye = rng.normal(size=3)
        eye *= 3 * rng.uniform(0.9, 1.2) / np.linalg.norm(eye)
        camera = Camera(K, look_at(eye, 0.1 * rng.normal(size=3), (0, -1, 0.01)), size, size, name=f"c{k:02d}")
        cameras.append(camera if place is None else camera.relative_to(-place))
    return cameras


def turned(angle: float) -> np.ndarray:
    """(4, 4) of a turn about y, radians."""
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    return turn


def ring(count: int, place: np.ndarray | None = None) -> list[Camera]:
    """Cameras evenly around a place, that of 0: pairs of them differ in x by rounding alone."""
    cameras = drgs.cameras.orbit((0, 0, 0), 3.0, count, 20.0, width=16, height=16)
    return cameras if place is None else [camera.relative_to(-place) for camera in cameras]


def rolling(camera: Camera, angle: float = 0.15) -> Camera:
    """The camera, turned by an angle (radians) and moved a bit while its image is exposed."""
    turn = turned(angle)
    turn[:3, 3] = 0.1, 0.05, 0.02
    return dataclasses.replace(camera, shutter="rolling_top_to_bottom", w2c_end=turn @ camera.w2c)


def psnr(a, b) -> float:
    error = np.mean((np.asarray(a, float) - np.asarray(b, float)) ** 2)
    return float(-10 * np.log10(max(error, 1e-20)))


def poses(camera: Camera) -> np.ndarray:
    return np.stack([camera.w2c, camera.w2c_end]) if camera.is_rolling else camera.w2c


# -------------------------------------------------- cameras


@pytest.mark.core
@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_a_camera_relative_to_a_place_stands_where_it_stood(place):
    for camera in (around(1)[0], rolling(around(1)[0])):
        far = camera.relative_to(-place)
        assert far.center == pytest.approx(camera.center + place, abs=3e-9)
        assert np.abs(poses(far.relative_to(place)) - poses(camera)).max() < 3e-9
        assert camera.relative_to(np.zeros(3)) is camera
        read = camera_from_json("a file", json.loads(json.dumps(camera_to_json(far))))
        assert read.center == pytest.approx(far.center, abs=3e-9)


@pytest.mark.core
def test_gradients_pass_to_a_pose_that_is_a_tensor():
    camera = around(1, FAR)[0]
    pose = torch.tensor(np.array(camera.w2c), requires_grad=True)
    near = dataclasses.replace(camera, w2c=pose).relative_to(FAR).w2c
    near[0, 3].backward()  # by the first row of w2c: the place, and 1
    assert pose.grad[0].tolist() == [*FAR, 1.0]


@pytest.mark.parametrize("preset", ["exact", "3dgut"])
def test_a_rolling_shutter_shows_the_same_picture(preset):
    """Poses between two are interpolated about the Gaussians' origin: about a 0 so far away, the camera would leave its
    way by 16,000 units."""
    settings = RenderSettings.preset(preset)
    g, camera = shell(60), rolling(around(1, size=16)[0])
    moved, far = g.replace(origin=FAR), camera.relative_to(-FAR)
    near = drgs.render(g, camera, settings).rgb
    assert psnr(drgs.render(moved, far, settings).rgb, near) > 80
    assert psnr(reference.render(moved, far, settings).rgb, near) > 80
    twist = {"camera": torch.eye(6, dtype=torch.float64)[3:]}  # translations are the same in both worlds
    slopes = [drgs.render_jvp(*pair, twist, settings, outputs=()).rgb for pair in ((g, camera), (moved, far))]
    assert psnr(slopes[1], slopes[0]) > 80


# -------------------------------------------------- information and picks


@pytest.mark.parametrize("policy", ["fisher", "fisherrf", "coverage", "moments", "farthest", "uniform"])
def test_picks_and_scores_are_the_same(policy):
    g, cameras = shell(), around(12)
    near = select(g, cameras[3:], cameras[:3], 3, policy, settings=FAST)
    for place in PLACES.values():
        moved = around(12, place)
        far = select(g.replace(origin=place), moved[3:], moved[:3], 3, policy, settings=FAST)
        assert [pick.index for pick in far.picks] == [pick.index for pick in near.picks]
        assert np.allclose(far.scores, near.scores, rtol=1e-6)


def test_unknown_poses_and_backdrops_are_the_same():
    """More candidates than those whose depth says where the backdrop is, and each view's own pose eliminated."""
    scoring = Scoring(
        settings=FAST, blocks=("geometry", "backdrop"), nuisances=fisher.Nuisances(eliminate=("pose", "exposure"))
    )
    g, cameras, moved = shell(60), ring(20), ring(20, FAR)
    near = select(g, cameras[2:], cameras[:2], 2, scoring=scoring)
    far = select(g.replace(origin=FAR), moved[2:], moved[:2], 2, scoring=scoring)
    assert [pick.index for pick in far.picks] == [pick.index for pick in near.picks]
    assert np.allclose(far.scores, near.scores, rtol=1e-5)


def test_ties_go_to_the_lower_index_far_away():
    """Cameras of a regular ring, and several of them in each place: only rounding tells them apart."""
    for times in (None, [0.0, 1.0]):
        pools = [
            [dataclasses.replace(c, time=times and times[k]) for c in ring(8, place) for k in range(2)]
            for place in (None, FAR)
        ]
        near, moved = (select(shell(1), pool[1:], pool[:1], 8, "farthest") for pool in pools)
        assert [pick.index for pick in moved.picks] == [pick.index for pick in near.picks]


def test_a_pick_is_moved_to_the_same_place():
    g, refine = shell(), Refine(evaluations=8)
    found = []
    for place in (np.zeros(3), FAR):
        # Two views in each place: how far one moves is of the places, which rounding must not split.
        cameras = around(6)
        cameras += [dataclasses.replace(c, w2c=turned(0.1) @ c.w2c, name=c.name + "x") for c in cameras]
        cameras = [camera.relative_to(-place) for camera in cameras]
        pick = select(g.replace(origin=place), cameras[2:], cameras[:2], 1, settings=FAST, refine=refine).picks[0]
        found.append((pick.index, pick.score, pick.camera.relative_to(place).w2c))
    assert found[1][0] == found[0][0]
    assert found[1][1] == pytest.approx(found[0][1], rel=1e-4)
    assert np.abs(found[1][2] - found[0][2]).max() < 1e-4


def test_pose_information_is_about_the_origin():
    near = fisher.pose_information(shell(), around(1)[0], FAST)
    far = fisher.pose_information(shell().replace(origin=FAR), around(1, FAR)[0], FAST)
    assert torch.allclose(far, near, rtol=1e-5, atol=1e-5 * float(near.abs().max()))


def test_a_moving_scene_is_the_same():
    from drgs.deform import DeformationField, DynamicGaussians, FieldConfig

    config = FieldConfig(resolution=8, time_resolution=4, levels=(1,), channels=2, width=8, last_std=0.1)
    seen = []
    for place in (np.zeros(3), FAR):
        field = DeformationField(config, np.array([[-1.0, -1, -1], [1, 1, 1]]) + place)
        scene = DynamicGaussians(shell(60).replace(origin=place), field)
        cameras = [dataclasses.replace(c, time=k / 3) for k, c in enumerate(around(4, place, size=12))]
        scoring = Scoring(settings=FAST, blocks=("geometry", "deformation"))
        chosen = select(scene, cameras[2:], cameras[:2], 1, scoring=scoring)
        seen.append((drgs.render(scene, cameras[3], FAST).rgb.detach(), chosen.scores))
    assert psnr(seen[1][0], seen[0][0]) > 80
    assert np.allclose(seen[1][1], seen[0][1], rtol=1e-5)


def test_a_worker_gets_the_origin():
    pytest.importorskip("cloudpickle")
    from drgs.cluster.payloads import Payload, keep, opened_payload

    payload = Payload.of(shell(3).replace(origin=FAR))
    for piece in payload.pieces():
        keep(*piece)
    assert opened_payload(payload.digest).origin.tolist() == FAR.tolist()


def test_a_planner_plans_the_same(tmp_path):
    plans = []
    for place in (np.zeros(3), FAR):
        cameras = around(8, place)
        planner = drgs.Planner(scene=shell().replace(origin=place))
        for camera in cameras[:3]:
            planner.observe(None, camera)
        planner.scores(cameras[3:])
        planner.save(tmp_path / "planner.safetensors")
        loaded = drgs.Planner.load(tmp_path / "planner.safetensors")
        assert loaded.scene.origin.tolist() == place.tolist()
        plans.append(loaded.next(2))
        assert plans[-1].picks[0].camera.center == pytest.approx(cameras[3 + plans[-1].picks[0].index].center, abs=3e-9)
    assert [pick.index for pick in plans[1].picks] == [pick.index for pick in plans[0].picks]
    assert np.allclose(plans[1].scores, plans[0].scores, rtol=1e-5)


def test_places_for_photographs_are_the_same():
    from drgs.capturing.places import places_around
    from drgs.meshing.depths import seen_distance

    found = []
    for place in (np.zeros(3), FAR):
        g = shell().replace(origin=place)
        means = g.means.double().numpy() + g.origin
        up = np.array([0.0, -1.0, 0.0])
        found.append(places_around(around(6, place), up, seen_distance(g), means))
        assert max(np.linalg.norm(one.origin - place) for one in found[-1]) < 4  # in the world
    assert [one.words() for one in found[1]] == [one.words() for one in found[0]]
    apart = [b.camera.center - FAR - a.camera.center for a, b in zip(*found, strict=True)]
    assert np.abs(apart).max() < 1e-5


# -------------------------------------------------- other people's rasterizers


def single(**arguments):
    """Ours as a rasterizer that takes float32, whatever it is given."""
    return drgs.rasterization(**{k: x.float() if isinstance(x, torch.Tensor) else x for k, x in arguments.items()})


def test_a_function_gets_what_float32_holds():
    g, cameras = drgs.testing.random_scene(0, 40, 24, 20)
    far = [camera.relative_to(-FAR) for camera in cameras]
    from drgs.lab.crossval import crossval
    from drgs.lab.rasterizers import function

    fields = {"background": (0.2, 0.4, 0.7)}
    result = crossval(function(single, "single"), g.replace(origin=FAR), far, "gsplat", fields, paths=False, channels=0)
    assert result.verdict == "agreement", result.lines()


def test_an_export_says_its_offset(tmp_path):
    from drgs.lab.rasterizers import export, is_export

    g, cameras = drgs.testing.random_scene(0, 40, 24, 20)
    far = [camera.relative_to(-FAR) for camera in cameras]
    export(tmp_path / "near.npz", g, cameras, (0, 0, 0), 0)
    export(tmp_path / "far.npz", g.replace(origin=FAR), far, (0, 0, 0), 0)
    near, moved = np.load(tmp_path / "near.npz"), np.load(tmp_path / "far.npz")
    assert set(moved.files) - set(near.files) == {"offset"}
    assert moved["offset"].tolist() == FAR.tolist()
    for name in ("means", "viewmat"):
        assert np.abs(moved[name] - near[name]).max() < 1e-6
    assert is_export(tmp_path / "near.npz")
    assert is_export(tmp_path / "far.npz")


def test_mitsuba_gets_what_float32_holds():
    from drgs import plugin, runtime  # noqa: F401 - the plugin registers the integrator
    from drgs.ellipsoids import ellipsoids_shape

    mi = runtime.mitsuba()

    def shown(g: Gaussians, camera: Camera) -> np.ndarray:
        sensor = camera.to_mitsuba()
        sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}
        scene = {"type": "scene", "integrator": {"type": "drgs"}, "shape": ellipsoids_shape(g), "sensor": sensor}
        return np.array(mi.render(mi.load_dict(scene), spp=1))

    near = shown(shell(60), around(1, size=16)[0])
    far = around(1, FAR, size=16)[0]
    with pytest.warns(UserWarning, match=r"relative to the Gaussians' origin 5000000 -3000000 120.*relative_to"):
        moved = shown(shell(60).replace(origin=FAR), far.relative_to(FAR))
    assert psnr(moved, near) > 80


# -------------------------------------------------- meshes, pages and charts


@pytest.fixture(scope="module")
def meshes():
    pytest.importorskip("skimage")
    from drgs.meshing.extraction import mesh_of
    from drgs.meshing.options import MeshOptions

    options = MeshOptions(voxel=0.2, crop=0.0)
    near = mesh_of(shell(), around(6), FAST, options)
    return near, mesh_of(shell().replace(origin=FAR), around(6, FAR), FAST, options)


def test_a_mesh_is_the_same_around_its_origin(meshes):
    near, far = meshes
    assert near.origin.tolist() == [0, 0, 0]
    assert far.origin.tolist() == FAR.tolist()
    assert far.faces.shape == near.faces.shape
    assert np.abs(far.vertices - near.vertices).max() < 1e-4


def test_a_lattice_that_ends_before_the_surface_is_one_line():
    """Of depth images whose cameras nobody moved, or of float64 means without an origin."""
    pytest.importorskip("skimage")
    from drgs.meshing.extraction import mesh_of
    from drgs.meshing.options import MeshOptions

    g = shell()
    g = g.replace(means=g.means.double() + torch.from_numpy(FAR))
    with pytest.raises(ValueError, match=r"within 2\^24 voxels of 0.1 from 0.*give the Gaussians an origin"):
        mesh_of(g, around(3, FAR), FAST, MeshOptions(voxel=0.1, crop=0.0))


@pytest.mark.parametrize(
    ("suffix", "said"),
    [
        (".ply", "comment offset 5000000 -3000000 120\n"),
        (".obj", "# offset 5000000 -3000000 120\n"),
        (".glb", '"offset":[-5000000.0,3000000.0,120.0]'),  # in the axes of glTF
    ],
)
def test_a_file_of_a_mesh_says_its_offset(suffix, said, meshes, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    from drgs.meshing.writing import save_mesh

    for name, mesh in zip(("near", "far"), meshes, strict=True):
        path = tmp_path / f"{name}{suffix}"
        save_mesh(mesh, path)
        assert (said.encode() in path.read_bytes()) == (name == "far")
        read = trimesh.load(path, force="mesh", process=False, maintain_order=True)
        turn = np.array([-1, -1, 1]) if suffix == ".glb" else 1
        assert np.abs(read.vertices * turn - mesh.vertices).max() < 1e-5


def test_a_page_is_the_same_but_for_its_offset(viewer, tmp_path):  # noqa: F811
    from drgs.commands.orbits import scene_orbit
    from drgs.pages.sharing.scene import scene_of_file
    from drgs.pages.sharing.write import write_page

    pages = []
    for place in (np.zeros(3), FAR):
        g = shell(40, seed=3).replace(origin=place)
        shared = scene_of_file(g, "a scene", lambda g: scene_orbit(g, 1, width=32, height=24)[0])
        write_page(shared, tmp_path / "page.html")
        page = told(tmp_path / "page.html")
        assert page.pop("offset") == place.tolist()
        text = (tmp_path / "page.html").read_text()
        assert ("Positions are relative to the offset 5000000 -3000000 120." in text) == bool(place.any())
        pages.append(page)
    near, far = ([page[name] for page in pages] for name in ("photos", "target"))
    assert near[1][0]["pose"] == pytest.approx(near[0][0]["pose"], abs=1e-6)
    assert far[1] == pytest.approx(far[0], abs=1e-6)
    assert pages[1]["far"] == pytest.approx(pages[0]["far"])


def test_a_map_of_cameras_has_ticks_of_its_own_size():
    pytest.importorskip("matplotlib")
    from drgs.pages.report.charts import camera_map

    cameras = around(5, FAR)
    way = (cameras[4], cameras[0].center, "1")
    drawn = camera_map({"fitted": cameras[:3]}, [(cameras[3], "1")], [way])
    assert "from above, around 5000" in drawn
    assert "1e" not in drawn.partition("from above")[0].rpartition("<text")[2]


def test_an_orbit_is_the_same_and_says_where():
    from drgs.commands.orbits import capture_orbit

    lines = []
    orbits = []
    for place in (None, FAR):
        cameras, text = capture_orbit(around(8, place), 4, width=32, height=24)
        orbits.append([camera.relative_to(FAR if place is not None else np.zeros(3)).w2c for camera in cameras])
        lines.append(text)
    assert np.abs(np.array(orbits[1]) - orbits[0]).max() < 1e-6
    shown = [float(x) for x in lines[1].partition("(")[2].partition(")")[0].split(",")]
    near = [float(x) for x in lines[0].partition("(")[2].partition(")")[0].split(",")]
    assert np.abs(np.array(shown) - FAR - near).max() < 0.02  # three digits of the distance
