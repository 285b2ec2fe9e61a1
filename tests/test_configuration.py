"""What a fit does is one configuration, of records by subject: made in Python, by options, and by files."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys

import pytest

from drgs import cli
from drgs.checks.records import options_in, part_of
from drgs.commands.command_line import HEADINGS, config_fields, help_page, written
from drgs.commands.values import ORBIT_KEYS, parsed_orbit
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.information.prior import Prior
from drgs.settings import RenderSettings

FULL = FitConfig().replace(
    settings=RenderSettings.preset("gsplat", background=(1.0, 0.5, 0.0)),
    max_steps=12,
    max_gaussians=50,
    test_cameras=("cam00",),
    grid_rate=(0.1, 0.01),
    policy="random",
    add=3,
    blocks=("geometry", "backdrop"),
    prior=Prior(1e-3, True, {"sh": 0.5}),
    weights={"sh": 2.0},
    groups=("means", "sh"),
    measure=(3, 4),
)


# ------------------------------------------------------------------------------------------------------- in Python


def test_any_field_is_named_alone():
    """`of` and `replace` put a field where it belongs, however deep, and leave the others as they are."""
    config = FitConfig().replace(max_gaussians=7, criterion="eig", save_every=5)
    assert config.density.max_gaussians == 7
    assert config.selection.scoring.criterion == "eig"
    assert config.replace(max_gaussians=9, seed=1) == dataclasses.replace(
        config, seed=1, density=dataclasses.replace(config.density, max_gaussians=9)
    )
    assert config.replace(selection=None, add=4).selection == SelectionConfig(add=4)
    assert FitConfig().replace() == FitConfig()
    assert FitConfig().selection is None


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"max_gausians": 5},
            "FitConfig: there must be a field of the name, got 'max_gausians'; did you mean max_gaussians",
        ),
        ({"zzz": 5}, "got 'zzz'; none has a name like it"),
        ({"max_gaussians": 0}, r"fit: max_gaussians must be a whole number in \[1, 1000000000\], got 0"),
        ({"data": 3}, "fit: data must be a DataConfig, got 3"),
        ({"policy": "best"}, "fit: policy must be one of fisher"),
        ({"weights": {"sh": "x"}}, "weights of sh must be"),
        ({"static_share": 1.0}, "fit: static_share must be below 1"),
    ],
)
def test_mistakes_are_one_line(fields, message):
    """A name that is misspelt is refused with the nearest, a value with its range."""
    with pytest.raises(ValueError, match=message) as error:
        FitConfig().replace(**fields)
    assert "\n" not in str(error.value)


# ------------------------------------------------------------------------------------------------------- as files


def test_files_hold_the_records():
    """What is written is nested JSON and reads back as it was, all fields."""
    record = json.loads(json.dumps(FULL.to_json()))
    assert FitConfig.from_json(record) == FULL
    assert record["density"]["max_gaussians"] == 50
    prior = {"value": 1e-3, "relative": True, "groups": {"sh": 0.5}, "length": None}
    assert record["selection"]["scoring"]["prior"] == prior
    assert set(record["selection"]["scoring"]) & {"settings", "semantics"} == set()


TOML = """
max_steps = 500
[settings]
preset = "gsplat"
max_hits = 5
[data]
test_every = 4
[selection]
add = 3
[selection.scoring]
criterion = "eig"
prior = {value = 1e-4}
"""


@pytest.fixture
def files(tmp_path):
    """The same as TOML and JSON, and the folder of a run."""
    (tmp_path / "a.toml").write_text(TOML)
    (tmp_path / "run").mkdir()
    record = {"schema": 2, "command": "fit", "data": "scene", "train": ["a"], "test": [], "fit": FULL.to_json()}
    (tmp_path / "run/config.json").write_text(json.dumps(record))
    return tmp_path


def _fit(*words: str) -> FitConfig:
    return cli._parse_arguments(["fit", "scene", "-o", "out", *words]).fit


def test_a_file_says_what_options_say(files):
    """Fields that it leaves out have their defaults; a preset is what its settings are put over."""
    wanted = FitConfig().replace(
        settings=RenderSettings.preset("gsplat", max_hits=5),
        max_steps=500,
        test_every=4,
        add=3,
        criterion="eig",
        prior=Prior(1e-4),
    )
    assert _fit("--config", str(files / "a.toml")) == wanted
    (files / "b.json").write_text(json.dumps({"max_steps": 500, "max_gaussians": 9, "data": {"times": 2}}))
    assert _fit(f"--config={files / 'b.json'}") == FitConfig().replace(max_steps=500, max_gaussians=9, times=2)


def test_a_run_is_repeated_from_its_config(files):
    """Every field, those without an option, too: by its folder or by its file."""
    for name in ("run", "run/config.json"):
        assert _fit("--config", str(files / name)) == FULL


def test_the_command_line_wins(files):
    """Over a file, both ways of a flag included; `--views all` leaves a file's selection aside."""
    run = ["--config", str(files / "run")]
    assert _fit(*run, "--max-gaussians", "8", "--set", "max_hits=3", "--policy", "uniform") == FULL.replace(
        settings=FULL.settings.replace(max_hits=3), max_gaussians=8, policy="uniform"
    )
    assert _fit(*run, "--views", "all") == FULL.replace(selection=None)
    (files / "on.json").write_text('{"deterministic": true}')
    assert _fit("--config", str(files / "on.json")).deterministic
    assert not _fit("--config", str(files / "on.json"), "--no-deterministic").deterministic


def test_only_a_person_names_functions_of_others(files):
    """A run by a policy of one's own is repeated where the command line names the policy, too."""
    (files / "own.toml").write_text("[selection]\npolicy = 'mine:policy'\nadd = 2")
    again = _fit("--config", str(files / "own.toml"), "--policy", "mine:policy")
    assert again == FitConfig().replace(policy="mine:policy", add=2)


@pytest.mark.slow
def test_select_and_reproduce_take_the_same_file(files, tmp_path):
    """`select` the settings and what scores views; `reproduce` all, over the fits of its scale."""
    from drgs.studies.plan import plan_of

    args = cli._parse_arguments(["select", "x", "--candidates", "dome", "--config", str(files / "run")])
    assert args.scoring() == FULL.selection.scoring
    assert (args.policy, args.settings()) == ("random", FULL.settings)
    usual, changed = (
        plan_of("static", "tiny", tmp_path, policies=["random"], fields=fields).study.fit
        for fields in ({}, config_fields(files / "a.toml", {}))
    )
    stated = {k: x for k, x in config_fields(files / "a.toml", {}).items() if k != "selection"}
    assert changed == usual.replace(renderers=("gsplat",), **stated)
    assert (changed.max_steps, changed.density.max_gaussians) == (500, usual.density.max_gaussians)
    args = cli._parse_arguments(["reproduce", "static", "-o", "x", "--config", str(files / "a.toml")])
    assert args.test_every == 4


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.toml", "max_steps = ", "a.toml: must be valid TOML, got"),
        ("a.json", "{", "a.json: must be valid JSON, got"),
        (
            "a.toml",
            "[density]\nmax_gausians = 3",
            "a.toml: config must hold known fields, got 'max_gausians'; did you mean",
        ),
        (
            "a.toml",
            "[density]\nmax_gaussians = 'x'",
            "a.toml: max_gaussians must be a whole number in [1, 1000000000], got",
        ),
        ("a.toml", "max_steps = 2024-01-01", "a.toml: max_steps must be a whole number"),
        ("a.toml", "density = 3", "a.toml: density must be an object with fields of DensityConfig, got the int 3"),
        ("a.toml", "[settings]\npreset = 'best'", "a.toml: RenderSettings.preset: name must be one of exact"),
        (
            "a.toml",
            "[settings]\nextend = 3",
            "a.toml: settings must hold known fields, got 'extend'; did you mean extent?",
        ),
        ("a.toml", "[settings]\norder = 'entry'", "a.toml: RenderSettings: order='entry'"),
        ("a.json", "[1]", "a.json: config must be a dict"),
        ("a.json", "[" * 100_000, "a.json: must be valid JSON, got one that is nested too deeply"),
        ("a.toml", "a = " + "[" * 100_000, "a.toml: must be valid TOML"),
        ("a.toml", "#" * (1 << 20) + "##", "a.toml: must be a configuration of at most 1 MiB, is larger"),
        (
            "a.toml",
            "[selection]\npolicy = 'os:abort'",
            "a.toml: policy must be a name in a file, got 'os:abort', which would be imported; add --policy os:abort",
        ),
        ("a.toml", "[selection.scoring]\ncriterion = 'os:abort'", "a.toml: criterion must be a name in a file"),
        ("a.yaml", "a: 1", "--config: must be a .toml or .json file, or a run folder, got"),
        ("nowhere.toml", None, "nowhere.toml: must be a configuration, found none"),
    ],
)
def test_bad_files_are_one_line(tmp_path, capsys, name, text, told):
    """With the file and the field; nothing else is done."""
    if text is not None:
        (tmp_path / name).write_text(text)
    assert cli.main(["fit", str(tmp_path), "-o", str(tmp_path / "run"), "--config", str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert error.startswith("drgs fit: ")
    assert not (tmp_path / "run").exists()


# ------------------------------------------------------------------------------------------------ shape of an orbit


def test_keys_of_an_orbit():
    """Several in one text or in several, points with commas in them; a later one wins."""
    assert parsed_orbit(["elevation=30,span=180", "center=0,-1,2.5,up=z", "span=90"]) == {
        "elevation": 30.0,
        "span": 90.0,
        "center": (0.0, -1.0, 2.5),
        "up": (0.0, 0.0, 1.0),
    }
    assert parsed_orbit(["up=auto"]) == {"up": None}
    for text, told in (
        ("elevatoin=3", "--orbit: must be of a known key, got 'elevatoin=3'; did you mean elevation"),
        ("elevation", "--orbit: must be KEY=VALUE, got 'elevation'"),
        ("up=w", "--orbit up must be one of auto, x, y, z, minus-x"),
        ("center=1,2", "--orbit center must be three numbers, X,Y,Z, got '1,2'"),
        ("span=wide", "--orbit span must be a number, got 'wide'"),
    ):
        with pytest.raises(ValueError, match=told):
            parsed_orbit([text])
    with pytest.raises(ValueError, match="known key, got 'fov=3'"):
        parsed_orbit(["fov=3"], [key for key in ORBIT_KEYS if key != "fov"])


# -------------------------------------------------------------------------------------------------------------- help


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_all_has_every_option(name, capsys):
    """Each that the parser knows, with a text; `--help` has at most 24 of them and says how many more there are."""
    for word in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as end:
            cli.main([name, word])
        assert not end.value.code
    text = capsys.readouterr().out
    short, whole = (f"usage: drgs {name}{part}" for part in text.split(f"usage: drgs {name}")[1:])
    found = [option for option in options_in(cli.COMMANDS[name]).values() if not option.spec.file_only]
    for option in found:
        assert len(option.spec.help) > 8
        spelled = option.spec.metavar or option.flag.removeprefix("--")
        assert spelled in whole or option.spec.positional, option.name
    shown = [option for option in found if not option.spec.rare]
    assert len(shown) <= 24
    assert all(option.flag.removeprefix("--") in short for option in shown if not option.spec.positional)
    more = len(found) - len(shown)
    assert (f"{more} more: drgs {name} --help-all" in short) == (more > 0)
    assert max(map(len, text.splitlines())) <= 100
    headings = [line for line in whole.splitlines() if line in HEADINGS]
    assert headings == [heading for heading in HEADINGS if heading in headings]
    assert {option.heading for option in found} == set(headings)


def test_help_begins_with_what_is_needed():
    """What a command works on, where it writes, then what is most often said."""
    fit = [
        line.split()[:2]
        for line in help_page("fit", cli.COMMANDS["fit"]).splitlines()
        if line.startswith("  ") and line[2] != " "
    ]
    assert [words[0] for words in fit[:4]] == ["DATA", "-o,", "--config", "--resume"]
    select = help_page("select", cli.COMMANDS["select"])
    assert select.index("--candidates") < select.index("--policy") < select.index("--variant")
    assert "elevation  " in select
    assert "fov  " not in select


def test_help_shows_the_defaults_of_a_file(files, capsys):
    """With `--config`, what a file says is what is left to be changed."""
    with pytest.raises(SystemExit):
        cli.main(["fit", "--config", str(files / "a.toml"), "--help"])
    assert "Optimizer steps. (default: 500)" in capsys.readouterr().out


def test_defaults_are_as_a_person_writes_them():
    """Fractions and powers of ten; what is written reads back as the same number."""
    told = {3 / 17: "3/17", 1 / 30: "1/30", 1.6e-4: "1.6e-4", 0.001: "1e-3", 0.05: "0.05", 120.0: "120", 0.0: "0"}
    assert {value: written(value) for value in told} == told
    assert written((1.6e-4, 1.6e-6)) == "1.6e-4 1.6e-6"
    assert [written(x) for x in (None, (), 30_000, "auto", 0.1 + 0.2)] == [
        "",
        "",
        "30000",
        "auto",
        "0.30000000000000004",
    ]


@pytest.mark.parametrize("words", [["--help"], ["fit", "--help-all"]])
def test_help_loads_nothing_heavy(words):
    """Of what is not Python's own, drgs alone, and of that no command; the test of its time is in test_cli.py."""
    loaded = _loaded_by(words)
    others = {name.partition(".")[0] for name in loaded} - sys.stdlib_module_names
    commands = {name for name in loaded if name.startswith("drgs.commands.") and name.count(".") == 2}
    assert others == {"drgs"}
    assert commands == {f"drgs.commands.{name}" for name in ("command_line", "options", "values")}


def test_info_loads_no_torch():
    """`drgs info` starts Dr.Jit, which says what libLLVM it compiles with, and loads nothing else of weight."""
    loaded = _loaded_by(["info"], DRGS_VARIANT="llvm_ad_rgb")
    assert "drjit" in loaded
    assert not loaded & {"torch", "mitsuba", "cv2"}


def _loaded_by(words: list[str], **environ: str) -> set[str]:
    """Names of the modules that a command loads in a process of its own."""
    code = (
        "import sys; before = {*sys.modules}\n"
        "import drgs.cli\n"
        f"try: drgs.cli.main({words!r})\n"
        "except SystemExit: pass\n"
        "print(*({*sys.modules} - before))"
    )
    environ = {**os.environ, **environ}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environ)
    return set(done.stdout.splitlines()[-1].split())


def test_records_are_not_made_of_themselves():
    """A nested record has options, be it optional; plain values and render settings have none."""
    assert part_of(SelectionConfig | None) is SelectionConfig
    assert part_of(Prior | None) is Prior
    assert part_of(RenderSettings) is part_of(int) is None
