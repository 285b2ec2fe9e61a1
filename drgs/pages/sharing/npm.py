"""The viewer's code: packages of npm, pinned by version and hash, of which a wheel of drgs carries what a page needs.

A checkout has none of it: it is fetched at first use and kept in the user's cache. Imports nothing of drgs and nothing
heavy, since building the wheel runs it as well.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import logging
import os
import tarfile
import tempfile
import urllib.error
import urllib.request
from pathlib import Path

PACKAGED = Path(__file__).parent / "npm"
"""Where a wheel has the files of the packages, in a folder for each."""

_log = logging.getLogger("drgs.pages.sharing.npm")  # by this name where it is loaded by itself, too
_TIMEOUT = 60.0  # seconds without an answer from the registry; chosen
_MOST_BYTES = 64 << 20  # bytes of an archive, many times what the packages have: more is not one of them


@dataclasses.dataclass(frozen=True)
class Package:
    """A package of npm.

    Attributes:
        name: Name at npm.
        version: The only one that is taken.
        sha512: Hash of its archive, in base64, as npm states it.
        modules: What a page imports -> file in the package.
        license: File in the package with the text of its license.
    """

    name: str
    version: str
    sha512: str
    modules: dict[str, str]
    license: str = "LICENSE"

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return f"{self.name.rpartition('/')[2]}-{self.version}"

    @property
    def files(self) -> tuple[str, ...]:
        """The files of the package that are kept."""
        return (*dict.fromkeys(self.modules.values()), self.license)

    @property
    def address(self) -> str:
        """Where its archive is."""
        return f"https://registry.npmjs.org/{self.name}/-/{self.folder}.tgz"


PACKAGES = (
    Package(
        "three",
        "0.187.0",
        "Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA==",
        {
            "three/core": "build/three.core.js",
            "three": "build/three.module.js",
            "three/addons/controls/OrbitControls.js": "examples/jsm/controls/OrbitControls.js",
            "three/addons/postprocessing/Pass.js": "examples/jsm/postprocessing/Pass.js",
        },
    ),
    Package(
        "@sparkjsdev/spark",
        "2.2.0",
        "wf5F2YAmPXnjm20/MgXYer9FQTXz2JOCo05HwxFkaD7Guk9rHVPIwdJ6fq0oF9ME0heMvYj+TxS6DTrucvy6KA==",
        {"@sparkjsdev/spark": "dist/spark.module.min.js"},
    ),
)
"""The packages that draw a page, both under the MIT license."""


def viewer_files(cache: Path | None = None) -> Path:
    """The folder with the files of all packages: the wheel's own, else the cache, which is filled if it must be.

    Args:
        cache: Folder to fetch into; default `drgs/npm` in the user's cache.
    Raises:
        OSError: If they are nowhere and cannot be fetched, or not be written.
        ValueError: If what was fetched is not what is pinned.
    """
    for folder in (PACKAGED, cache or _user_cache()):
        if all((folder / package.folder / name).is_file() for package in PACKAGES for name in package.files):
            return folder
    fetch_into(folder)
    return folder


def fetch_into(folder: Path) -> None:
    """Fetch missing packages, each whole or not at all.

    Args:
        folder: Folder that gets a folder for each package; it is made.
    Raises:
        OSError: If the network or the disk refuses.
        ValueError: If an archive is not the one that is pinned.
    """
    for package in PACKAGES:
        target = folder / package.folder
        if all((target / name).is_file() for name in package.files):
            continue
        content = _checked(package, _downloaded(package))
        for name, data in content.items():
            _write(target / name, data)


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "drgs" / "npm"


def _downloaded(package: Package) -> bytes:
    """Download the archive of a package."""
    _log.info("fetching %s, once, for the pages of drgs share", package.address)
    try:
        with urllib.request.urlopen(package.address, timeout=_TIMEOUT) as answer:
            return answer.read(_MOST_BYTES)
    except (urllib.error.URLError, TimeoutError) as error:
        reason = getattr(error, "reason", error)
        raise OSError(
            f"share: the viewer's code must be fetched once from {package.address}, got: {reason}; connect to the "
            "network, or install drgs from a wheel, which has it"
        ) from None


def _checked(package: Package, archive: bytes) -> dict[str, bytes]:
    """Name -> content of the files that are kept of an archive."""
    digest = base64.b64encode(hashlib.sha512(archive).digest()).decode()
    if digest != package.sha512:
        raise ValueError(
            f"share: {package.address} must have the SHA-512 {package.sha512[:12]}..., has {digest[:12]}...; it was "
            "changed on the way, fetch it from another network"
        )
    content = {}
    with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as files:
        for name in package.files:
            member = files.extractfile(f"package/{name}")
            assert member is not None, name  # the archive is the one that is pinned
            content[name] = member.read()
    return content


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically, also where two processes write it at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".drgs.", delete=False) as file:
        file.write(data)
    os.chmod(file.name, 0o644)
    os.replace(file.name, path)
