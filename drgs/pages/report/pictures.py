"""Pictures of a page: files of the run folder, and renderings of its last checkpoint."""

from __future__ import annotations

import base64
import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.display import pictures
from drgs.display.progress import Bar
from drgs.ellipsoids import Scene, colors_only
from drgs.information.expected_error import ErrorRecord, expected_error
from drgs.information.quantity import opacity_of
from drgs.integrator import render

if TYPE_CHECKING:
    from drgs.cameras import Camera
    from drgs.pages.report.account import Account
    from drgs.settings import RenderSettings

_QUALITY = 88  # of JPEG; a page of thirty pictures then has about two megabytes
_WIDEST = 1200  # pixels of width, at most; no page is wider
_MOST_PREVIEWS = 12  # pictures of how the fit went, evenly spaced: a slider of more is no smoother
_MAP_WIDTH = 480  # pixels of width of a map of information, about: it takes seconds; chosen
_MOST_BYTES = 1 << 28  # bytes of a PNG of a run folder, at most: no rendering has more
_MOST_STILLS = 12  # times at which one camera of a sequence is shown, evenly spaced; chosen


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture and its caption.

    Attributes:
        data: base64 of a JPEG.
        text: The caption.
        width, height: Pixels.
    """

    data: str
    text: str
    width: int
    height: int


def jpeg(image: np.ndarray, text: str, widest: int = _WIDEST) -> Picture:
    """An (H, W, 3) picture, uint8 or in [0, 1], at most so many pixels wide; small ones keep sharp pixels."""
    import cv2

    pixels = image if image.dtype == np.uint8 else pictures.to_bytes(image)
    height, width = pixels.shape[:2]
    pixels = pictures.shrunk(pixels, round(widest * max(1.0, height / width)))
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return Picture(base64.b64encode(data.tobytes()).decode(), text, pixels.shape[1], pixels.shape[0])


def spread(items: Sequence, count: int) -> list:
    """At most `count` items, evenly spaced, with the first and the last."""
    if len(items) <= count:
        return list(items)
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, count)]


def previews(account: Account) -> list[Picture]:
    """Previews of the fit: photograph and rendering, side by side."""
    found = []
    for path in account.run.renders.glob("preview_*.png"):
        if (number := re.fullmatch(r"preview_(\d+)", path.stem)) and int(number[1]) <= account.step:
            found.append((int(number[1]), path))
    shown = [(step, _read(path)) for step, path in spread(sorted(found), _MOST_PREVIEWS)]
    return [jpeg(image, f"step {step:,}", 800) for step, image in shown if image is not None]


def view_pictures(account: Account, names: Sequence[str], kind: str) -> dict[str, Picture]:
    """View -> its picture of the last measurement: `png` or `semantics.png`."""
    if account.metrics is None:
        return {}
    every = [row["name"] for row in account.metrics["views"]]
    files = dict(zip(every, pictures.file_names(every), strict=True))
    found = {}
    for name in names:
        image = _read(account.run.renders / account.metrics["split"] / f"{files[name]}.{kind}")
        if image is not None:
            found[name] = jpeg(image, name)
    return found


def _read(path: Path) -> np.ndarray | None:
    """An 8-bit picture; None where there is none that can be read."""
    import cv2

    if not path.is_file() or path.stat().st_size > _MOST_BYTES:
        return None
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def maps(scene: Scene, shown: Mapping[str, Camera], record: ErrorRecord) -> dict[str, tuple[Picture, Picture]]:
    """View -> pictures of the error that is expected of each pixel, and of how much no Gaussian covers (1 - alpha)."""
    found = {}
    with Bar("maps of the expected error", len(shown)) as bar:
        for name, camera in shown.items():
            error = expected_error(scene, camera, record).sqrt().numpy()
            bare = 1 - np.clip(opacity_of(scene, camera, record.settings).numpy(), 0, 1)
            found[name] = (
                jpeg(pictures.map_picture(_enlarged(error)), "expected error"),
                jpeg(_enlarged(np.repeat(bare[..., None], 3, 2)), "not covered: 1 - alpha"),
            )
            bar.advance()
    return found


def _enlarged(values: np.ndarray) -> np.ndarray:
    """Each pixel as a square, so that a small map is not dwarfed by its color bar."""
    times = max(1, round(_MAP_WIDTH / values.shape[1]))
    return values.repeat(times, 0).repeat(times, 1)


def stills(scene: Scene, camera: Camera, times: Sequence[float], settings: RenderSettings) -> list[Picture]:
    """One camera at several times, evenly over all, as accurate as 8 bits can show."""
    found, settings = [], settings.for_pictures()
    with Bar("stills of the sequence", min(len(times), _MOST_STILLS)) as bar:
        for time in spread(times, _MOST_STILLS):
            now = dataclasses.replace(camera, time=time)
            with torch.no_grad():  # a picture
                image = render(colors_only(scene, time), now, settings, outputs=()).rgb.cpu().numpy()
            found.append(jpeg(image, f"time {time:.3g}", 640))
            bar.advance()
    return found
