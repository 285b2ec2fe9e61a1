"""How the page of `drgs share` agrees with our `gsplat`, at cameras of photographs, and how large it is.

    python benchmarks/share.py runs/scene [runs/other ...] [--views 3] [--pixels 250000]
    python benchmarks/share.py --page

Appends one row a run and view to benchmarks/share.jsonl, leaves out what is there, then writes the paragraph of
docs/share.md and docs/data/share.csv. Three numbers a view, in dB: `page` is a screenshot in headless Chromium
beside `gsplat` of the run's own Gaussians; it is made of `archive`, what SOG loses (our `gsplat` of what the page holds
beside that of the run's), and `rules`, how Spark draws (the screenshot beside our `gsplat` of what the page holds).
Needs playwright and Chromium.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from pages import fill_between  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

from drgs.cameras import Camera  # noqa: E402
from drgs.cameras.sizes import reduced_size  # noqa: E402
from drgs.codecs import load_gaussians  # noqa: E402
from drgs.codecs.sog import encode_sog  # noqa: E402
from drgs.commands.options import Share  # noqa: E402
from drgs.commands.share import shared_of  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.integrator import render  # noqa: E402
from drgs.pages.sharing.write import write_page  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.tables import paragraph  # noqa: E402

ROWS = ROOT / "benchmarks" / "share.jsonl"
PAGE = ROOT / "docs" / "share.md"
_FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
_PATIENCE = 300_000  # ms
_KINDS = ("page", "archive", "rules")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--page", action="store_true", help="measure nothing, write what is there")
    parser.add_argument("--views", type=int, default=3, help="views of each, evenly over its photographs")
    parser.add_argument("--pixels", type=int, default=250_000, help="of a picture, at most")
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--pictures", type=Path, default=None, help="folder for pictures: run, page, ten times apart")
    args = parser.parse_args()
    if args.runs and not args.page:
        from playwright import sync_api

        with sync_api.sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
            browser = driver.chromium.launch(executable_path=args.chromium, args=_FLAGS)
            for run in args.runs:
                _measure(browser, run, Path(folder), args)
    lines = sheet(read_rows(ROWS))
    text = summary(lines)
    print(text)
    fill_between(PAGE, "share", text)
    write_csv(PAGE_DATA / "share.csv", lines)


def sheet(rows: list[dict]) -> list[list[str]]:
    """The data file: a line a run, with the least and the largest PSNR of its views."""
    ends = [f"{kind}_{end}_db" for kind in _KINDS for end in ("least", "most")]
    lines = [["run", "gaussians", "bytes_a_gaussian", "page_mb", *ends]]
    for run in dict.fromkeys(row["run"] for row in rows):
        mine = [row for row in rows if row["run"] == run]
        first = mine[0]
        size = [f"{first['archive_bytes'] / first['gaussians']:.1f}", f"{first['page_bytes'] / 1e6:.1f}"]
        numbers = [f"{end(row[kind] for row in mine):.1f}" for kind in _KINDS for end in (min, max)]
        lines.append([run, str(first["gaussians"]), *size, *numbers])
    return lines


def summary(lines: list[list[str]]) -> str:
    """Ranges over all runs, for the page."""
    heads, *runs = lines
    columns = dict(zip(heads, zip(*runs, strict=True), strict=True))
    page, archive, rules = (
        f"{min(columns[f'{kind}_least_db'], key=float)} to {max(columns[f'{kind}_most_db'], key=float)} dB"
        for kind in _KINDS
    )
    few, many = (f"{end(map(int, columns['gaussians'])):,}" for end in (min, max))
    return paragraph(
        f"In {len(runs)} runs of {few} to {many} Gaussians a screenshot in Chromium has a PSNR of {page} against `drgs "
        f"render --preset gsplat` of the run; the packed Gaussians alone have {archive}, and a screenshot against them "
        f"{rules} ([each run](data/share.csv); `python benchmarks/share.py RUN...`)."
    )


def _measure(browser, run: Path, folder: Path, args: argparse.Namespace) -> None:
    known = {(row["run"], row["view"]) for row in read_rows(ROWS)}
    shared = shared_of(Share(scene=run, uncertainty=False))
    page = folder / "scene.html"
    write_page(shared, page)
    archive = folder / "scene.sog"
    archive.write_bytes(encode_sog(shared.gaussians))
    held = load_gaussians(archive).replace(origin=shared.gaussians.origin)
    settings = RenderSettings.preset("gsplat", background=shared.background)
    count = len(shared.gaussians)
    sizes = {"gaussians": count, "archive_bytes": archive.stat().st_size, "page_bytes": page.stat().st_size}
    fitted = [camera for kind, camera in shared.cameras if kind == "fitted"]
    for index in np.unique(np.linspace(0, len(fitted) - 1, args.views).round().astype(int)):
        if (run.name, fitted[index].name) in known:
            continue
        camera = _in_window(fitted[index], *reduced_size(fitted[index], args.pixels))
        shot = _screenshot(browser, page, camera)
        own, kept = (_drawn(g, camera, settings) for g in (shared.gaussians, held))
        pairs = ((shot, own), (kept, own), (shot, kept))
        row = {"run": run.name, "view": camera.name, "pixels": camera.width * camera.height, **sizes}
        row |= {key: _psnr(a, b) for key, (a, b) in zip(_KINDS, pairs, strict=True)}
        add_row(ROWS, row | ran())
        print(row, flush=True)
        if args.pictures is not None:
            args.pictures.mkdir(parents=True, exist_ok=True)
            row = np.concatenate([own, shot, np.clip(10 * np.abs(shot - own), 0, 1)], 1)
            name = re.sub(r"\W", "_", f"{run.name}_{camera.name}")
            cv2.imwrite(str(args.pictures / f"{name}.png"), (255 * row[..., ::-1]).round().astype(np.uint8))


def _in_window(camera: Camera, width: int, height: int) -> Camera:
    """The camera of a page whose window has this size: all of the photograph in its middle, no side stretched."""
    scale = min(width / camera.width, height / camera.height)
    K = np.array(camera.K) * [[scale], [scale], [1]]
    K[:2, 2] += 0.5 * (np.array([width, height]) - scale * np.array([camera.width, camera.height]))
    return dataclasses.replace(camera, K=K, width=width, height=height)


def _screenshot(browser, page: Path, camera: Camera) -> np.ndarray:
    """(H, W, 3) of the page at a photograph's camera, once nothing is left to be sorted."""
    opened = browser.new_page(viewport={"width": camera.width, "height": camera.height})
    opened.goto(f"{page.as_uri()}#bare&photo={camera.name}")
    done = "body[data-state=settled], body[data-state=failed]"
    opened.wait_for_selector(done, state="attached", timeout=_PATIENCE)
    data = np.frombuffer(opened.screenshot(), np.uint8)
    opened.close()
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1] / 255.0


def _drawn(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> np.ndarray:
    with torch.no_grad():  # a picture
        return render(gaussians, camera, settings).rgb.clamp(0, 1).cpu().numpy()


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(a - b).mean()))


if __name__ == "__main__":
    main()
