"""The viewer's code: packages of npm, pinned by version and hash.

It is 5 MB that only pages need, and no part of drgs: it is fetched at first use and kept in the user's cache.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import http.client
import io
import logging
import os
import tarfile
import tempfile
import urllib.error
import urllib.request
from pathlib import Path

_log = logging.getLogger(__name__)
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


def viewer_files() -> Path:
    """The folder with the files of all packages; what it lacks is fetched.

    Raises:
        OSError: If they are not there and cannot be fetched, as they are pinned, or not be written.
    """
    folder = cache_folder()
    fetch_into(folder)
    return folder


def fetch_into(folder: Path) -> None:
    """Fetch missing packages, each whole or not at all.

    Args:
        folder: Folder that gets a folder for each package; it is made.
    Raises:
        OSError: If the network or the disk refuses, or an archive is not the one that is pinned.
    """
    for package in PACKAGES:
        target = folder / package.folder
        if all((target / name).is_file() for name in package.files):
            continue
        content = _checked(package, _downloaded(package))
        for name, data in content.items():
            _write(target / name, data)


def cache_folder() -> Path:
    """`drgs/npm` in the user's cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "drgs" / "npm"


def _downloaded(package: Package) -> bytes:
    """Download the archive of a package."""
    _log.info("fetching %s, once, for the pages of drgs share", package.address)
    try:
        with urllib.request.urlopen(package.address, timeout=_TIMEOUT) as answer:
            return answer.read(_MOST_BYTES)
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as error:
        reason = getattr(error, "reason", error)
        raise OSError(
            f"share: the viewer's code must be fetched once from {package.address}, got: {reason}; connect to the "
            f"network, or copy {cache_folder()} from a machine that has it"
        ) from None


def _checked(package: Package, archive: bytes) -> dict[str, bytes]:
    """Name -> content of the files that are kept of an archive."""
    digest = base64.b64encode(hashlib.sha512(archive).digest()).decode()
    if digest != package.sha512:
        # The network's fault, be it a download that was cut off: callers go on as if there were none.
        raise OSError(
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
