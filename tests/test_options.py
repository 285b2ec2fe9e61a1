"""Options of the command line offer what there is, and default to what a call from Python would do."""

import dataclasses
import importlib
import inspect
import subprocess
import sys
import typing

import pytest

from drgs import cli, fisher, gain, runtime, select
from drgs.commands import making_options, options, orbits
from drgs.data import sfm
from drgs.fitting.config import ActiveConfig, FitConfig
from drgs.information.choices import CRITERION_NAMES, POLICY_NAMES, Criterion, Policy
from drgs.settings import PRESETS, RenderSettings


def _choices(command: type, name: str) -> tuple:
    """What an option may be, by its type."""
    return typing.get_args(typing.get_type_hints(command)[name])


@pytest.mark.parametrize("config", [FitConfig, ActiveConfig])
def test_fit_options_are_those_of_its_configs(config):
    """Every option of `fit` named as a field of FitConfig or ActiveConfig has its default and its type, choices
    included; and every field of ActiveConfig is an option, and of FitConfig all of features.
    """
    fields, offered = typing.get_type_hints(config), typing.get_type_hints(options.Fit)
    shared = set(fields) & {field.name for field in dataclasses.fields(options.Fit)}
    assert len(shared) >= 10
    for name in shared:
        assert getattr(options.Fit, name) == getattr(config, name), name
        # Help shows the names of policies and criteria; a config may hold the name of somebody's own.
        own = {"policy": Policy | str, "criterion": Criterion | str}
        assert offered[name] == own.get(name, fields[name]), name
    if config is ActiveConfig:
        assert shared == set(fields)
    assert {name for name in fields if "feature" in name or "decoder" in name} <= shared


@pytest.mark.parametrize("command", [options.Select, options.Fisher])
def test_information_options_are_those_of_an_active_fit(command):
    """`select` and `fisher` weigh views as an active fit does; Python's `Scoring()` agrees."""
    for name in ("method", "prior", "relative_prior", "info_pixels", "policy", "criterion"):
        if hasattr(command, name):
            assert getattr(command, name) == getattr(ActiveConfig, name)
    scoring = select.Scoring()
    assert gain.Prior.given(command.prior, command.relative_prior) == scoring.prior
    assert (command.method, ActiveConfig.criterion) == (scoring.method, scoring.criterion)


def test_choices_are_what_there_is():
    """What an option offers is what the code knows, no more and no fewer."""
    for command in (options.Render, options.Fit, options.Select, options.Fisher, options.Tradeoff):
        assert _choices(command, "preset") == PRESETS
    assert _choices(options.Crossval, "preset") == ("auto", *PRESETS)
    assert len({RenderSettings.preset(name) for name in PRESETS}) == len(PRESETS)
    assert options.Fit.preset == next(name for name in PRESETS if RenderSettings.preset(name) == FitConfig().settings)
    for command in (options.Fit, options.Select):
        named, _ = _choices(command, "policy")
        assert typing.get_args(named) == tuple(select.POLICIES) == POLICY_NAMES
        named, _ = _choices(command, "criterion")
        assert typing.get_args(named) == tuple(gain.CRITERIA) == CRITERION_NAMES
        assert _choices(command, "method") == fisher.METHODS
    assert _choices(options.Info, "variant") == ("auto", *runtime.VARIANTS)
    assert _choices(options.Render, "up") == ("auto", *orbits.UP)
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
