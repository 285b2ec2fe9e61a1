"""`drgs select`: candidates from everywhere, the table and the JSON, and one line for everything that can be wrong."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from test_active import SIZE, config, lazily, plan, write_still

import drgs
from drgs import cli, fisher
from drgs.cameras import Camera, look_at, orbit
from drgs.commands.orbits import dome
from drgs.commands.select import print_picks
from drgs.data import load
from drgs.data.camera_lists import load_cameras_json, save_cameras_json
from drgs.files import Run, load_ply, save_ply
from drgs.gain import Prior, information_gain, unit_length
from drgs.selection.pool import Pick, Selection
from drgs.train import fit


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`data`, an active run `run` on it (views 1, 5 and two more), `scene.ply`, `cameras.json`."""
    folder = tmp_path_factory.mktemp("select")
    save_ply(write_still(folder / "data"), folder / "scene.ply")
    fit(lazily(folder / "data"), folder / "run", config(max_steps=12, selection=plan()), progress=False)
    save_cameras_json(folder / "cameras.json", orbit((0, 0, 0), 3.0, 4, width=SIZE, height=SIZE))
    return folder


def select(line: str, folder, monkeypatch, capsys) -> tuple[dict, str]:
    monkeypatch.chdir(folder)
    assert cli.main(["select", *line.split()]) == 0, capsys.readouterr().err
    return json.loads((folder / "out/select.json").read_text()), capsys.readouterr().out


def test_unused_views_of_a_run(place, monkeypatch, capsys):
    """Candidates are what the run has not been fitted to; scores are information_gain's, parts add up."""
    report, text = select(
        "run --candidates data -k 2 --preset fast --criterion eig --blocks geometry", place, monkeypatch, capsys
    )
    seen = report["known"]["names"]
    assert seen == [view["name"] for key in ("start", "picks") for view in _selection(place)[key]]
    assert sorted(row["name"] for row in report["candidates"]) == sorted(set("012345678") - set(seen))
    views = {view.name: view.camera for view in load(place / "data").views}
    g, settings = load_ply(place / "run/point_cloud.ply"), drgs.RenderSettings.preset("fast")
    H = fisher.diagonal(g, [views[name] for name in seen], settings)
    for row in report["candidates"]:
        gain = information_gain(fisher.diagonal(g, views[row["name"]], settings), H, "eig", Prior())
        assert row["score"] == pytest.approx(gain.total, rel=1e-4)
    first, second = report["picks"]
    assert first["score"] == max(row["score"] for row in report["candidates"])
    assert sum(first["parts"].values()) == pytest.approx(first["score"])
    assert second["name"] != first["name"]
    np.testing.assert_allclose(np.linalg.inv(first["camera"]["c2w"]), views[first["name"]].w2c, atol=1e-9)
    assert "fisher (eig): 2 of 5 views" in text
    assert all(word in text for word in ("means", "rot.", "scales", "opac.", "sh", "margin"))


def test_what_is_made_once(place, monkeypatch, capsys, made):
    """Settings of the command are made once, and those of the run's record; of a view no more than two cameras: as it
    is read, and under its name, at its size or without its lens."""
    report, _ = select("run --candidates cameras.json --preset fast", place, monkeypatch, capsys)
    views = len(load(place / "data").views) + len(report["candidates"])
    assert made["RenderSettings"] <= 3
    assert len(report["known"]["names"]) == len(report["candidates"]) == 4
    assert made["Camera"] <= 2 * views


def test_commands_know_the_backdrop(place, monkeypatch, capsys):
    """Unless told otherwise `drgs select` counts it, by `v_opt` and lambda 1e-2; `drgs fisher` as well."""
    report, text = select("run --candidates data --preset fast", place, monkeypatch, capsys)
    assert report["blocks"] == ["geometry", "backdrop"]
    assert "back. %" in text
    views = {view.name: view.camera for view in load(place / "data").views}
    g, settings = load_ply(place / "run/point_cloud.ply"), drgs.RenderSettings.preset("fast")
    names = [row["name"] for row in report["candidates"]]
    sphere = fisher.backdrop_sphere(g, [views[name] for name in (*report["known"]["names"], *names)])
    ask = lambda names: fisher.backdrop(g, [views[name] for name in names], settings, sphere=sphere)  # noqa: E731
    H, everything = ask(report["known"]["names"]), ask([*report["known"]["names"], *names])
    for row in report["candidates"]:
        want = (everything * (1 / (H + 1e-2) - 1 / (H + 1e-2 + ask([row["name"]])))).sum()
        assert row["parts"]["backdrop"] == pytest.approx(float(want), rel=1e-4)
    assert (report["criterion"], report["prior"]) == (
        "v_opt",
        {
            "value": 1e-2,
            "relative": False,
            "length": pytest.approx(unit_length(g, [views[x] for x in (*report["known"]["names"], *names)])),
        },
    )
    assert cli.main(["fisher", "run", "--limit", "2", "--preset", "fast", "--maps", "-o", "fisher"]) == 0
    told = json.loads((place / "fisher/fisher.json").read_text())
    assert told["blocks"] == ["geometry", "backdrop"]
    assert told["groups"]["backdrop"]["sum"] > 0


def test_a_score_of_empty_pixels_is_told(tmp_path, capsys):
    """Where most of a pick's score is of what is behind all Gaussians; not of z-scores, whose parts do not add up."""
    shares = {"a": 0.6, "b": 0.5, "c": 0.9, "d": 0.8, "e": 0.7}
    picks = [
        Pick(i, name, 2.0, {"means": 2 * (1 - share), "backdrop": 2 * share}, None)
        for i, (name, share) in enumerate(shares.items())
    ]
    known = {"names": ["x"], "source": "run"}
    report = {"policy": "fisher", "criterion": "v_opt", "candidates": [1] * 5, "source": "data", "known": known}
    selection = Selection(picks, [2.0] * 5, blocks=["geometry", "backdrop"])
    print_picks({**report, "seconds": 1.0}, selection, tmp_path / "x.json")
    told = (
        "note: most of the score of a, c, d and 1 more is of pixels where no Gaussian is (backdrop): right for a whole"
    )
    assert told in capsys.readouterr().out
    selection.combine = "zscore"
    print_picks({**report, "seconds": 1.0}, selection, tmp_path / "x.json")
    assert "note: " not in capsys.readouterr().out


def _selection(place) -> dict:
    return json.loads((place / "run/selection.json").read_text())


@pytest.mark.parametrize("split", ["train", "test"])
def test_split_of_candidates(place, monkeypatch, capsys, split):
    """The run's rule of the split applies; a run may be named for its data set."""
    report, _ = select(f"run --candidates run --split {split} --policy uniform", place, monkeypatch, capsys)
    names = {row["name"] for row in report["candidates"]}
    config = Run(place / "run").config()
    expected = config["test"] if split == "test" else set(config["pool"]) - set(report["known"]["names"])
    assert names == set(expected)


@pytest.mark.parametrize("kind", ["orbit", "dome"])
def test_made_candidates_have_the_lens_of_the_known_views(place, monkeypatch, capsys, kind):
    """As many as asked for, around what the known views look at, at their distance."""
    report, _ = select(f"run --candidates {kind} --count 10 --policy farthest -k 10", place, monkeypatch, capsys)
    cameras = [pick["camera"] for pick in report["picks"]]
    assert len({camera["name"] for camera in cameras}) == 10
    K = load(place / "data").views[0].camera.K
    for camera in cameras:
        np.testing.assert_allclose(camera["K"], K)
        eye, axis = np.array(camera["c2w"])[:3, 3], np.array(camera["c2w"])[:3, 2]
        assert np.linalg.norm(eye) == pytest.approx(3.0, rel=0.02)
        assert axis @ -eye / 3 > 0.999


def test_made_candidates_where_they_are_wished(place, monkeypatch, capsys):
    """The point, the distance and the span that are asked for hold, for pictures of the run as for candidates."""
    where = "--orbit center=0.1,-0.2,0.3 --orbit distance=2.5,span=40"
    report, _ = select(f"run --candidates orbit --count 4 --policy farthest -k 4 {where}", place, monkeypatch, capsys)
    candidates = np.array([pick["camera"]["c2w"] for pick in report["picks"]])
    assert cli.main(f"render run --preset fast --frames 4 --width 16 -o pictures {where}".split()) == 0
    assert "swing of 40 degrees around (0.1, -0.2, 0.3) at distance 2.5" in capsys.readouterr().out
    pictures = load_cameras_json(place / "pictures/cameras.json")
    assert (pictures[0].width, pictures[0].height) == (16, 16)  # the photographs' shape
    for poses in (candidates, np.array([camera.c2w for camera in pictures])):
        ahead = np.array([0.1, -0.2, 0.3]) - poses[:, :3, 3]
        np.testing.assert_allclose(np.linalg.norm(ahead, axis=1), 2.5, rtol=1e-6)
        np.testing.assert_allclose((ahead * poses[:, :3, 2]).sum(axis=1), 2.5, rtol=1e-6)
        spread = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2).max()
        assert 0.4 < spread <= 2 * 2.5 * np.sin(np.radians(20))


def test_plain_ply_with_a_list_of_cameras(place, monkeypatch, capsys):
    """No training record: H from the cameras given; a cameras.json is a list of candidates as well."""
    line = "scene.ply --train cameras.json --candidates orbit --count 5 --orbit up=z --policy coverage"
    report, text = select(line, place, monkeypatch, capsys)
    assert len(report["known"]["names"]) == 4
    assert (report["gaussians"], len(report["candidates"])) == (30, 5)
    assert "4 known views (cameras.json)" in text
    report, _ = select("scene.ply --train data --candidates cameras.json --info-pixels 64", place, monkeypatch, capsys)
    assert len(report["candidates"]) == 4
    assert report["picks"][0]["camera"]["width"] == 8


def test_cameras_that_see_nothing_have_a_defined_answer(place, monkeypatch, capsys):
    """Every score is 0: the first one is picked, and a note says why."""
    away = look_at((0, 0, 50), (0, 0, 60), (0, 1, 0))
    K = load(place / "data").views[0].camera.K
    save_cameras_json(place / "away.json", [Camera(K, away, SIZE, SIZE, name=f"away{i}") for i in range(2)])
    report, text = select("run --candidates away.json --blocks geometry", place, monkeypatch, capsys)
    assert [row["score"] for row in report["candidates"]] == [0, 0]
    assert (report["picks"][0]["name"], report["picks"][0]["margin"]) == ("away0", 0)
    assert "every score is 0" in text


def test_same_command_same_file(place, monkeypatch, capsys):
    """`random` is drawn from --seed."""
    picks = []
    for seed in (1, 1, 2):
        report, _ = select(f"run --candidates data --policy random -k 5 --seed {seed}", place, monkeypatch, capsys)
        picks.append([pick["name"] for pick in report["picks"]])
    assert picks[0] == picks[1] != picks[2]


@pytest.mark.parametrize("count", [1, 2, 7, 40, 100])
def test_dome_is_even(count):
    """All cameras on the upper half, and no two much nearer than even spacing puts them."""
    cameras = dome(orbit((1, 2, 3), 2.0, 24, 0.0, width=16, height=12), count)
    centers = np.stack([camera.center for camera in cameras]) - (1, 2, 3)
    assert len(cameras) == count
    np.testing.assert_allclose(np.linalg.norm(centers, axis=1), 2.0)
    assert (centers[:, 2] > 0).all()
    if count > 1:
        distance = np.linalg.norm(centers[:, None] - centers[None], axis=2) + 9 * np.eye(count)
        assert distance.min() > 0.5 * 2.0 * np.sqrt(2 * np.pi / count)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "run --candidates nowhere",
            "--candidates nowhere: must be cameras, a data set or a run, found no such file or folder; check the "
            "path, or take --candidates dome or orbit, which need none",
        ),
        ("run --candidates none.json", "or take --candidates dome or orbit, which need none"),
        ("run --candidates data -k 6", "k must be a whole number in 1..5 candidates, got 6"),
        ("run --candidates data -k 9", "-k must be a whole number in 1..5 candidates, got 9"),
        ("run --candidates run --train data", "must hold a view that is not known yet, all 9 of split all are"),
        ("scene.ply --candidates orbit", "a file of Gaussians has no record of its views: --train must name"),
        ("run --candidates data --policy best", "random, or package.module:function, got 'best'"),
        ("run --candidates data --prior -1", "lambda (value) must be in [0, inf), got -1"),
        ("run --candidates orbit --split test", "--split test must have --candidates DATA, an orbit has no split"),
        ("run --candidates orbit --count 0", "--count must be in [1, 10000], got 0"),
        ("run --candidates orbit --orbit elevation=90", "--orbit elevation must be in [-89, 89] degrees, got 90"),
        ("run --candidates orbit --orbit distance=-1", "--orbit distance must be positive and finite, got -1"),
        (
            "run --candidates dome --orbit span=90",
            "--orbit span must have --candidates orbit, a dome goes",
        ),
        ("data --candidates orbit", "must be a run folder, found no config.json"),
        ("run --candidates empty.json", "must be a list of at least one camera"),
        (
            "early --candidates orbit",
            "must hold state.safetensors or point_cloud.ply, found none; the fit has not reached",
        ),
        ("run --candidates data -o data", "must be a JSON file, is a folder; name a file in it, e.g. data/select.json"),
        ("run --candidates data --method best", "--method"),
    ],
)
def test_bad_input_is_one_line(place, monkeypatch, capsys, line, message):
    """Exit code 2, one line, nothing written."""
    monkeypatch.chdir(place)
    (place / "empty.json").write_text("[]")
    (place / "early").mkdir(exist_ok=True)
    (place / "early/config.json").write_text((place / "run/config.json").read_text())
    (place / "out/select.json").unlink(missing_ok=True)
    try:
        assert cli.main(["select", *line.split()]) == 2
    except SystemExit as end:  # usage errors leave as argparse's do
        assert end.code == 2  # noqa: PT017
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (place / "out/select.json").exists()


def test_selection_of_the_fit_stays(place, monkeypatch, capsys):
    """In a run folder the default is another name; named itself, the fit's own record is not replaced."""
    before = (place / "run/selection.json").read_bytes()
    monkeypatch.chdir(place / "run")
    line = ["select", ".", "--candidates", "orbit", "--count", "2", "--policy", "uniform"]
    assert cli.main(line) == 0
    assert cli.main(line) == 0  # its own result may be
    assert json.loads((place / "run/out/select.json").read_text())["command"] == "select"
    assert cli.main([*line, "-o", "selection.json"]) == 2
    assert "selection.json: must not be replaced, `drgs select` did not make it" in capsys.readouterr().err
    assert cli.main([*line, "-o", "../cameras.json"]) == 2
    assert (place / "run/selection.json").read_bytes() == before


def test_run_whose_views_are_gone(place, tmp_path, capsys):
    """A run's data set must still hold what it was fitted to."""
    import shutil

    shutil.copytree(place / "run", tmp_path / "run")
    file = tmp_path / "run/selection.json"
    file.write_text(file.read_text().replace('"name": "5"', '"name": "gone"'))
    assert cli.main(["select", str(tmp_path / "run"), "--candidates", "orbit"]) == 2
    assert "'gone' is gone; restore it" in capsys.readouterr().err


def test_data_set_with_absent_images(place, tmp_path, monkeypatch, capsys, caplog):
    """Commands go on without an image that is not there and say so; with --strict they refuse."""
    import shutil

    shutil.copytree(place / "data", tmp_path / "data")
    gone = load(tmp_path / "data").views[2]
    gone.image_path.unlink()
    line = f"{place}/scene.ply --train {place}/cameras.json --candidates {tmp_path}/data --policy uniform"
    report, _ = select(line, tmp_path, monkeypatch, capsys)
    names = [row["name"] for row in report["candidates"]]
    assert len(names) == len(load(place / "data").views) - 1
    assert gone.name not in names
    assert "going on with the other" in caplog.text
    fitting = ["fit", f"{tmp_path}/data", "-o", f"{tmp_path}/run", "--max-steps", "1"]
    for strict in (["select", *line.split(), "--strict"], [*fitting, "--strict"]):
        assert cli.main(strict) == 2
        assert "all must be there: restore them" in capsys.readouterr().err
    assert cli.main(fitting) == 0
    assert Run(tmp_path / "run").config()["absent"] == [gone.name]


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (
            "[0]",
            "what it returns must be a Selection, got a list of 1 (int); e.g. Selection(picks, scores); make picks",
        ),
        ("None", "what it returns must be a Selection, got None"),
        ("Selection([0], scores)", "picks must be a list of Pick, got a list of 1 (int); make picks with pool.pick("),
        ("Selection([pool.pick(0, 1)] * 2, scores)", "picks must be k = 1 different ones of 5 candidates, got indices"),
        ("Selection([Pick(7, '', 1.0, {}, None)], scores)", "of 5 candidates, got indices [7]"),
        (
            "Selection([pool.pick(0, 1)], [1.0])",
            "scores must be a finite number for each of 5 candidates, got a list of 1",
        ),
        ("Selection([pool.pick(0, 1)], [None] * 5)", "scores must be a finite number for each of 5 candidates, got a"),
        ("Selection([pool.pick(0, 1)], scores * np.nan)", "scores must be a finite number for each of 5 candidates"),
        ("Selection([pool.pick(0, 1)], scores + 1j)", "scores must be a finite number for each of 5 candidates, got"),
        ("pool.pick(99, 1.0)", "index must be one of 5 candidates and score a finite number, got 99 and 1.0; count"),
        ("pool.pick(0, [1, 2])", "index must be one of 5 candidates and score a finite number, got 0 and [1, 2]"),
        ("Selection([pool.pick(0, 1)], scores, parts=[{}])", "parts must be a list for each of 5 candidates, or empty"),
    ],
)
def test_a_policy_that_returns_something_else(place, tmp_path, monkeypatch, capsys, returned, message):
    """One line that names the policy and says what it must return; a table of NumPy's numbers is as good as a list."""
    (tmp_path / "odd_policy.py").write_text(
        "import numpy as np\nfrom drgs.select import Pick, Selection\n\n\n"
        f"def chosen(pool):\n    scores = np.arange(len(pool.candidates))\n    return {returned}\n\n\n"
        "def good(pool):\n    scores = np.arange(len(pool.candidates))\n"
        "    return Selection([pool.pick(scores.argmax(), scores.max())], scores)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "odd_policy", raising=False)
    line = ["select", f"{place}/run", "--candidates", f"{place}/data", "-o", f"{tmp_path}/out.json", "--policy"]
    assert cli.main([*line, "odd_policy:chosen"]) == 2
    told = capsys.readouterr().err
    assert told.startswith(("drgs select: policy odd_policy:chosen: ", "drgs select: Pool.pick: "))
    assert message in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out.json").exists()
    assert cli.main([*line, "odd_policy:good"]) == 0
    assert json.loads((tmp_path / "out.json").read_text())["candidates"][4]["score"] == 4
