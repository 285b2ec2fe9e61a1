"""Options of the command line offer what there is, and default to what a call from Python would do."""

import dataclasses
import importlib
import inspect
import subprocess
import sys
import textwrap
import typing

import pytest

from drgs import cli, fisher, gain, runtime, select
from drgs.commands import making_options, options
from drgs.commands.option_help import options_in
from drgs.data import sfm
from drgs.fitting.config import DataConfig, FitConfig, SelectionConfig
from drgs.fitting.renderers import own_preset
from drgs.guards.records import hints_of, part_of, texts_of, ways_of
from drgs.information.choices import CRITERION_NAMES, POLICY_NAMES, Criterion, Policy
from drgs.settings import PRESETS, RenderSettings

pytestmark = pytest.mark.core


def _choices(command: type, name: str) -> tuple:
    """What an option may be, by its type."""
    return typing.get_args(typing.get_type_hints(command)[name])


def _of_records(kind: type) -> dict[str, typing.Any]:
    """Field -> default, of a record and of its parts, those that hold fields themselves aside."""
    found = {}
    for name, hint in hints_of(kind).items():
        value = getattr(kind(), name)
        found |= _of_records(part) if (part := part_of(hint)) and value is not None else {name: value}
    return found


def test_texts_of_any_python():
    """Python 3.13 takes the indentation of the code off docstrings; what they say of fields is read all the same."""
    texts = dict(texts_of(DataConfig))
    as_is = DataConfig.__doc__
    for doc in (inspect.cleandoc(as_is), textwrap.indent(inspect.cleandoc(as_is), "    ").lstrip()):
        texts_of.cache_clear()
        DataConfig.__doc__ = doc
        try:
            assert dict(texts_of(DataConfig)) == texts
        finally:
            DataConfig.__doc__ = as_is
            texts_of.cache_clear()
    assert set(texts) >= {"max_pixels", "exposure", "poses"}


def test_fit_options_are_the_fields_of_its_records():
    """Every field of a fit's configuration is an option of `fit`, with its type, its default and its text; but for the
    render settings, which are --preset and --set, lambda, which is a number and a flag here, and names and weights of
    groups, which a file says.
    """
    fields = _of_records(FitConfig) | _of_records(SelectionConfig)
    offered = typing.get_type_hints(options.Fit)
    texts = texts_of(FitConfig)
    shown = {option.name: option for option in options_in(options.Fit)}
    carried = {"weights", "groups"}
    assert set(fields) - set(offered) == {"settings", "selection"}
    for name in sorted(set(fields) & set(offered) - carried - {"prior"}):
        assert getattr(options.Fit, name) == fields[name], name
        # Help shows the names of policies and criteria; a config may hold the name of somebody's own.
        own = {"policy": Policy | str, "criterion": Criterion | str}
        assert offered[name] == own.get(name, _type_of(name)), name
        assert shown[name].text == texts[name], name
    assert not carried & set(shown)
    assert options.Fit(data="x", output="y").given_prior() is fields["prior"] is None


def _type_of(name: str) -> typing.Any:
    kind = FitConfig
    *ways, last = ways_of(FitConfig)[name]
    for step in ways:
        kind = part_of(hints_of(kind)[step])
    return hints_of(kind)[last]


@pytest.mark.parametrize("command", [options.Select, options.Fisher])
def test_information_options_are_those_of_an_active_fit(command):
    """`select` and `fisher` weigh views as an active fit does, and as Python's `Scoring()`: it is one record."""
    scoring = select.Scoring()
    shared = {*hints_of(select.Scoring)} & {field.name for field in dataclasses.fields(command)}
    assert {"method", "blocks", "probes"} <= shared
    for name in shared - {"weights", "groups"}:
        assert getattr(command, name) == getattr(scoring, name)
    assert SelectionConfig().scoring == scoring
    if command is options.Select:
        assert options.Select(scene="x", candidates="y").scoring() == scoring


def test_choices_are_what_there_is():
    """What an option offers is what the code knows, no more and no fewer."""
    for command in (options.Render, options.Select, options.Fisher, options.Tradeoff):
        assert _choices(command, "preset") == PRESETS
    for command, more in ((options.Fit, ()), (options.Eval, ("all",))):  # or none, which says what the fit is for
        named, none = _choices(command, "preset")
        assert (typing.get_args(named), none) == ((*more, *PRESETS), type(None))
    assert _choices(options.Crossval, "preset") == ("auto", *PRESETS)
    assert len({RenderSettings.preset(name) for name in PRESETS}) == len(PRESETS)
    assert options.Fit.preset is None
    assert FitConfig().settings == RenderSettings.preset(own_preset(FitConfig().renderers))
    for command in (options.Fit, options.Select):
        named, _ = _choices(command, "policy")
        assert typing.get_args(named) == tuple(select.POLICIES) == POLICY_NAMES
        named, _ = _choices(command, "criterion")
        assert typing.get_args(named) == tuple(gain.CRITERIA) == CRITERION_NAMES
        assert _choices(command, "method") == fisher.METHODS
    assert _choices(options.Info, "variant") == ("auto", *runtime.VARIANTS)
    parameters = inspect.signature(sfm.run_sfm).parameters
    assert _choices(making_options.Sfm, "camera_model") == sfm.CAMERA_MODELS
    assert _choices(making_options.Sfm, "matcher") == sfm.MATCHING
    assert making_options.Sfm.camera_model == parameters["camera_model"].default
    assert making_options.Sfm.matcher == parameters["matching"].default
    assert making_options.Sfm.seed == parameters["seed"].default


@pytest.mark.parametrize("name", cli._OPTIONS)
def test_a_command_is_a_module(name):
    """All have one shape: `run(args)` in the module of the command's name, with the command's options."""
    run = importlib.import_module(f"drgs.commands.{name}").run
    (args,) = inspect.signature(run).parameters.values()
    assert (args.name, args.annotation) == ("args", cli._OPTIONS[name].__name__)


def test_options_import_nothing_heavy():
    """The lists and records that options are read from come without torch, NumPy and Dr.Jit."""
    code = "import sys; import drgs.cli; print([x for x in ('torch', 'numpy', 'drjit', 'cv2') if x in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
