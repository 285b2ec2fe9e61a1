"""Backend discovery: the right libLLVM, found without loading any; refusals that say what to do."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest

from drgs import runtime
from drgs.runtime import libllvm, llvm_target, machine

ROOT = Path(__file__).resolve().parent.parent
MULTIARCH = libllvm._MULTIARCH


def _touch(root: Path, *paths: str) -> None:
    """Empty files; `link -> target` makes a relative symbolic link."""
    for text in paths:
        path, _, target = text.partition(" -> ")
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        if target:
            (root / path).symlink_to(target)
        else:
            (root / path).touch()


def _find(root: Path, **environ: str):
    return libllvm.find_libraries(environ, root=root, prefix=str(root / "no-python"))


def _python(code: str, **environ: str) -> subprocess.CompletedProcess:
    """Run code in a fresh interpreter; a value of "" removes the variable."""
    env = {**os.environ, **environ}
    env = {k: v for k, v in env.items() if v != ""}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=env, timeout=120)


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-14.so.1", (14,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM-17.0.6.so", (17, 0, 6)),
        ("libLLVM-19.so.1", (19,)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM-20.dylib", (20,)),
        ("libLLVM.19.1.dylib", (19, 1)),
        ("libLLVM.so", ()),
        ("libLLVM.dylib", ()),
        ("libLLVMSupport.so", ()),
        ("libLLVM.so.20.1-rust-1.88.0-stable", ()),
    ],
)
def test_version_from_file_name(tmp_path, name, version):
    """Names of Debian, Fedora, Arch, conda and macOS give their version; the file is empty."""
    _touch(tmp_path, f"lib/{name}")
    assert libllvm.library_version(tmp_path / "lib" / name) == version


def test_version_from_link_and_directory(tmp_path):
    """A name without a version takes it from the link's target, then from the directory."""
    _touch(
        tmp_path,
        "usr/lib/libLLVM.so.18.1",
        "usr/lib/libLLVM.so -> libLLVM.so.18.1",
        "opt/homebrew/Cellar/llvm/21.1.2/lib/libLLVM.dylib",
        "opt/homebrew/opt/llvm -> ../Cellar/llvm/21.1.2",
        "usr/local/opt/llvm@18/lib/libLLVM.dylib",
        "usr/lib/llvm-17/lib/libLLVM.so",
    )
    version = libllvm.library_version
    assert version(tmp_path / "usr/lib/libLLVM.so") == (18, 1)
    assert version(tmp_path / "opt/homebrew/opt/llvm/lib/libLLVM.dylib") == (21, 1, 2)
    assert version(tmp_path / "usr/local/opt/llvm@18/lib/libLLVM.dylib") == (18,)
    assert version(tmp_path / "usr/lib/llvm-17/lib/libLLVM.so") == (17,)


def test_version_from_soname(tmp_path):
    """A real library under a name that says nothing is told by its ELF soname."""
    real = [x for x in libllvm.find_libraries({}) if x.source != "environment" and x.version]
    if sys.platform != "linux" or not real:
        pytest.skip("no libLLVM on this Linux machine")
    # Only the pages of the ELF tables are read, so a hard copy of 100 MB is not needed: link it.
    hidden = tmp_path / "libLLVM.so"
    try:
        os.link(os.path.realpath(real[0].path), hidden)
    except OSError:
        pytest.skip("tmp_path is on another file system: cannot hard-link the library")
    assert libllvm.library_version(hidden)[0] == real[0].version[0]


@pytest.mark.parametrize("junk", [b"", b"\x7fELF\x02\x01", b"\x7fELF\x02\x01" + b"\xff" * 200])
def test_version_of_damaged_elf(tmp_path, junk):
    """Truncated or lying ELF headers give 'unknown', not an exception or a huge allocation."""
    (tmp_path / "libLLVM.so").write_bytes(junk)
    assert libllvm.library_version(tmp_path / "libLLVM.so") == ()


@pytest.mark.parametrize(
    "path",
    [
        f"usr/lib/{MULTIARCH}/libLLVM.so.19.1",  # Debian, Ubuntu
        "usr/lib/llvm-19/lib/libLLVM-19.so.1",  # apt.llvm.org
        "usr/lib64/libLLVM.so.19.1",  # Fedora, openSUSE
        "usr/lib64/llvm19/lib/libLLVM.so.19.1",  # Fedora, older version beside the default
        "usr/lib/libLLVM.so.19.1",  # Arch
        "usr/lib/llvm19/lib/libLLVM-19.so",  # Arch, Alpine
        "usr/lib/wsl/lib/libLLVM-19.so.1",
        "usr/local/lib/libLLVM.so.19.1",
        "opt/homebrew/opt/llvm@19/lib/libLLVM.dylib",
        "usr/local/opt/llvm@19/lib/libLLVM.dylib",
        "home/linuxbrew/.linuxbrew/opt/llvm@19/lib/libLLVM.so",
    ],
)
def test_known_places(tmp_path, path):
    """Each distribution's layout is found on its own."""
    _touch(tmp_path, path)
    (found,) = _find(tmp_path)
    assert found.path == str(tmp_path / path)
    assert found.version[0] == 19
    assert libllvm.require_llvm([found]) == found


def test_newest_first_and_links_counted_once(tmp_path):
    """Newest version first across places; one file under several names is one library."""
    _touch(
        tmp_path,
        f"usr/lib/{MULTIARCH}/libLLVM-14.so.1",
        f"usr/lib/{MULTIARCH}/libLLVM-14.0.6.so.1 -> libLLVM-14.so.1",
        f"usr/lib/{MULTIARCH}/libLLVM.so.9.1",
        f"usr/lib/llvm-14/lib/libLLVM-14.so.1 -> ../../{MULTIARCH}/libLLVM-14.so.1",
        f"usr/lib/{MULTIARCH}/libLLVM.so.19.1",
        f"usr/lib/{MULTIARCH}/libLLVM-19.so -> libLLVM.so.19.1",
        f"usr/lib/{MULTIARCH}/libLLVM-23.so -> gone.so",
        f"usr/lib/{MULTIARCH}/libLLVMSupport.so",
        "env/lib/libLLVM.so.22.1",
    )
    found = _find(tmp_path, CONDA_PREFIX=str(tmp_path / "env"))
    assert [(x.version[0], x.source) for x in found] == [
        (22, "conda"),
        (19, "system"),
        (14, "system"),
        (9, "system"),
    ]


def test_order_between_equals(tmp_path):
    """At equal versions: system, then conda, then Python's prefix, then Homebrew."""
    homebrew = "opt/homebrew/opt/llvm@19/lib/libLLVM.so.19.1"
    _touch(tmp_path, homebrew, "prefix/lib/libLLVM.so.19.1", "env/lib/libLLVM.so.19.1")
    _touch(tmp_path, "usr/lib64/libLLVM.so.19.1")
    found = libllvm.find_libraries(
        {"CONDA_PREFIX": str(tmp_path / "env")}, root=tmp_path, prefix=str(tmp_path / "prefix")
    )
    assert [Path(x.path).relative_to(tmp_path).parts[0] for x in found] == [
        "usr",
        "env",
        "prefix",
        "opt",
    ]


def test_environment_variable_is_the_only_candidate(tmp_path):
    """DRJIT_LIBLLVM_PATH wins over a newer system library, as it does for Dr.Jit."""
    _touch(tmp_path, "usr/lib64/libLLVM.so.22.1", "mine/libLLVM.so.18.1")
    mine = str(tmp_path / "mine/libLLVM.so.18.1")
    assert [x.path for x in _find(tmp_path, DRJIT_LIBLLVM_PATH=mine)] == [mine]


def test_32_bit_library_is_no_candidate(tmp_path):
    """Fedora and Arch keep 32-bit libraries in /usr/lib beside 64-bit ones: those cannot load."""
    _touch(tmp_path, "usr/lib64/libLLVM.so.19.1", "usr/lib/libLLVM.so.22.1")
    (tmp_path / "usr/lib/libLLVM.so.22.1").write_bytes(b"\x7fELF\x01\x01" + bytes(58))
    assert [x.version for x in _find(tmp_path)] == [(19, 1)]


def test_refusal_names_what_was_found(tmp_path):
    """14 (refused by Dr.Jit), 15 and 16 (abort the process) are named, with the remedy."""
    _touch(tmp_path, "usr/lib64/libLLVM-15.0.6.so", "usr/lib64/libLLVM-14.0.6.so.1")
    with pytest.raises(FileNotFoundError) as error:
        libllvm.require_llvm(_find(tmp_path))
    assert str(error.value) == (
        "drgs: no usable Dr.Jit backend: libLLVM >= 17 is needed, found 14.0.6, 15.0.6. Install it "
        "(Debian/Ubuntu: apt-get install libllvm19; conda: conda install -c conda-forge libllvm19; "
        "macOS: brew install llvm) or set DRJIT_LIBLLVM_PATH."
    )


def test_refusal_of_nothing(tmp_path):
    """An empty machine: 'found none'."""
    with pytest.raises(FileNotFoundError, match=r"libLLVM >= 17 is needed, found none\. Install"):
        libllvm.require_llvm(_find(tmp_path))


def test_refusal_of_environment_variable(tmp_path):
    """A named library that is too old or absent is an error of its own, not replaced silently."""
    _touch(tmp_path, "libLLVM-16.so")
    named = str(tmp_path / "libLLVM-16.so")
    with pytest.raises(ValueError, match=r"DRJIT_LIBLLVM_PATH must .* got 16 \(.*libLLVM-16\.so\)"):
        libllvm.require_llvm(_find(tmp_path, DRJIT_LIBLLVM_PATH=named))
    with pytest.raises(FileNotFoundError, match="does not exist; correct it or unset it"):
        libllvm.require_llvm(_find(tmp_path, DRJIT_LIBLLVM_PATH=str(tmp_path / "gone.so")))


def test_import_is_light_and_prepares():
    """`import drgs` takes < 0.3 s (measured 0.05), loads nothing heavy, sets DRJIT_LIBLLVM_PATH."""
    code = (
        "import sys, os, time; t = time.perf_counter(); import drgs; t = time.perf_counter() - t\n"
        "heavy = {'torch', 'drjit', 'mitsuba', 'cv2', 'pycolmap', 'numpy'} & set(sys.modules)\n"
        "print(t, os.environ.get('DRJIT_LIBLLVM_PATH'), sorted(heavy))"
    )
    best = 1e9
    for _ in range(3):
        done = _python(code, DRJIT_LIBLLVM_PATH="")
        assert done.returncode == 0, done.stderr
        seconds, path, heavy = done.stdout.split(maxsplit=2)
        best = min(best, float(seconds))
        assert heavy.strip() == "[]"
        if any(x.usable for x in libllvm.find_libraries({})):
            assert libllvm.library_version(path)[0] >= libllvm.MINIMUM_LLVM
    assert best < 0.3


def test_backend_computes():
    """The active backend runs the minimum that aborts the process on LLVM 15 and 16."""
    import drjit as dr

    active = runtime.backend()
    assert active.variant == os.environ["DRGS_VARIANT"]
    assert runtime.dr_types() is active.types
    assert active.name == "cuda" or active.llvm_version[0] >= libllvm.MINIMUM_LLVM
    assert float(dr.minimum(active.types.Float(1), active.types.Float(-2))[0]) == -2.0


def test_tiles_need_no_mitsuba():
    """`backend()` gives array types and thread counts without importing Mitsuba."""
    done = _python(
        "from drgs import runtime; import sys; b = runtime.setup('llvm_ad_rgb', threads=1)\n"
        "import torch; print(b.threads, torch.get_num_threads(), 'mitsuba' in sys.modules)"
    )
    assert done.stdout.split() == ["1", "1", "False"], done.stderr


def test_the_engine_chooses_the_backend():
    """Any module that computes may be imported first, on the libLLVM that was found, without Mitsuba."""
    done = _python(
        "import drgs.tracing.walk, sys, os; from drgs import runtime\n"
        "found = os.path.realpath(os.environ['DRJIT_LIBLLVM_PATH'])\n"
        "print(runtime._active.llvm_path == found, 'mitsuba' in sys.modules)",
        DRGS_VARIANT="llvm_ad_rgb",
    )
    assert done.stdout.split() == ["True", "False"], done.stderr


def test_mitsuba_variant_is_set_only_if_none_is():
    """A fresh Mitsuba gets our variant; one that the user has set stays; scalar is refused."""
    done = _python(
        "from drgs import runtime\nmi = runtime.mitsuba(); print(mi.variant())\n"
        "mi.set_variant('scalar_rgb')\ntry: runtime.mitsuba()\n"
        "except ValueError as e: print(e)\nprint(mi.variant())",
        DRGS_VARIANT="llvm_ad_rgb",
    )
    first, error, last = done.stdout.splitlines()
    assert (first, last) == ("llvm_ad_rgb", "scalar_rgb")
    assert error.startswith("drgs: Mitsuba's variant must be one of llvm_ad_rgb, cuda_ad_rgb, got")


def test_users_variant_beats_environment():
    """A variant set in code before the first use decides, not DRGS_VARIANT."""
    done = _python(
        "import drgs, mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        "print(drgs.runtime.backend().variant, drgs.runtime.mitsuba().variant())",
        DRGS_VARIANT="cuda_ad_rgb",
    )
    assert done.stdout.split() == ["llvm_ad_rgb", "llvm_ad_rgb"], done.stderr


@pytest.mark.every(3)
@pytest.mark.parametrize("old", [14, 15, 16])
def test_drjit_imported_first_with_an_old_library(old):
    """The user's own import loaded a library that would abort: refused before any kernel runs."""
    path = next((x.path for x in libllvm.find_libraries({}) if x.version[:1] == (old,)), None)
    if path is None:
        pytest.skip(f"no libLLVM {old} on this machine")
    done = _python(
        "import drjit, drgs\ntry: drgs.runtime.backend()\nexcept ValueError as e: print(e)",
        DRJIT_LIBLLVM_PATH=path,
        DRGS_VARIANT="llvm_ad_rgb",
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("drgs: ")
    assert "must" in done.stdout
    assert f" {old}" in done.stdout
    assert done.stdout.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("DRGS_VARIANT", "gpu", "DRGS_VARIANT must be one of auto, llvm_ad_rgb, cuda_ad_rgb, got"),
        ("DRGS_THREADS", "many", "DRGS_THREADS must be a whole number in [1, 4096], got 'many'"),
        ("DRGS_THREADS", "0", "DRGS_THREADS must be a whole number in [1, 4096], got '0'"),
    ],
)
def test_bad_environment(monkeypatch, name, value, message):
    """Environment variables are checked before anything is loaded."""
    monkeypatch.setenv(name, value)
    monkeypatch.delitem(sys.modules, "mitsuba", raising=False)
    with pytest.raises(ValueError, match="^drgs: ") as error:
        runtime.setup()
    assert message in str(error.value)


def test_no_card_is_said(monkeypatch):
    """Asking for CUDA without a card says why it cannot be had."""
    usable, reason = runtime.cuda_status()
    if usable:
        pytest.skip("this machine has a CUDA device")
    with pytest.raises(ValueError, match="variant cuda_ad_rgb must have a CUDA device, but") as e:
        runtime.setup("cuda_ad_rgb")
    assert reason in str(e.value)
    assert runtime.optix_status() == (False, reason)


@pytest.mark.cuda
def test_cuda_backend():
    """On a machine with a card the CUDA namespace computes (in a process of its own)."""
    done = _python(
        "from drgs import runtime; t = runtime.setup('cuda_ad_rgb').types\n"
        "print((t.Float(1) + 1)[0], runtime.info()['cuda']['device'])"
    )
    assert done.stdout.startswith("2.0 "), done.stderr


def test_a_missing_system_library_is_named(tmp_path):
    """Where Dr.Jit's extension cannot be loaded, a command says in one line which library to install."""
    package = tmp_path / "drjit"
    package.mkdir()
    (package / "__init__.py").write_text("""
try:
    raise ImportError("libatomic.so.1: cannot open shared object file")
except ImportError:
    undefined
""")
    environ = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = subprocess.run([sys.executable, "-m", "drgs", "info"], env=environ, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("drgs info: Dr.Jit must find the libraries that it needs, got: libatomic.so.1")
    assert "Traceback" not in done.stderr


def test_info_is_json():
    """`info()` survives a JSON round trip and names backend, library, threads and packages."""
    report = json.loads(json.dumps(runtime.info()))
    assert report["backend"] == {"variant": runtime.backend().variant, "error": None}
    assert report["packages"]["drjit"]
    assert report["cuda"]["available"] or report["cuda"]["reason"]
    if runtime.backend().name == "llvm":
        assert Path(report["llvm"]["path"]).exists()
        assert int(report["llvm"]["version"].split(".")[0]) >= libllvm.MINIMUM_LLVM


def test_commit_is_dirty_by_code_alone(tmp_path, monkeypatch):
    """Rows that a study appends leave the commit as it is; a change of code shows."""
    for name in ("drgs/runtime/machine.py", "rows.jsonl"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"]):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setattr(machine, "__file__", str(tmp_path / "drgs/runtime/machine.py"))
    clean = machine.commit()
    (tmp_path / "rows.jsonl").write_text("{}")
    assert clean == machine.commit()
    (tmp_path / "drgs/runtime/machine.py").write_text("x = 1")
    assert machine.commit() == f"{clean}-dirty"
    assert re.fullmatch("[0-9a-f]{7,}", clean)


RENDER = """
import torch, drgs
from drgs.cameras import orbit
zeros, ones = torch.zeros(1, 3), torch.ones(1, 3)
g = drgs.Gaussians.from_arrays(zeros, torch.eye(4)[:1], ones, ones[:, 0] / 2, zeros[:, None])
print(drgs.render(g, orbit((0, 0, 0), 3.0, 1, width=8, height=8)[0]).rgb.isfinite().all().item())
"""


@pytest.mark.every(4)
@pytest.mark.skipif(platform.machine() != "x86_64", reason="about instructions of x86-64")
@pytest.mark.parametrize("target", ["nehalem/4", "x86-64-v2/8", "nehalem/4/+sse4.2,-avx,-fma", "haswell/8/-fma"])
def test_a_processor_without_fma_is_refused(target):
    """Dr.Jit would print the code of the first kernel, two thousand lines, and abort."""
    done = _python(RENDER, DRGS_LLVM_TARGET=target, DRGS_VARIANT="llvm_ad_rgb")
    assert done.returncode == 1, done.stderr[-500:]
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("ValueError: drgs: the processor must have FMA, ")
    assert f"got {target.split('/')[0]} without; use another machine" in last


@pytest.mark.skipif(platform.machine() != "x86_64", reason="about instructions of x86-64")
def test_compiled_for_another_processor():
    """Fewer lanes and older instructions render, too; `info` says what kernels are compiled for."""
    code = RENDER + "from drgs import runtime\nprint(runtime.info()['llvm']['target'])"
    done = _python(code, DRGS_LLVM_TARGET="x86-64-v2/4/+fma", DRGS_VARIANT="llvm_ad_rgb")
    assert done.stdout.splitlines() == ["True", "{'cpu': 'x86-64-v2', 'lanes': 4}"], done.stderr[-500:]


def test_drjit_has_no_public_target_yet():
    """Fails when Dr.Jit's module tells or chooses the target: then `llvm_target` needs no mangled names any more."""
    import drjit as dr

    names = [name.lower() for name in (*dir(dr), *dir(dr.detail))]
    assert [name for name in names if "target" in name or "vector_width" in name] == []


@pytest.mark.skipif(platform.machine() != "x86_64", reason="about instructions of x86-64")
def test_a_processor_newer_than_this_one_is_refused(monkeypatch):
    """Its instructions would end the process; a target is chosen of what the machine has, however often."""
    runtime.backend()
    old = llvm_target.Target("haswell", 8, ("+avx2", "+fma"))
    monkeypatch.setattr(llvm_target, "_of_machine", lambda: old)
    with pytest.raises(ValueError, match=r"DRGS_LLVM_TARGET must be of instructions that haswell has, got .*avx512vl"):
        llvm_target.compile_for("x86-64-v4/16", "drgs: DRGS_LLVM_TARGET")
    code = RENDER + "drgs.runtime.setup(threads=1)\ndrgs.runtime.setup(threads=2)\n" + RENDER
    done = _python(code, DRGS_LLVM_TARGET="haswell/8", DRGS_VARIANT="llvm_ad_rgb")
    assert done.stdout.split() == ["True", "True"], done.stderr[-500:]


@pytest.mark.parametrize(
    "text", ["haswell", "haswell/3", "haswell/8/fma", "/8", "haswell/eight", "haswel/8", "generic/8"]
)
@pytest.mark.skipif(platform.machine() != "x86_64", reason="about instructions of x86-64")
def test_targets_are_written_in_one_way(text):
    runtime.backend()
    with pytest.raises(ValueError, match=r"DRGS_LLVM_TARGET must be CPU/LANES or CPU/LANES/FEATURES .* got") as refused:
        llvm_target.compile_for(text, "drgs: DRGS_LLVM_TARGET")
    assert repr(text) in str(refused.value)
