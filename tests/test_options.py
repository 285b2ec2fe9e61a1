"""Options of the command line offer what there is, and default to what a call from Python would do."""

import dataclasses
import importlib
import inspect
import typing
from pathlib import Path
from typing import Literal

import pytest

from drgs import cli, codecs, fisher, gain, runtime, select
from drgs.checks.records import Record, option, options_in, part
from drgs.commands import options
from drgs.commands.command_line import help_page, parsed_options, words_of
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.fitting.renderers import own_preset
from drgs.information.choices import CRITERION_NAMES, POLICY_NAMES
from drgs.settings import PRESETS, RenderSettings
from drgs.sfm import reconstruction

pytestmark = pytest.mark.core


def _choices(command: type, name: str) -> tuple:
    """What an option may be, by its type."""
    return typing.get_args(options_in(command)[name].hint)


@dataclasses.dataclass(frozen=True)
class Inner(Record):
    """A record of a package."""

    where = "toy"
    count: int = option(3, "How many.", within=(1, 9))
    names: tuple[str, ...] = option(("a",), "Names.", commas=True, none="none", rare=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Toy(options.Common):
    """A command."""

    place: Path = option(help="Where.", positional=True)
    output: Path = option(help="Out.", short="o")
    inner: Inner = part(Inner())
    size: tuple[int, int] | None = option(None, "Two numbers.")
    rates: tuple[float, ...] = option((0.5,), "Numbers.")
    sets: tuple[str, ...] = option((), "Any.", flag="set", repeat=True)
    kind: Literal["one", "two"] = option("one", "Kind.")
    loud: bool = option(False, "Noise.")
    share: float = option(0.5, "Share.", within=(0, 1))


def test_one_field_is_an_option_everywhere():
    """A field of a record is spelled, parsed, checked, shown and written back by what it says of itself."""
    line = "here -o out --count 4 --names a,b --size 3 -4 --rates 1 -2e-3 --set x=1 --set y --kind two --no-loud"
    args = parsed_options(Toy, line.split())
    assert (args.place, args.output, args.inner) == (Path("here"), Path("out"), Inner(4, ("a", "b")))
    assert (args.size, args.rates, args.sets, args.kind, args.loud) == (
        (3, -4),
        (1.0, -2e-3),
        ("x=1", "y"),
        "two",
        False,
    )
    assert parsed_options(Toy, ["--rates", "1", "here", "-oout", "--loud", "--names=none"]).inner.names == ()
    assert "--count INT" in help_page("toy", Toy)
    assert "--names" not in help_page("toy", Toy)
    assert "(default: a)" in help_page("toy", Toy, ["--help-all"])
    known = options_in(Toy)
    for name, value in (("names", ("a", "b")), ("size", (3, -4)), ("rates", (1e-3, 2.0)), ("count", 5)):
        words = words_of(known[name], value)
        found = parsed_options(Toy, ["x", "-o", "y", *words])
        for step in known[name].path:
            found = getattr(found, step)
        assert found == value


@pytest.mark.parametrize("flag", ["--updates-per-step", "--num-downscales", "--dropout"])
def test_auto_is_the_word_for_none(flag):
    """As help names it; messages say both, as a script has None."""
    name = flag[2:].replace("-", "_")
    value = parsed_options(options.Fit, ["data", "-o", "run", flag, "auto"])
    for step in options_in(options.Fit)[name].path:
        value = getattr(value, step)
    assert value is None
    with pytest.raises(ValueError, match=rf"fit: {name} must be .*, or None \(auto\), got -1"):
        parsed_options(options.Fit, ["data", "-o", "run", flag, "-1"])


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("x", "--output must be given, is missing; add --output PATH"),
        ("-o y", "PLACE must be given"),
        ("x -o y --cuont 3", "--cuont must be an option of this command, is none; did you mean --count"),
        ("x -o y --zzzz", "--zzzz must be an option of this command, is none; none has a name like it"),
        ("x -o y z", "arguments must be PLACE, got 'z' besides"),
        ("x -o y --count", "--count must have a value, INT, got none"),
        ("x -o y --count a", "--count must be a whole number, got 'a'"),
        ("x -o y --count 10", r"toy: count must be a whole number in \[1, 9\], got 10"),
        ("x -o y --share 2", r"--share must be in \[0, 1\], got 2; correct it"),
        ("x -o y --size 3", "--size must have 2 values, got 3"),
        ("x -o y --kind tow", "--kind must be one of one, two, got 'tow'; did you mean two"),
        ("x -o y --loud=yes", "--loud must be without a value, got 'yes'; drop it, or say --no-loud"),
        ("x -o y --no-loud=3", "--no-loud must be without a value, got '3'; drop it, or say --loud"),
        ("x -o y --no-count 3", "--no-count must be an option of this command"),
    ],
)
def test_bad_usage_says_what_must_hold(line, told):
    """What must hold, what was got, and what to do, in one line."""
    with pytest.raises(ValueError, match=told) as error:
        parsed_options(Toy, line.split())
    assert "\n" not in str(error.value)


def test_every_field_of_a_fit_is_an_option():
    """With a text; but for the render settings, which are --preset and --set, and names and weights of groups, which a
    file says.
    """
    offered, fields = options_in(options.Fit), options_in(FitConfig)
    assert len(fields) > 70
    assert set(fields) <= set(offered)
    assert {name for name, one in fields.items() if one.spec.file_only} == {
        "weights",
        "groups",
        "prior_groups",
        "prior_length",
    }
    for name, one in fields.items():
        assert offered[name].path == ("fit", *one.path)
        assert one.spec.help[0].isupper() or one.spec.help.startswith("lambda"), name
        assert one.spec.help[-1] in ".?)", name
    assert parsed_options(options.Fit, ["x", "-o", "y"]).fit == FitConfig()


@pytest.mark.parametrize("command", [options.Select, options.Fisher])
def test_information_options_are_those_of_an_active_fit(command):
    """`select` and `fisher` weigh views as an active fit does, and as Python's `Scoring()`: it is one record."""
    words = {options.Select: ["x", "--candidates", "y"], options.Fisher: ["x"]}[command]
    assert parsed_options(command, words).scoring == SelectionConfig().scoring == select.Scoring()


def test_a_scene_is_what_is_read():
    """Help names every format and folder that `load_gaussians` reads; query needs features."""
    told = f"A run folder, or Gaussians: {codecs.readable()}."
    scenes = {name: options_in(kind).get("scene") for name, kind in options.COMMANDS.items()}
    texts = {name: one.spec.help for name, one in scenes.items() if one is not None}
    assert {name for name, text in texts.items() if text != told} == {"query"}
    assert len(texts) > 8


def test_choices_are_what_there_is():
    """Presets, policies, criteria and methods are those of the package."""
    for command in (options.Render, options.Select, options.Query, options.Fisher):
        assert _choices(command, "preset") == PRESETS
    for command, more in ((options.Fit, ()), (options.Eval, ("all",))):  # or none, which says what the fit is for
        named, none = _choices(command, "preset")
        assert (typing.get_args(named), none) == ((*more, *PRESETS), type(None))
    assert _choices(options.Crossval, "preset") == ("auto", *PRESETS)
    assert len({RenderSettings.preset(name) for name in PRESETS}) == len(PRESETS)
    assert options.Fit.preset is None
    assert FitConfig().settings == RenderSettings.preset(own_preset(FitConfig().renderers))
    assert tuple(select.POLICIES) == POLICY_NAMES
    assert tuple(gain.CRITERIA) == CRITERION_NAMES
    for command in (options.Fit, options.Select):
        assert options_in(command)["policy"].spec.metavar == "{" + ",".join(POLICY_NAMES) + "}|TEXT"
        assert options_in(command)["criterion"].spec.metavar == "{" + ",".join(CRITERION_NAMES) + "}|TEXT"
        assert _choices(command, "method") == fisher.METHODS
    assert _choices(options.Info, "variant") == ("auto", *runtime.VARIANTS)
    defaults = reconstruction.SfmOptions()
    assert _choices(options.Sfm, "camera_model") == reconstruction.CAMERA_MODELS
    assert _choices(options.Sfm, "matcher") == reconstruction.MATCHING
    assert options.Sfm.camera_model == defaults.camera_model
    assert options.Sfm.matcher == defaults.matching
    assert options.Sfm.seed == defaults.seed


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_a_command_is_a_module(name):
    """All have one shape: `run(args)` in the module of the command's name, with the command's options."""
    run = importlib.import_module(f"drgs.commands.{name}").run
    (args,) = inspect.signature(run).parameters.values()
    assert (args.name, args.annotation) == ("args", cli.COMMANDS[name].__name__)
