"""Free poses: where cameras stand and look in each scene, at their times; the data sets that are made of them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from json_page import OF_CAPTURE
from json_page import check as check_page

from drgs import cli, scenes
from drgs.data import load
from drgs.scenes import filmed, hall, kitchen, labelled, output, room, still_life
from drgs.scenes.free_poses import CLEARANCE, distances, free_poses

VIEWS = 32
PLAYS = {"hall": hall.PLAY, "kitchen": kitchen.PLAY}


@pytest.fixture(scope="module")
def built():
    """Name -> the Mitsuba scene of seed 0 (of what moves its stage), and the box in which its cameras are."""
    material = scenes.material
    with pytest.MonkeyPatch.context() as patch:  # nothing shines: tables of glossy materials take seconds
        patch.setattr(scenes, "material", lambda bsdf, *rest: material({"type": "diffuse"}, *rest))
        still = {"room": (room.scene(0)[0], room.Layout(0).box), "still_life": (still_life._scene(0), still_life._BOX)}
        return still | {name: (filmed.Stage(play, 0), play.box) for name, play in PLAYS.items()}


def check(scene, box, poses):
    """Assert that poses are free; returns which are 20 cm in front of something."""
    eyes, forward = poses[:, :3, 3], poses[:, :3, 2]
    assert ((eyes > box[0]) & (eyes < box[1])).all()
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)
    around = [distances(scene, eye) for eye in eyes]
    nearest = np.array([distance.min() for distance, _ in around])
    ahead = np.array([distances(scene, eye, way[None])[0][0] for eye, way in zip(eyes, forward, strict=True)])
    assert np.isfinite(ahead).all()
    is_near = np.abs(ahead - 0.2) < 1e-3
    assert (nearest[~is_near] > CLEARANCE).all()
    assert (nearest > 0.1).all()
    assert min((is_front | np.isinf(distance)).mean() for distance, is_front in around) > 0.9  # in no thing
    return is_near


@pytest.mark.parametrize("name", ["room", "still_life", *PLAYS])
def test_cameras_stand_anywhere_and_look_anywhere(name, built):
    """In the scene, not in a thing; about a third 20 cm in front of one, the others 35 cm from everything."""
    scene, box = built[name]
    scene = getattr(scene, "scene", scene)
    poses = free_poses(scene, box, VIEWS, np.random.default_rng(3))
    assert np.array_equal(poses, free_poses(scene, box, VIEWS, np.random.default_rng(3)))
    assert 0.15 < check(scene, box, poses).mean() < 0.5
    if name in ("room", "still_life"):  # others are open on one side
        assert np.linalg.norm(poses[:, :3, 2].mean(0)) < 0.4  # in all directions
    assert np.ptp(poses[:, :3, 3], axis=0).min() > 0.3


@pytest.mark.parametrize("name", PLAYS)
def test_photographs_of_what_moves(name, built, tmp_path, monkeypatch):
    """Each has a time and a pose that is free then, labels of that time; every eighth is held out; resuming works."""
    stage, box = built[name]
    monkeypatch.setattr(filmed, "Stage", lambda play, seed: stage)
    command = ["scene", name, "--free", "--cameras", "10", "--times", "3", "--size", "32x24", "--spp", "1"]
    command += ["--teacher-size", "8x6", "--quiet", "-o"]
    assert cli.main([*command, str(tmp_path / "a")]) == 0
    params = json.loads((tmp_path / "a" / "params.json").read_text())
    assert params["free"] is True
    check_page("params.json", params, absent=("depth_unit", "test_every", "views", *OF_CAPTURE))
    dataset = load(tmp_path / "a")
    assert dataset.is_dynamic
    assert [view.name for view in dataset.split()[1]] == ["rgb_000", "rgb_008"]
    assert set(dataset.semantics.moving) == set(PLAYS[name].moving)
    K = labelled.intrinsics(32, 24, PLAYS[name].fov_x)
    for view in dataset.views:
        stage.set(view.camera.time)
        check(stage.scene, box, view.camera.c2w[None])
        _, numbers = scenes.first_hits(stage.scene, K, view.camera.c2w, 32, 24)
        assert (stage.table[numbers] == filmed._read_labels(view.label_path)).mean() > 0.99  # c2w is read from text

    trace, done = filmed._Tracer.trace, []

    def stop(self, *args):
        if len(done) == 4:
            raise KeyboardInterrupt
        done.append(args)
        return trace(self, *args)

    maker = {"hall": hall, "kitchen": kitchen}[name]
    sizes = {"cameras": 10, "times": 3, "width": 32, "height": 24, "spp": 1, "teacher_width": 8, "teacher_height": 6}
    with monkeypatch.context() as patch:
        patch.setattr(filmed._Tracer, "trace", stop)
        with pytest.raises(KeyboardInterrupt):
            maker.generate(tmp_path / "b", **sizes, free=True)
    maker.generate(tmp_path / "b", **sizes, free=True)
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file()]
    for file in files:
        if file.name != ".drgs.jsonl":
            assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_still_lifes(built, tmp_path, monkeypatch):
    """The data set has the poses, and says that they are free; one without has the mark that it has had."""
    monkeypatch.setattr(still_life, "_scene", lambda seed: built["still_life"][0])
    command = ["scene", "still_life", "--free", "--views", "4", "--size", "16x12", "--spp", "1", "--quiet", "-o"]
    assert cli.main([*command, str(tmp_path / "a")]) == 0
    params = json.loads((tmp_path / "a" / "params.json").read_text())
    assert params["free"] is True
    wanted = free_poses(*built["still_life"], 4, np.random.default_rng([0, 9]))
    assert np.allclose([view.camera.c2w for view in load(tmp_path / "a").views], wanted, atol=1e-6)
    recorded = []
    monkeypatch.setattr(output, "publish", lambda folder, parameters, fill, where: recorded.append(parameters))
    for maker in (still_life, hall, kitchen, room):
        maker.generate(tmp_path / "b")
    assert not any("free" in parameters for parameters in recorded)
