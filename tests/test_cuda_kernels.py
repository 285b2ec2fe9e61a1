"""The kernels that a card would run, compiled without one, and the machine that is taken for one with a card."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
HERE = ROOT / "benchmarks" / "cuda"
sys.path[:0] = [str(ROOT / "benchmarks"), str(HERE)]

import card  # noqa: E402
import kernels  # noqa: E402

NEEDED = pytest.mark.skipif(kernels.missing() is not None, reason=f"no kernels: {kernels.missing()}")
CUDA = torch.device("cuda")


def compiled(tmp_path: Path, names: list[str]) -> tuple[dict, list[dict]]:
    """What cases ask of a card, and their kernels."""
    cases = kernels.driven(tmp_path, names)
    return cases, kernels.rows(tmp_path, cases, ("sm_90",))


@pytest.mark.slow
@NEEDED
def test_kernels_compile_and_spill_nothing(tmp_path):
    """Forward, backward and three tangents of a frame, from the projection to the walk along lists."""
    cases, found = compiled(tmp_path, ["peak, order of centers"])
    assert list(cases) == ["peak, order of centers"]
    assert cases["peak, order of centers"]["launches"] > 100
    assert len(found) > 10
    assert any(row["loops"] and row["sm_90"]["registers"] > 60 for row in found)
    assert kernels.faults(cases, found) == []


@NEEDED
@pytest.mark.slow
def test_every_kernel_compiles(tmp_path):
    """All of them, those that trace rays as far as they can be without OptiX."""
    assert kernels.faults(*compiled(tmp_path, [])) == []


@NEEDED
def test_damaged_ptx_is_refused(tmp_path):
    """What ptxas does not compile is a fault, and so is a spill in a loop, and a reciprocal of 20 bits."""
    good = tmp_path / "000.ptx"
    good.write_text(".version 8.0\n.target sm_80\n.address_size 64\n.entry drjit_0() { ret; }\n")
    assert kernels.compiled(good, "sm_90")["spilled"] == 0
    bad = tmp_path / "001.ptx"
    bad.write_text(good.read_text().replace("ret;", "rte;"))
    assert "error" in kernels.compiled(bad, "sm_90")
    own = {"case": "a case", "loops": 2, "instructions": {}}
    fine, spilling = ({"registers": 40, "spilled": x, "local": 0, "shared": 0} for x in (0, 8))
    assert kernels.faults({}, [{**own, "sm_90": fine}]) == []
    assert kernels.faults({}, [{**own, "sm_90": spilling}]) == ["a case: sm_90: 8 bytes spilled, 40 registers"]
    rough = {**own, "instructions": {"rcp.approx.ftz.f64": 3}, "sm_90": fine}
    assert kernels.faults({"other": {"error": "E: it"}}, [rough])[1].startswith("a case: 3 float64 reciprocals")


@pytest.mark.skipif(not (HERE / "kernels.json").exists(), reason="no table: run benchmarks/cuda/kernels.py")
def test_committed_table_has_no_fault():
    """The kernels of benchmarks/cuda/kernels.json."""
    told = json.loads((HERE / "kernels.json").read_text())
    assert kernels.faults(told["cases"], [*told["kernels"], *told["old"]]) == []


def test_functions_of_optix_are_declared():
    """With the types that the first call has."""
    text = ".version 8.8\n.address_size 64\n.reg .b32 %r<9>;\n.reg .f32 %f<9>;\n"
    text += "call (%r0), _optix_get_launch_index_x, ();\ncall (%r1), _optix_other, (%rd2, %f3);\n"
    made = kernels.declared(text).splitlines()
    assert ".extern .func (.reg .b32 r0) _optix_get_launch_index_x();" in made
    assert ".extern .func (.reg .b32 r0) _optix_other(.reg .b64 a0, .reg .b32 a1);" in made


def test_tensors_of_both_sides_are_refused():
    """As a CUDA build of torch refuses them: but for single numbers, and for what is copied."""
    with card.Device() as device:
        x = torch.ones(3, requires_grad=True)
        there = x.to(CUDA)
        assert (there.device.type, x.device.type) == ("cuda", "cpu")
        assert torch.zeros(2, device=there.device).is_cuda
        assert (there * torch.tensor(2.0)).is_cuda
        with pytest.raises(RuntimeError, match="same device"):
            there + torch.ones(3)
        with pytest.raises(TypeError, match="numpy"):
            there.detach().numpy()
        before = device.waits
        assert there.sum().item() == 3
        assert there.cpu().device.type == "cpu"
        assert device.waits == before + 2
        (there * 2).sum().backward()
        assert x.grad.device.type == "cpu"
    assert torch.equal(x.grad, torch.full((3,), 2.0))


@pytest.mark.slow
def test_answers_are_given_in_the_order_of_the_questions():
    """Another question than LLVM has answered is an error that names both.

    In a process of its own: `__getitem__` of Dr.Jit's arrays, once it was replaced and is back, takes no masks any
    more, for Python then fills the type's slots anew from the method of whole numbers.
    """
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "benchmarks"), str(HERE)))}
    found = subprocess.run(
        [sys.executable, "-c", _ANSWERS], env=environ, capture_output=True, text=True, timeout=300, check=False
    )
    assert found.returncode == 0, found.stderr


_ANSWERS = r"""
import re

import card
from drgs import runtime

lib = runtime.dr_types()
answers = card.Answers()
with answers.written():
    lib.Float([1.0, 2.0]).numpy()
    lib.Float([3.0, 4.0]).torch()
assert [what for what, _ in answers.kept] == ["numpy of Float [2]", "torch of Float [2]"]
with card.Device(), answers.given():
    assert lib.Float([0.0, 0.0]).numpy().tolist() == [1.0, 2.0]
    assert lib.Float([0.0, 0.0]).torch().is_cuda
try:
    with answers.given():
        lib.Float([0.0, 0.0, 0.0]).numpy()
except RuntimeError as error:
    assert re.search(r"LLVM has read numpy of Float \[2\], the card reads numpy of Float \[3\]", str(error)), error
else:
    raise AssertionError("another question was answered")
"""


@pytest.mark.every(3)
@pytest.mark.parametrize("preset", ["fast", "exact"])
@pytest.mark.parametrize("share", [1, 2])
def test_pixels_a_lane_tell_the_same(monkeypatch, preset, share):
    """Images, gradients, tangents and information as a card takes them, where LLVM shares a lane among four."""
    import drgs
    from drgs import fisher
    from drgs.testing import random_scene
    from drgs.tracing import composite, tiles

    g, (camera,) = random_scene()
    settings = drgs.RenderSettings.preset(preset)
    tangents = {"means": torch.randn(5, *g.means.shape, generator=torch.Generator().manual_seed(0))}

    def told() -> dict[str, torch.Tensor]:
        own = drgs.Gaussians(**{name: x.detach().requires_grad_() for name, x in g.parameters().items()})
        out = drgs.render(own, camera, settings)
        out.rgb.square().sum().backward()
        pushed = drgs.render_jvp(g, camera, tangents, settings).rgb
        found = {"rgb": out.rgb.detach(), "gradient": own.means.grad, "pushed": pushed}
        return {**found, **fisher.diagonal(g, camera, settings), "blocks": fisher.blocks(g, camera, settings)}

    four = told()
    for module in (composite, tiles):
        monkeypatch.setattr(module, "pixels_a_lane", lambda basis=0: share)
    for name, one in told().items():
        assert torch.allclose(one, four[name], rtol=1e-4, atol=1e-5 * float(four[name].abs().max())), name


def test_check_says_what_is_missing(tmp_path):
    """One line, and nothing has run."""
    if Path("/dev/nvidia0").exists():
        pytest.skip("this machine has a card")
    output = tmp_path / "report.json"
    command = [sys.executable, str(HERE / "check.py"), "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": ""})
    assert done.returncode == 2
    assert re.fullmatch(r"cuda-check: [^\n]+; [^\n]+\n", done.stderr)
    assert not output.exists()
