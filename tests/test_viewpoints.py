"""What a command was given and which views its options name: each rule once, for every command."""

import dataclasses
import json
import shutil

import pytest
from test_active import SIZE, write_still

from drgs import cli
from drgs.cameras import orbit
from drgs.commands.options import Crossval, Fisher, Render, Select, Tradeoff
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewpoints import Source, known_views, views_to_compare, views_to_render, views_to_sample
from drgs.data.camera_lists import save_cameras_json
from drgs.files import Run, save_ply
from drgs.fitting.records import is_run
from drgs.settings import RenderSettings
from drgs.train import FitConfig

SKY = (0.2, 0.4, 0.6)
NAMES = "012345678"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`data` (nine views), a run `run` on it over a blue background that held out every third, and a `list.json`."""
    folder = tmp_path_factory.mktemp("given")
    gaussians = write_still(folder / "data")
    run = Run(folder / "run")
    config = FitConfig().replace(settings=RenderSettings.preset("fast", background=SKY), test_every=3, max_pixels=100)
    train = [name for i, name in enumerate(NAMES) if i % 3]
    recorded = {"data": str(folder / "data"), "train": train, "test": ["0", "3", "6"], "fit": config.to_json()}
    run.start({"command": "fit", **recorded})
    run.log("start")
    save_ply(gaussians, run.point_cloud)
    save_cameras_json(folder / "list.json", orbit((0, 0, 0), 3.0, 4, width=SIZE, height=SIZE))
    return folder


def given(place, command=Render, scene="run", **options):
    """Options of a command, and what it was given."""
    scene = place / scene if scene == "run" else place / "run/point_cloud.ply"
    needed = {"candidates": "orbit"} if command is Select else {}
    args = command(scene=scene, quiet=True, **(needed | options))
    return args, SceneInput.of(args)


@pytest.mark.parametrize("command", [Render, Crossval, Tradeoff, Select, Fisher])
def test_background_is_the_fits_unless_set(place, command):
    """A run is shown over the background that it was fitted over, a PLY over the preset's; --set wins over both."""
    assert given(place, command)[1].background == SKY
    assert given(place, command, scene="ply")[1].background == (0, 0, 0)
    for scene in ("run", "ply"):
        _, shown = given(place, command, scene=scene, overrides=("background=1,0,0", "near=0.5"))
        assert shown.background == (1, 0, 0)
        assert shown.settings("fast") == RenderSettings.preset("fast", background=(1.0, 0.0, 0.0), near=0.5)


def test_a_run_is_a_folder_with_a_fit_in_it(place, tmp_path):
    """Not a data set that has a config.json, nor a folder with only a log."""
    assert is_run(place / "run")
    assert not is_run(place / "data")
    assert not is_run(place / "nowhere")
    for name in ("config.json", "log.jsonl"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / name).write_text("{}")
        assert not is_run(tmp_path / name)


@pytest.mark.parametrize("command", [Select, Fisher])
def test_a_run_without_its_log_is_one_for_every_option(place, tmp_path, command):
    """What is fitted and what is known come from the run, by whatever of its files are left; else one line."""
    shutil.copytree(place / "run", tmp_path / "run")
    (tmp_path / "run/log.jsonl").unlink()
    assert is_run(tmp_path / "run")
    args, its = given(tmp_path, command)
    named = known_views(str(tmp_path / "run"), args, its)
    for known in (known_views(None, args, its), named):
        assert [camera.name for camera in known.cameras] == ["1", "2", "4", "5", "7", "8"]
    (tmp_path / "run/config.json").write_text('{"schema": 1, "command": "scene"}')
    assert Source.of("--train", str(tmp_path / "run")).kind == "data"
    with pytest.raises(
        FileNotFoundError, match=r"run: must be a run folder, found no config\.json of a fit; run `drgs fit`"
    ):
        SceneInput.at(tmp_path / "run")
    (tmp_path / "run/config.json").write_text("{")
    (tmp_path / "run/state.safetensors").write_text("")
    assert Source.of("--train", str(tmp_path / "run")).kind == "run"
    with pytest.raises(ValueError, match=r"config\.json: must be valid JSON"):
        SceneInput.at(tmp_path / "run")


def test_kinds_of_sources(place):
    """A word is an orbit or a dome only where the option makes them; a list of cameras is told by what is in it."""
    kinds = {"run": "run", "data": "data", "list.json": "list", "data/transforms.json": "data", "gone": "data"}
    for text, kind in kinds.items():
        assert Source.of("--cameras", str(place / text), generated=("orbit",)).kind == kind
    assert [Source.of("--cameras", "dome", generated=generated).kind for generated in ((), ("orbit",), ("dome",))] == [
        "data",
        "data",
        "dome",
    ]


@pytest.mark.parametrize("kind", ["orbit", "dome", "list.json"])
def test_only_data_sets_have_a_split(place, kind):
    """One message, whatever the command."""
    text = str(place / kind) if "." in kind else kind
    for option in ("--cameras", "--candidates"):
        source = Source.of(option, text, generated=("orbit", "dome"))
        source.check_split("all")
        with pytest.raises(ValueError, match=f"^--split test must have {option} DATA, an? .* has no split; drop it$"):
            source.check_split("test")


@pytest.mark.parametrize(
    ("scene", "text", "expected"), [("ply", "run", "036"), ("ply", "data", "08"), ("run", "data", "036")]
)
def test_split_is_the_runs(place, scene, text, expected):
    """By the rule of the run that is named or looked at, else every 8th view: the same for every command."""
    text = str(place / text)
    for command in (Render, Crossval, Tradeoff):
        args, shown = given(place, command, scene=scene, split="test", cameras=text)
        cameras, _ = views_to_render(args, text, shown, 9)
        assert "".join(camera.name for camera in cameras) == expected
    args, shown = given(place, Fisher, scene=scene, split="test")
    known = known_views(str(place / "list.json"), args, shown)
    cameras, source = views_to_compare("--cameras", text, args, shown, known, fresh=True)
    assert "".join(camera.name for camera in cameras) == expected
    assert source == f"{text} (test)"


def test_cameras_are_a_runs_own_or_an_orbit(place):
    """Without --cameras, crossval and tradeoff look from a run's photographs, evenly; at a PLY, from an orbit."""
    args, shown = given(place, Tradeoff, limit=3)
    assert [camera.name for camera in views_to_sample(args, shown)[0]] == ["0", "3", "6"]
    args, shown = given(place, Tradeoff, scene="ply", limit=3)
    cameras, source = views_to_sample(args, shown)
    assert (len(cameras), source) == (3, "orbit, up minus-y")


@pytest.mark.parametrize("text", [None, "run", "data", "list.json"])
def test_known_views(place, text):
    """--train names all views of a data set or list, and those that a run was fitted to; by default the run's own.

    They are as large as in the fit, or as --info-pixels says.
    """
    args, shown = given(place, Select)
    known = known_views(text and str(place / text), args, shown)
    names = [camera.name for camera in known.cameras]
    if text != "list.json":
        assert names == (list(NAMES) if text == "data" else [name for name in NAMES if int(name) % 3])
        assert known.data == (place / "data").resolve()
    assert {(camera.width, camera.height) for camera in known.cameras} == {(10, 10)}
    assert known_views(text and str(place / text), args, shown, pixels=16).cameras[0].width == 4


def test_a_split_is_the_runs_offset_included(place, tmp_path):
    """`--split test` of a run that held out from another view on gives that run's test views."""
    shutil.copytree(place / "run", tmp_path / "run")
    path = tmp_path / "run/config.json"
    config = json.loads(path.read_text())
    config["fit"]["data"]["test_offset"] = 2
    path.write_text(json.dumps(config))
    args, its = given(tmp_path)
    for text in (place / "data", tmp_path / "run"):
        source = Source.of("--cameras", str(text))
        assert [view.name for view in source.split(source.dataset(args, its), "test", its)] == ["2", "5", "8"]


def test_a_run_whose_data_set_was_moved_says_so(place, tmp_path, capsys):
    """By the run, where its photographs were, and which option names cameras instead; `drgs eval` alike."""
    shutil.copytree(place / "run", tmp_path / "run")
    path = tmp_path / "run/config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"data": str(tmp_path / "moved")}))
    gone = r"run: the data set of the run must be at .*moved, found none; move it back, or name cameras with --"
    with pytest.raises(FileNotFoundError, match=gone + "cameras"):
        views_to_sample(*given(tmp_path, Tradeoff))
    with pytest.raises(FileNotFoundError, match=gone + "train"):
        known_views(None, *given(tmp_path, Select))
    assert cli.main(["eval", str(tmp_path / "run")]) == 2
    assert "moved, found none; move it back\n" in capsys.readouterr().err


def test_cameras_are_taken_of_a_data_set_whose_maps_are_bad(place, tmp_path):
    """What a teacher's files hold is no matter of cameras."""
    shutil.copytree(place / "data", tmp_path / "data")
    (tmp_path / "data/rgb_feature_langseg").mkdir()
    (tmp_path / "data/rgb_feature_langseg/another_fmap_CxHxW.pt").write_bytes(b"damaged")
    args, shown = given(place, Tradeoff, cameras=str(tmp_path / "data"), limit=2)
    assert len(views_to_sample(args, shown)[0]) == 2


def test_refined_poses_are_a_runs_however_its_photographs_are_named(place, tmp_path):
    """By the run's default, by the run and by its data set; another data set keeps the poses that it states."""
    shutil.copytree(place / "run", tmp_path / "run")
    run = Run(tmp_path / "run")
    config = run.config()
    (run.path / "config.json").write_text(json.dumps(config | {"poses": {"reprojection": None, "refined": True}}))
    args, its = given(place, Fisher)
    stated = {camera.name: camera for camera in known_views(None, args, its).cameras}
    moved = []
    for camera in stated.values():
        w2c = camera.w2c.copy()
        w2c[0, 3] += 0.1
        moved.append(dataclasses.replace(camera, w2c=w2c))
    save_cameras_json(run.path / "refined_cameras.json", moved)
    shutil.copytree(place / "data", tmp_path / "data")
    args, its = given(tmp_path, Fisher)
    for name, by in ((None, 0.1), (tmp_path / "run", 0.1), (place / "data", 0.1), (tmp_path / "data", 0.0)):
        cameras = known_views(None if name is None else str(name), args, its).cameras
        seen = [camera for camera in cameras if camera.name in stated]  # a data set has those that are held out, too
        assert len(seen) == len(stated)
        assert [camera.w2c[0, 3] - stated[camera.name].w2c[0, 3] for camera in seen] == pytest.approx([by] * len(seen))
