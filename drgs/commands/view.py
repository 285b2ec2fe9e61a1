"""`drgs view`: a scene in the browser, and a run while it is being fitted."""

from __future__ import annotations

import importlib.util
import threading
import warnings
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drgs.commands.orbits import Wish
from drgs.commands.scene_input import SceneInput
from drgs.commands.viewed import subject_of, watched_files
from drgs.display.progress import Bar, quietly
from drgs.io import interrupts

if TYPE_CHECKING:
    from drgs.commands.options import View
    from drgs.viewing.server import Viewer

__all__ = ["run"]

_EVERY = 2.0  # seconds between two looks at the files
_LAST = 0.5  # seconds that what is being computed is given to end


def run(args: View) -> None:
    """`drgs view SCENE`; returns by Ctrl-C alone."""
    if importlib.util.find_spec("viser") is None:
        raise ValueError("view: viser must be installed, is not; pip install 'drgs[view]'")
    args.settings()  # refuses what cannot be, before anything is read
    Wish.of(args)
    from drgs.viewing.server import Viewer

    # A browser may be closed while something is on its way to it: that is no news.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    with Bar("the scene", show=not args.quiet):
        stamps = _stamps(watched_files(args))
        subject = subject_of(args, SceneInput.of(args))
    viewer = Viewer(subject, args.host, args.port, args.token, args.preset, args.max_pixels)
    try:
        print(f"{viewer.address}  (Ctrl-C ends)", flush=True)
        if args.open:
            webbrowser.open(viewer.address)
        with quietly():
            _watch(args, viewer, stamps)
    finally:
        if not viewer.worker.close(_LAST):
            interrupts.leave()
        viewer.stop()


def _watch(args: View, viewer: Viewer, stamps: dict[Path, tuple[int, int, int]]) -> None:
    """Look at the files now and then, and read them again when one has changed."""
    never = threading.Event()
    while not never.wait(_EVERY):
        found = _stamps(watched_files(args))
        if found != stamps and not viewer.worker.has("files"):
            stamps = found
            viewer.worker.put("files", _reading(args, viewer))


def _reading(args: View, viewer: Viewer) -> Iterator[None]:
    """Job: what the files hold now, in all browsers."""
    viewer.replace(subject_of(args, SceneInput.of(args), viewer.subject))
    yield


def _stamps(paths: list[Path]) -> dict[Path, tuple[int, int, int]]:
    """What changes of a file when another one takes its place; those that are not there are left out."""
    found = {}
    for path in paths:
        try:
            seen = path.stat()
        except OSError:
            continue
        found[path] = seen.st_mtime_ns, seen.st_size, seen.st_ino
    return found
