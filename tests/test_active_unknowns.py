"""Exposure and poses of photographs that join an active fit: what they begin with, the gauge, resuming, information."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import dense_jacobian as dense
import numpy as np
import pytest
import torch
from resuming import stopped_and_resumed
from test_active import Killed, config, lazily, plan, without_times
from test_data import save, write_image
from test_nuisances import exposure_columns, projected
from test_poses import FAST, blobs

import drgs
from drgs import cli, fisher, reference
from drgs.cameras import c2w_to_opengl, orbit
from drgs.data.camera_lists import load_cameras_json
from drgs.files import Run, load_state
from drgs.fitting.components.exposure import ExposureComponent, exposure_network
from drgs.fitting.components.poses import CAMERAS, Poses, pose_network
from drgs.fitting.exposures import ExposureEstimate
from drgs.fitting.frames import Frame
from drgs.fitting.networks import Network
from drgs.fitting.records import fit_record
from drgs.fitting.rows import GaussianRows
from drgs.information.nuisances import Nuisances
from drgs.select import select
from drgs.train import Trainer, fit

SIZE = 48
VIEWS = 9
GAINS = np.exp(np.random.default_rng(5).normal(0, 0.2, (VIEWS, 3)))


def write_photographs(folder: Path, gains: np.ndarray) -> None:
    """A transforms.json data set of nine views of blobs in front of a wall, with depth maps; colors are below the
    half, so that gains saturate none.
    """
    g = blobs(60)
    wall = np.array([[x, y, z] for x in (-1.5, 0, 1.5) for y in (-1.5, 0, 1.5) for z in (-1.5, 0, 1.5)], np.float32)
    far = drgs.Gaussians.from_arrays(
        wall, np.tile([1.0, 0, 0, 0], (27, 1)), np.full((27, 3), 0.5), np.full(27, 0.9), np.zeros((27, 1, 3))
    )
    colors = torch.cat([g.sh[:, :1], far.sh[:, :1]]) * 0.25 - 0.6
    whole = {name: torch.cat([x, getattr(far, name)]) for name, x in g.parameters().items() if name != "sh"}
    scene = drgs.Gaussians(**whole, sh=colors)
    frames = []
    for i, camera in enumerate(orbit((0, 0, 0), 5.0, VIEWS, width=SIZE, height=SIZE)):
        out = drgs.render(scene, camera, FAST)
        image = (out.rgb.numpy() * gains[i]).clip(0, 1)
        write_image(folder / f"images/{i}.png", (image * 255).round().astype(np.uint8))
        write_image(folder / f"depth/{i}.png", (out.depth * 1000).round().numpy().astype(np.uint16))
        files = {"file_path": f"images/{i}.png", "depth_file_path": f"depth/{i}.png"}
        frames.append({**files, "transform_matrix": c2w_to_opengl(camera.c2w).tolist()})
    K = camera.K
    lens = {"w": SIZE, "h": SIZE, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    save(folder, {**lens, "frames": frames})


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """Photographs of different gains."""
    folder = tmp_path_factory.mktemp("uneven")
    write_photographs(folder, GAINS)
    return folder


@pytest.fixture(scope="module")
def even(tmp_path_factory):
    """Photographs of one exposure."""
    folder = tmp_path_factory.mktemp("even")
    write_photographs(folder, np.ones((VIEWS, 3)))
    return folder


def estimate(logs, labels):
    """What points are made to say."""
    logs = np.asarray(logs, np.float64)
    return ExposureEstimate(
        logs, 0.01 * np.ones_like(logs), 100, len(set(labels)), np.asarray(labels), 0.5, logs.any(axis=1)
    )


# ---- a photograph that joins


def test_a_longer_parameter_keeps_its_moments():
    """Rows that were there go on as if nothing had come: the same steps as without, and new rows begin at no moment."""

    def network():
        return Network("x", torch.nn.ParameterDict({"a": torch.nn.Parameter(torch.ones(2, 3))}), 0.1)

    def stepped(x, factor):
        x.optimizer.zero_grad(set_to_none=True)
        (factor * x.module["a"][:2].square()).sum().backward()
        x.optimizer.step()

    whole, grown = network(), network()
    for x in (whole, grown):
        stepped(x, 1.0)

    def longer():
        grown.module["a"] = torch.nn.Parameter(torch.cat([grown.module["a"].detach(), torch.full((1, 3), 5.0)]))
        grown.module["b"] = torch.nn.Parameter(torch.zeros(2))
        return "told"

    assert grown.extend(longer) == "told"
    for x in (whole, grown):
        stepped(x, 3.0)
    assert torch.equal(grown.module["a"][:2], whole.module["a"])
    assert torch.equal(grown.module["a"][2], torch.full((3,), 5.0))
    assert [len(group["params"]) for group in grown.optimizer.param_groups] == [2]
    copy = network()
    copy.extend(lambda: copy.module.update({"a": torch.nn.Parameter(torch.zeros(3, 3)), "b": grown.module["b"]}))
    copy.restore(grown.state(), "here")
    assert torch.equal(
        copy.optimizer.state[copy.module["a"]]["exp_avg"], grown.optimizer.state[grown.module["a"]]["exp_avg"]
    )


def test_gains_from_points_are_those_of_the_new_estimate():
    """All of them, of zero mean; what the others have grown by on average is returned."""
    frames = [Frame(f"p{i}", None, torch.zeros(2, 2, 3)) for i in range(2)]
    gains = exposure_network(frames, False, np.array([[0.1] * 3, [-0.1] * 3])).module
    now = np.array([[0.2, 0.1, 0.0], [0.0, -0.1, 0.0], [-0.2, 0.0, 0.0]])
    grown = gains.join(["p0", "p1", "new"], estimate(now, [0, 0, 0]))
    assert torch.allclose(gains.log_gains, torch.tensor(now, dtype=torch.float32))
    assert torch.allclose(grown, torch.tensor([0.1, 0.0, 0.0]))
    assert not gains.log_gains.requires_grad


def test_learned_gains_stay_and_a_new_one_stands_beside_its_set():
    """Two sets that share no points: the new photograph is compared with its own; a third set begins at the mean."""
    frames = [Frame(f"p{i}", None, torch.zeros(2, 2, 3)) for i in range(4)]
    start = np.array([[0.3], [0.1], [-0.2], [-0.2]]) * np.ones(3)
    network = exposure_network(frames, True, start)
    told = np.array([[0.15], [-0.05], [0.1], [-0.1], [-0.1]]) * np.ones(3)  # the sets {0, 1, 4} and {2, 3}
    grown = network.extend(
        lambda: network.module.join(["p0", "p1", "p2", "p3", "new"], estimate(told, [0, 0, 2, 2, 0]))
    )
    learned = network.module.log_gains.detach()
    assert float(learned.mean(dim=0).abs().max()) < 1e-7
    between = torch.tensor(start - start[0], dtype=torch.float32)
    assert torch.allclose(learned[:4] - learned[0], between, atol=1e-6)
    assert torch.allclose(learned[4] - learned[0], torch.full((3,), -0.25), atol=1e-6)  # as told of both
    assert torch.allclose(grown, learned[0] - 0.3, atol=1e-6)
    lone = np.concatenate([told, np.zeros((1, 3))])
    names = ["p0", "p1", "p2", "p3", "new", "lone"]
    network.extend(lambda: network.module.join(names, estimate(lone, [0, 0, 2, 2, 0, 5])))
    after = network.module.log_gains.detach()
    assert torch.allclose(after[5] - after[0], 0.0 - learned[0], atol=1e-6)


def test_photographs_look_as_before_when_another_joins(uneven):
    """The gauge moves all gains and, against that, the scene's colors: each photograph is rendered as before."""
    trainer = begun(uneven, exposure="learned")
    for _ in range(4):
        trainer.step()
    frames = trainer.frames

    def shown(frame):
        with torch.no_grad():
            out = drgs.render(trainer.gaussians(), frame.camera, FAST)
            return trainer.as_photograph(out, frame).rgb

    before = [shown(frame) for frame in frames]
    new = dataclasses.replace(frames[0], name="new")
    logs = np.array([[0.1], [0.3], [-0.4]]) * np.array([1.0, 0.5, -1.0])
    trainer.component("exposure").extend(trainer, new, estimate(logs, [0, 0, 0]))
    trainer.add_frame(new)
    gains = trainer.network("exposure").log_gains.detach()
    assert float(gains.mean(dim=0).abs().max()) < 1e-7
    assert float(gains[2].abs().min()) > 0.1
    for frame, was in zip(frames, before, strict=True):
        assert float((shown(frame) - was).abs().max()) < 1e-5
    for _ in range(6):
        trainer.step()  # all three are seen, and learned
    assert float(trainer.network("exposure").log_gains.detach().mean(dim=0).abs().max()) < 1e-7


def begun(folder, **fields):
    """A trainer of two views, with gains of 0 where exposure is asked for."""
    from drgs.fitting.frames import load_frames
    from drgs.sfm.points import initial_points

    views = lazily(folder).split()[0][:2]
    settings = config(deterministic=True, **fields)
    frames = load_frames(views, settings.data.max_pixels)
    points, colors, _ = initial_points(views, 0, 60)
    rows = GaussianRows.from_points(torch.from_numpy(points), torch.from_numpy(colors))
    exposure = ExposureComponent()
    exposure.use(settings, frames)
    return Trainer(settings, frames, rows, 3.0, [exposure])


def test_colors_are_scaled_in_every_direction():
    """Factors of R, G and B change what each direction sees, up to rounding, with SH of degree 1."""
    generator = torch.Generator().manual_seed(0)
    rows = GaussianRows.from_points(torch.randn(20, 3, generator=generator), torch.rand(20, 3, generator=generator))
    rows.raise_sh_degree()
    with torch.no_grad():
        rows.tensors["sh_rest"] += 0.1 * torch.randn(20, 3, 3, generator=generator)
    camera = orbit((0, 0, 0), 5.0, 1, width=20, height=20)[0]
    factors = torch.tensor([1.2, 0.7, 1.0])
    with torch.no_grad():
        before = drgs.render(rows.gaussians(), camera, FAST).rgb
        rows.scale_colors(factors)
        after = drgs.render(rows.gaussians(), camera, FAST).rgb
    assert float((after - before * factors).abs().max()) < 1e-5


def test_the_gauge_moves_no_camera_when_another_joins():
    """Poses that keep the gauge of six cameras keep that of seven, the newcomer as stated; from then on it counts."""
    g = blobs()
    cameras = [
        dataclasses.replace(c, name=f"v{k}") for k, c in enumerate(orbit((0, 0, 0), 3.0, 7, width=48, height=40))
    ]
    poses = Poses(cameras[:6], 3.0, FAST, 2.0)
    network = pose_network(poses)
    poses.begin(g)
    with torch.no_grad():
        for row, x in enumerate(poses.coordinates):
            x += torch.randn(6, generator=torch.Generator().manual_seed(row), dtype=torch.float64) * 0.01
    poses.hold_gauge()
    before = [camera.w2c for camera in poses.cameras()]
    network.extend(lambda: poses.join(cameras[6], g))
    poses.hold_gauge()
    for was, camera in zip(before, poses.cameras(), strict=False):
        assert np.abs(camera.w2c - was).max() < 1e-12
    assert np.abs(poses.camera("v6").w2c - cameras[6].w2c).max() < 1e-12
    fresh = Poses(cameras, 3.0, FAST, 2.0)
    fresh.begin(g)
    assert torch.allclose(fresh.whitening, poses.whitening)
    assert torch.allclose(fresh.shifts, poses.shifts)
    with torch.no_grad():
        for row, x in enumerate(poses.coordinates):  # a common turn, of seven cameras
            twist = torch.tensor([0.01, -0.02, 0.015, 0, 0, 0], dtype=torch.float64)
            x += torch.linalg.solve(poses._twist_of[row] @ poses.whitening[row], twist)
    poses.hold_gauge()
    for was, camera in zip(before, poses.cameras(), strict=False):
        assert np.abs(camera.w2c - was).max() < 1e-6
    assert len(network.optimizer.param_groups[0]["params"]) == 7


def test_a_camera_joins_before_poses_are_fitted():
    """Nothing is looked at yet, and it begins with the others."""
    cameras = [
        dataclasses.replace(c, name=f"v{k}") for k, c in enumerate(orbit((0, 0, 0), 3.0, 3, width=48, height=40))
    ]
    poses = Poses(cameras[:2], 3.0, FAST, 2.0)
    poses.join(cameras[2], blobs())
    assert not poses.has_begun
    poses.begin(blobs())
    assert bool(poses.whitening.any(dim=(1, 2)).all())


# ---- fits


def events(run: Path, kind: str) -> list[dict]:
    return [event for event in Run(run).events() if event["event"] == kind]


@pytest.mark.every(3)
@pytest.mark.parametrize("use", ["points", "learned", "auto"])
def test_joining_photographs_get_their_gains(uneven, tmp_path, use):
    """From points that they share with those that are in; config.json and the log say so, of those that are in; each
    pick eliminates them, and knows the photographs' own.
    """
    run = tmp_path / "run"
    fit(lazily(uneven), run, config(exposure=use, selection=plan(policy="fisher", add=3)), progress=False)
    seen = [int(name) for name in names_in(run)]
    recorded = Run(run).config()
    truth = np.log(GAINS[seen]) - np.log(GAINS[seen]).mean(axis=0)
    told = np.log([recorded["exposure"]["gains"][str(i)] for i in seen])
    assert list(recorded["exposure"]["gains"]) == [str(i) for i in seen]
    # Which photographs are in, and so how well points tell, depends on picks, which near ties decide by machine.
    assert np.sqrt(np.square(told - truth).mean()) < 0.04
    assert np.abs(told - truth).max() < 0.08
    assert recorded["estimated"] == ["exposure"]
    assert fit_record(Run(run)).estimated == ("exposure",)
    tensors = load_state(run / "state.safetensors")[0]
    gains = tensors["exposure.parameter.log_gains"]
    assert float(gains.mean(dim=0).abs().max()) < 1e-6
    assert np.abs(gains.numpy() - truth).max() < (0.1 if use == "learned" else 0.08)
    looked = events(run, "exposure")
    assert [event["step"] for event in looked] == [4, 8, 12]
    assert all(event["used"] and event["observations"] > 0 for event in looked)
    for pick in json.loads((run / "selection.json").read_text())["picks"]:
        assert pick["nuisances"] == {"eliminate": ["exposure"], "exposure_std": None, "pose_std": None}


def names_in(run: Path) -> list[str]:
    selection = json.loads((run / "selection.json").read_text())
    return [view["name"] for view in (*selection["start"], *selection["picks"])]


@pytest.mark.same_bits
def test_auto_leaves_equal_photographs_alone(even, tmp_path):
    """The same bits as with exposure off; what was found is recorded at each look, and nothing is eliminated."""
    runs = []
    for use in ("off", "auto"):
        settings = config(exposure=use, deterministic=True, selection=plan(policy="fisher"))
        fit(lazily(even), tmp_path / use, settings, progress=False)
        runs.append(Run(tmp_path / use))
    states = [load_state(run.state) for run in runs]
    assert all(torch.equal(x, states[1][0][name]) for name, x in states[0][0].items())
    assert "exposure" not in runs[0].config()
    assert "exposure" not in states[0][1]["active"]
    assert max(runs[1].config()["exposure"]["spread"]) < 0.1
    assert "estimated" not in runs[1].config()
    assert [event["used"] for event in events(runs[1].path, "exposure")] == [False, False]
    assert "nuisances" not in json.loads((runs[1].path / "selection.json").read_text())["picks"][1]


@pytest.mark.same_bits
def test_auto_begins_when_a_photograph_differs(even, tmp_path, capsys):
    """Of two equal photographs nobody has gains; when a darker one joins all have, and one line says since when. Killed
    after that and resumed, the fit ends in the same bits.
    """
    gains = np.ones((VIEWS, 3))
    gains[2] = 0.6
    write_photographs(tmp_path / "data", gains)
    settings = config(exposure="auto", poses="refined", deterministic=True, selection=plan(add=3))
    fit(lazily(tmp_path / "data"), tmp_path / "run", settings, progress=True)
    first = names_in(tmp_path / "run").index("2")
    assert first in (3, 4)  # the second that joins, or the third: cameras of an orbit are equally far on some machines
    assert [event["used"] for event in events(tmp_path / "run", "exposure")] == [joins >= first for joins in (2, 3, 4)]
    told = capsys.readouterr().err
    assert "off, all have the same for now" in told
    assert f"each has its own from step {4 * (first - 1)} on" in told
    stopped_and_resumed(lambda: lazily(tmp_path / "data"), tmp_path / "again", settings, 14)
    same_run(tmp_path / "run", tmp_path / "again")


@pytest.mark.slow
def test_auto_ends_when_more_photographs_say_otherwise(even, tmp_path, monkeypatch, capsys):
    """What the first few points said is taken back: gains and their network go, and nothing is eliminated any more;
    resumed after that, the fit ends in the same bits.
    """
    import drgs.fitting.components.exposure

    true = drgs.fitting.components.exposure.estimate_exposure

    def fooled(frames, *rest, **options):
        found = true(frames, *rest, **options)
        if len(frames) > 3:
            return found
        logs = np.linspace(-0.2, 0.2, len(frames))[:, None] * np.ones(3)
        return dataclasses.replace(found, log_gains=logs)

    monkeypatch.setattr(drgs.fitting.components.exposure, "estimate_exposure", fooled)
    settings = config(exposure="auto", deterministic=True, selection=plan(policy="fisher", add=3))
    fit(lazily(even), tmp_path / "run", settings, progress=True)
    assert [event["used"] for event in events(tmp_path / "run", "exposure")] == [True, False, False]
    told = capsys.readouterr().err
    assert "each has its own for now" in told
    assert "off, all have the same from step 8 on" in told
    picks = json.loads((tmp_path / "run" / "selection.json").read_text())["picks"]
    assert ["nuisances" in pick for pick in picks] == [True, True, False]
    assert "estimated" not in Run(tmp_path / "run").config()
    assert "networks" not in load_state(tmp_path / "run" / "state.safetensors")[1]
    stopped_and_resumed(lambda: lazily(even), tmp_path / "again", settings, 10)
    same_run(tmp_path / "run", tmp_path / "again")


def same_run(a, b):
    """The same checkpoint, selection, and words about exposure."""
    states = [load_state(run / "state.safetensors") for run in (a, b)]
    assert states[0][0].keys() == states[1][0].keys()
    assert all(torch.equal(x, states[1][0][name]) for name, x in states[0][0].items())
    assert states[0][1] == states[1][1]
    assert without_times(a / "selection.json") == without_times(b / "selection.json")
    said = [{key: run.config().get(key) for key in ("exposure", "poses", "estimated")} for run in (Run(a), Run(b))]
    assert said[0] == said[1]


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["between picks", "between choosing and saving"])
@pytest.mark.same_bits
def test_a_killed_fit_goes_on_with_gains_and_poses(uneven, tmp_path, moment):
    """Killed after or during its second pick, it ends in the same bits: gains, poses, Gaussians, picks, config.json."""
    settings = config(
        exposure="learned", poses="refined", deterministic=True, selection=plan(policy="fisher", add=3, every=4)
    )
    fit(lazily(uneven), tmp_path / "a", settings, progress=False)
    if moment == "between picks":
        stopped_and_resumed(lambda: lazily(uneven), tmp_path / "b", settings, 10)
    else:
        state = Trainer.state

        def killed(self):
            if len(self.frames) == 4:  # two at the start, and two picks
                raise Killed
            return state(self)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Trainer, "state", killed)
            with pytest.raises(Killed):
                fit(lazily(uneven), tmp_path / "b", settings, progress=False)
        fit(lazily(uneven), tmp_path / "b", settings, progress=False, resume=True)
    same_run(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a" / CAMERAS).read_bytes() == (tmp_path / "b" / CAMERAS).read_bytes()
    header = load_state(tmp_path / "b/state.safetensors")[1]
    assert header["networks"] == ["exposure", "poses"]


@pytest.mark.slow
def test_everybody_sees_what_an_active_fit_has_refined(uneven, tmp_path, capsys):
    """refined_cameras.json has all photographs that are in, and no other; eval, report, select and fisher take it."""
    run = tmp_path / "run"
    command = ["fit", str(uneven), "-o", str(run), "--views", "active", "--initial", "2", "--add", "2", "--every", "4"]
    command += ["--max-steps", "16", "--max-gaussians", "60", "--test-every", "4", "--for", "fast", "--sh-degree", "1"]
    assert cli.main([*command, "--poses", "refined", "--exposure", "points", "--quiet"]) == 0
    seen = names_in(run)
    found = {camera.name: camera for camera in load_cameras_json(run / CAMERAS)}
    assert set(found) == set(seen)
    record = fit_record(Run(run))
    assert record.estimated == ("exposure", "pose")
    for view in record.with_refined_poses(lazily(uneven)).views:
        moved = view.name in found and np.abs(view.camera.w2c - found[view.name].w2c).max() < 1e-9
        assert moved == (view.name in seen)
    before = json.loads((run / "metrics.json").read_text())
    assert before["poses"]["cameras"] == len(seen)
    assert before["poses"]["degrees"] > 0
    assert cli.main(["eval", str(run), "--quiet"]) == 0
    after = json.loads((run / "metrics.json").read_text())
    assert after["mean"]["psnr"] == pytest.approx(before["mean"]["psnr"], abs=1e-3)
    assert after["poses"]["degrees"] == pytest.approx(before["poses"]["degrees"], rel=1e-4)
    assert cli.main(["report", str(run), "--quiet"]) == 0
    ask = ["select", str(run), "--candidates", str(uneven), "-k", "1", "-o", str(tmp_path / "next.json"), "--quiet"]
    assert cli.main(ask) == 0
    assert json.loads((tmp_path / "next.json").read_text())["nuisances"]["eliminate"] == ["exposure", "pose"]
    capsys.readouterr()


@pytest.mark.same_bits
def test_poses_stay_where_no_observations_are_read(uneven, tmp_path):
    """`auto` has nothing to go by before all photographs are there: the same bits as with fixed poses."""
    states = []
    for use in ("auto", "fixed"):
        fit(lazily(uneven), tmp_path / use, config(poses=use, deterministic=True, selection=plan()), progress=False)
        states.append(load_state(tmp_path / use / "state.safetensors")[0])
    assert all(torch.equal(x, states[1][name]) for name, x in states[0].items())
    assert Run(tmp_path / "auto").config()["poses"] == {"reprojection": None, "refined": False}
    knowing = lazily(uneven)
    knowing.reprojection = 0.1  # of observations of all photographs, which are not for an active fit
    fit(knowing, tmp_path / "knowing", config(poses="auto", selection=plan()), progress=False)
    assert Run(tmp_path / "knowing").config()["poses"]["reprojection"] is None


# ---- information


def test_candidates_count_by_what_drgs_select_says(uneven, tmp_path, monkeypatch):
    """Scores of a pick are those of `drgs.select` of the same scene with exposure and pose eliminated, in known
    photographs, where they are fitted, and in candidates; without that they are others.
    """
    from drgs.selection import policies

    pools, choose = [], policies.choose

    def spy(policy, pool):
        pools.append(dataclasses.replace(pool, scene=pool.scene.detach()))
        return choose(policy, pool)

    monkeypatch.setattr(policies, "choose", spy)
    active = plan(policy="fisher", criterion="eig", blocks=("geometry",), add=3)
    run = tmp_path / "run"
    fit(lazily(uneven), run, config(exposure="points", poses="refined", selection=active, max_steps=20), progress=False)
    monkeypatch.undo()
    pick = json.loads((run / "selection.json").read_text())["picks"][2]
    scene, candidates, train = pools[2].scene, pools[2].candidates, pools[2].train
    stated = {view.name: view.camera for view in lazily(uneven).views}
    assert any(np.abs(camera.w2c - stated[camera.name].w2c).max() > 1e-6 for camera in train)
    scoring = dataclasses.replace(pools[2].scoring, nuisances=Nuisances(eliminate=("exposure", "pose")))
    assert pools[2].scoring.nuisances == scoring.nuisances
    again = select(scene, candidates, train, 1, "fisher", scoring=scoring)
    assert [other["score"] for other in pick["candidates"]] == pytest.approx(again.scores, rel=1e-6)
    plain = select(scene, candidates, train, 1, "fisher", scoring=dataclasses.replace(scoring, nuisances=Nuisances()))
    assert max(again.scores) != pytest.approx(max(plain.scores), rel=1e-3)


def test_information_in_a_fit_is_that_of_the_oracle(uneven, tmp_path, monkeypatch):
    """What a candidate and a known photograph with a refined camera tell at a pick, without their exposure and pose,
    against the float64 oracle's Jacobian and a projection: diagonals of all groups within 1e-4 of the largest entry.
    """
    from drgs.selection import policies

    pools, choose = [], policies.choose

    def spy(policy, pool):
        pools.append(dataclasses.replace(pool, scene=pool.scene.detach()))
        return choose(policy, pool)

    monkeypatch.setattr(policies, "choose", spy)
    active = plan(policy="fisher", info_pixels=144)
    settings = config(exposure="points", poses="refined", selection=active, max_gaussians=12)
    fit(lazily(uneven), tmp_path / "run", settings, progress=False)
    scene, views, scoring = pools[1].scene, (pools[1].candidates[0], pools[1].train[0]), pools[1].scoring
    g = scene.replace(**{name: x.double().requires_grad_() for name, x in scene.parameters().items()})
    for camera in views:
        posed = torch.tensor(camera.w2c, dtype=torch.float64, requires_grad=True)
        seen = dataclasses.replace(camera, w2c=posed)
        out = reference.render(g, seen, scoring.settings)
        N = torch.cat([exposure_columns(out.rgb), dense.pose_jacobian(seen, out)], 1)
        found = fisher.diagonal(scene, camera, scoring.settings, nuisances=scoring.nuisances)
        whole = fisher.diagonal(scene, camera, scoring.settings)
        for name, J in dense.jacobian(g, out).items():
            truth = projected(J, N).square().sum(0)
            assert float((found[name] - truth).abs().max()) <= 1e-4 * float(whole[name].max()), name
            assert float(found[name].sum()) < 0.99 * float(whole[name].sum()), name
