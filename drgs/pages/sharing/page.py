"""The page: a template that is filled with the scene, the viewer's code and ours; it loads nothing from outside."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drgs.pages.sharing.npm import PACKAGES

SHARED_BY = "drgs share"
"""What the page says of itself: a file that does is one that may be replaced."""

_HERE = Path(__file__).parent
_OURS = {
    "drgs": "page.js",
    "drgs/cameras": "cameras.js",
    "drgs/gaussians": "gaussians.js",
    "drgs/panel": "panel.js",
}


def scene_html(
    title: str, lines: Sequence[str], scene: Mapping[str, Any], parts: Mapping[str, bytes], viewer: Path
) -> tuple[str, dict[str, int]]:
    """The page, and bytes of its parts: those of `parts` by their names, and `viewer`.

    Args:
        title: Name of the scene.
        lines: Sentences about it.
        scene: What `page.js` reads, JSON.
        parts: Name -> bytes of the larger things: `gaussians`, an archive of SOG, and what layers are made of.
        viewer: Folder with the packages of npm (`npm.viewer_files`).
    """
    from jinja2 import Environment
    from markupsafe import Markup

    red, green, blue = (round(255 * min(max(x, 0.0), 1.0)) for x in scene["background"])
    packed = {name: _packed(data) for name, data in parts.items()}
    modules = _modules(viewer)
    context = {
        "generator": SHARED_BY,
        "title": title,
        "lines": lines,
        "background": f"rgb({red}, {green}, {blue})",
        # In a script, text is what it is but for the end of the script; JSON may hold any letter by its number.
        "scene": Markup(json.dumps(scene).replace("<", "\\u003c")),
        "parts": {name: Markup(text) for name, text in packed.items()},
        "notices": [_notice(viewer / package.folder / package.license) for package in PACKAGES],
        "modules": {name: Markup(code) for name, code in modules.items()},
        "loader": Markup((_HERE / "loader.js").read_text()),
    }
    environment = Environment(autoescape=True, trim_blocks=True)
    page = environment.from_string((_HERE / "page.html").read_text()).render(**context) + "\n"
    sizes = {name: len(text) for name, text in packed.items()}
    return page, sizes | {"viewer": sum(map(len, modules.values()))}


def _notice(path: Path) -> str:
    return f"{path.parent.name}\n\n{path.read_text()}"


def _modules(viewer: Path) -> dict[str, str]:
    """Name that is imported -> code, packed by gzip, in base64."""
    code = {
        name: (viewer / package.folder / file).read_text()
        for package in PACKAGES
        for name, file in package.modules.items()
    }
    # No address is relative to a module that is in memory.
    code["three"] = code["three"].replace("'./three.core.js'", "'three/core'")
    code |= {name: (_HERE / file).read_text() for name, file in _OURS.items()}
    return {name: _packed(text.encode()) for name, text in code.items()}


def _packed(data: bytes) -> str:
    """By gzip, in base64; without a time: the same scene, the same page."""
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode()
