"""Find a libLLVM that Dr.Jit can use, from file names alone and before `drjit` is imported.

Dr.Jit loads libLLVM while `drjit` is imported and takes whatever it finds. Version 14 leaves the
backend inactive; 15 and 16 load and then abort the whole process at the first `dr.minimum`. So the
choice is made before that import, without loading anything: a few directory listings, a few ms.
"""

from __future__ import annotations

import dataclasses
import os
import re
import struct
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

MINIMUM_LLVM = 17
"""Major version: Dr.Jit 1.5 aborts with 15 and 16, and does not load older ones."""

_INSTALL = (
    "Install it (Debian/Ubuntu: apt-get install libllvm19; conda: conda install -c conda-forge "
    "libllvm19; macOS: brew install llvm) or set DRJIT_LIBLLVM_PATH."
)
# libLLVM-14.so.1, libLLVM-14.0.6.so.1, libLLVM-19.so, libLLVM.so.19.1, libLLVM.19.1.dylib and
# libLLVM.so, but neither libLLVMSupport.a nor a Rust compiler's libLLVM.so.20.1-rust-1.88-stable.
_NAME = re.compile(
    r"libLLVM(?:-(?P<dash>\d+(?:\.\d+)*))?(?:\.(?P<mac>\d+(?:\.\d+)*))?"
    r"\.(?:so(?:\.(?P<so>\d+(?:\.\d+)*))?|dylib)"
)
_ELF_LIMIT = 1 << 20  # bytes of any ELF table that are read: a damaged header may claim 2**64
# Debian's name of this machine, such as x86_64-linux-gnu.
_MULTIARCH = getattr(sys.implementation, "_multiarch", "x86_64-linux-gnu")
# Directories that carry the version when the file does not: llvm-19, llvm19, llvm@19, llvm/19.1.7.
_DIRECTORY = re.compile(r"llvm(?:[-@]?|/)(?P<v>\d+(?:\.\d+)*)(?:/|$)")


@dataclasses.dataclass(frozen=True)
class Library:
    """One libLLVM on disk. `version` is () when neither name, soname nor directory states it."""

    path: str
    version: tuple[int, ...]
    source: str  # environment | system | conda | homebrew

    @property
    def usable(self) -> bool:
        """At least `MINIMUM_LLVM`, or unknown: that is checked again once Dr.Jit has loaded it."""
        return not self.version or self.version[0] >= MINIMUM_LLVM


def library_version(path: str | os.PathLike) -> tuple[int, ...]:
    """Version of a libLLVM file, without loading it: name, link target, directory, ELF soname.

    Returns:
        (major, minor, ...), or () when nothing tells.
    """
    target = os.path.realpath(path)
    for candidate in (os.fspath(path), target):
        match = _NAME.fullmatch(os.path.basename(candidate))
        if match:
            # In libLLVM-14.so.1 the number behind .so is the soname's revision, not LLVM's.
            text = match["dash"] or match["mac"] or match["so"]
            if text:
                return _numbers(text)
    in_directory = list(_DIRECTORY.finditer(os.path.dirname(target).lower()))
    if in_directory:
        return _numbers(in_directory[-1]["v"])
    match = _NAME.fullmatch(_elf_soname(target) or "")
    return _numbers(match["dash"] or match["so"] or "") if match else ()


def find_libraries(
    environ: Mapping[str, str] | None = None,
    root: str | os.PathLike = "/",
    prefix: str | None = None,
) -> list[Library]:
    """Every libLLVM in the usual places, best first.

    A library named by DRJIT_LIBLLVM_PATH is the only candidate, as it is for Dr.Jit. Otherwise the
    newest version comes first; among equals, system directories, then conda, then Homebrew.

    Args:
        environ: Environment, default `os.environ`.
        root: Root of the file system (tests pass a fake one).
        prefix: Python's prefix, default `sys.prefix`: in a conda environment it holds a libLLVM.
    """
    environ = os.environ if environ is None else environ
    named = environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        return [Library(named, library_version(named), "environment")]

    by_file: dict[str, Library] = {}  # by real path: distributions link one file under many names
    for source, directory in _directories(Path(root), environ, prefix or sys.prefix):
        try:
            names = sorted(n for n in os.listdir(directory) if n.startswith("libLLVM"))
        except OSError:
            continue
        for name in names:
            path = os.path.join(directory, name)
            real = os.path.realpath(path)
            # A dangling link is no library; neither is a 32-bit one beside /usr/lib64.
            if not _NAME.fullmatch(name) or not os.path.exists(real) or _foreign_elf(real):
                continue
            version = library_version(path)
            if real not in by_file or len(version) > len(by_file[real].version):
                first = by_file[real].source if real in by_file else source
                by_file[real] = Library(path, version, first)
    # sorted() is stable, so the order of _directories decides between equal versions.
    return sorted(by_file.values(), key=lambda lib: lib.version[:2], reverse=True)


def require_llvm(libraries: list[Library] | None = None) -> Library:
    """The libLLVM that Dr.Jit shall load.

    Raises:
        FileNotFoundError: If there is none, or DRJIT_LIBLLVM_PATH names a missing file.
        ValueError: If DRJIT_LIBLLVM_PATH names a version below `MINIMUM_LLVM`.
    """
    libraries = find_libraries() if libraries is None else libraries
    for lib in libraries:
        if lib.source == "environment":
            # A bare name ("libLLVM.so.19.1") is resolved by the dynamic loader, not by us.
            if "/" in lib.path and not os.path.exists(lib.path):
                raise FileNotFoundError(
                    f"drgs: DRJIT_LIBLLVM_PATH must name a libLLVM >= {MINIMUM_LLVM}, got "
                    f"{lib.path}, which does not exist; correct it or unset it."
                )
            if not lib.usable:
                raise ValueError(
                    f"drgs: DRJIT_LIBLLVM_PATH must name a libLLVM >= {MINIMUM_LLVM}, got "
                    f"{dotted(lib.version)} ({lib.path}); correct it or unset it."
                )
        if lib.usable:
            return lib
    versions = sorted({lib.version for lib in libraries})
    got = ", ".join(map(dotted, versions)) if versions else "none"
    raise FileNotFoundError(
        f"drgs: no usable Dr.Jit backend: libLLVM >= {MINIMUM_LLVM} is needed, found {got}. {_INSTALL}"
    )


def prepare() -> None:
    """Point DRJIT_LIBLLVM_PATH at a usable libLLVM, unless set or too late; never raises.

    Done by `import drgs`, so that a later `import mitsuba` by the user loads a version that works.
    """
    if os.environ.get("DRJIT_LIBLLVM_PATH") or "drjit" in sys.modules:
        return
    best = next((lib for lib in find_libraries() if lib.usable), None)
    if best is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = best.path


def _directories(root: Path, environ: Mapping[str, str], prefix: str) -> Iterator[tuple[str, Path]]:
    """(source, directory) pairs in the order in which equal versions are preferred."""
    loader = [Path(p) for p in environ.get("LD_LIBRARY_PATH", "").split(":") if p.startswith("/")]
    patterns = {
        "system": (
            f"usr/lib/{_MULTIARCH}",  # Debian, Ubuntu
            "usr/lib/llvm-*/lib",
            "usr/lib64",  # Fedora, openSUSE
            "usr/lib64/llvm*/lib",
            "usr/lib",  # Arch, Alpine
            "usr/lib/llvm*/lib",
            "usr/lib/wsl/lib",
            "usr/local/lib",
            "usr/local/lib64",
        ),
        "conda": (),
        "homebrew": (
            "opt/homebrew/opt/llvm*/lib",
            "usr/local/opt/llvm*/lib",
            "home/linuxbrew/.linuxbrew/opt/llvm*/lib",
        ),
    }
    for directory in loader:  # environment modules on clusters
        yield "system", directory
    for source, globs in patterns.items():
        if source == "conda":
            for base in (environ.get("CONDA_PREFIX"), prefix):
                if base:
                    yield "conda", Path(base) / "lib"
        for pattern in globs:
            for directory in sorted(root.glob(pattern)) if "*" in pattern else [root / pattern]:
                yield source, directory


def _foreign_elf(path: str) -> bool:
    """Whether a file is an ELF library of another word size than this interpreter's."""
    try:
        with open(path, "rb") as f:
            head = f.read(5)
    except OSError:
        return True
    return head[:4] == b"\x7fELF" and head[4:5] != (b"\x02" if sys.maxsize > 2**32 else b"\x01")


def _elf_soname(path: str) -> str | None:
    """DT_SONAME of a 64-bit little-endian ELF file, or None."""
    try:
        with open(path, "rb") as f:
            head = f.read(64)
            if head[:6] != b"\x7fELF\x02\x01":
                return None
            (table,) = struct.unpack_from("<Q", head, 32)
            size, count = struct.unpack_from("<HH", head, 54)
            f.seek(table)
            raw = f.read(min(size * count, _ELF_LIMIT))
            segments = [struct.unpack_from("<IIQQQQ", raw, i * size) for i in range(count)]
            _, _, offset, _, _, length = next(s for s in segments if s[0] == 2)  # PT_DYNAMIC
            f.seek(offset)
            entries = dict(struct.iter_unpack("<QQ", f.read(min(length, _ELF_LIMIT) // 16 * 16)))
            address = entries[5]  # DT_STRTAB, a virtual address: find the segment that maps it
            start = next(s[2] + address - s[3] for s in segments if s[0] == 1 and 0 <= address - s[3] < s[5])
            f.seek(start + entries[14])  # DT_SONAME
            return f.read(256).split(b"\0", 1)[0].decode()
    except (OSError, ValueError, OverflowError, KeyError, StopIteration, struct.error):
        return None


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(".") if part)


def dotted(version: tuple[int, ...]) -> str:
    """(19, 1, 7) as "19.1.7"; () as "unknown"."""
    return ".".join(map(str, version)) or "unknown"
