"""One model in viewers of others: runs of `drgs fit` in four programs that draw Gaussians in a browser, by WebGL.

    pip install --no-deps --target out/viewers vuer==0.1.6 gradio==6.31.0
    python benchmarks/viewers.py RUN [RUN ...] [--wheels out/viewers] [--far 10000] [--page] [--picture FILE]

| viewer | out of the wheel | what it is |
|---|---|---|
| viser | viser, installed with `drgs[view]` | its client, three.js with shaders of its own, sorted by WebAssembly |
| Spark | vuer | sparkjsdev/spark on three.js, once as it comes, once with the blur that the file was fitted for |
| Babylon.js | gradio | the viewer of Babylon.js |
| gsplat.js | gradio | huggingface/gsplat.js |

Needs Chromium (`make browser`) and playwright. Nothing of these wheels is imported but viser: their JavaScript is
served to the browser from where pip put it, and none of it is part of this repository. Chromium draws by software.

A run's PLY is drawn from the cameras of held-out photographs, at the size of the fit, on black, and compared with the
photograph and with our own picture of the preset `gsplat`, of the degree of the spherical harmonics that the viewer
draws. A row a run and viewer is added to benchmarks/viewers.jsonl; rows of runs of the same name and far plane are
replaced. Without `--far` the far plane is that of viser and gsplat.js themselves, 1000 and 100 units away, and 1000 for
the others, which take it from the program around them.
By their code viewers leave out a Gaussian whose center is outside of the picture by a share of its half width: 10 %
(viser), 40 % (Spark) or 20 % (Babylon.js, gsplat.js). viser's client sorts by 16 bits between the nearest and the
farthest center, so that a skybox makes its order of what is near coarser; Babylon.js's own viewer has its far plane at
1100 times the diagonal of what it has loaded. Neither was measured. None takes colors for linear ones.

`--page` writes docs/data/viewers.csv, of which docs/one-model.md tells, `--picture` a sheet of one view of the runs
of one capture.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import http.server
import importlib.metadata
import os
import re
import shutil
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from fits import split_of  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import add_row, ran, read_rows  # noqa: E402

from drgs.cameras import Camera  # noqa: E402
from drgs.ellipsoids import Gaussians  # noqa: E402
from drgs.files import Run, load_ply  # noqa: E402
from drgs.fitting.frames import Frame, frames_for, load_dataset  # noqa: E402
from drgs.fitting.metrics import psnr  # noqa: E402
from drgs.fitting.records import load_run  # noqa: E402
from drgs.fitting.renderers import ANY  # noqa: E402
from drgs.integrator import render  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.viewing.client import ClientGaussians, pose_of  # noqa: E402

ROWS = ROOT / "benchmarks" / "viewers.jsonl"
LEFT_OUT = ("inria", "3dgut", "Spark, as it comes")  # of what is printed; the data file has all
PAGES = ROOT / "benchmarks" / "viewer_pages"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PATIENCE = 300.0  # s until a viewer must have drawn: the processor draws, and may be busy
PAUSE = 0.7  # s between two pictures, of which three must be the same: the viewer has sorted and drawn
SORTED = 3.0  # s that viser's client has for sorting before its first picture, which may be of an older order
FAR = 1000.0
"""Where pictures of those end that have no far plane of their own, in units of the scene."""
ALIKE = 3
"""Pictures in a row that must be the same."""
CELL = 200
"""Pixels of the width of a picture in the sheet."""


@dataclasses.dataclass(frozen=True)
class Viewer:
    """A program that draws Gaussians in a browser.

    Attributes:
        name: As tables have it.
        wheel: Distribution that holds it.
        page: File of `PAGES` that opens it; None for viser, which is led by its own server.
        module: Path of its module in the wheel, a pattern of `Path.glob`.
        degree: Largest degree of the spherical harmonics that it draws.
        options: What its renderer is told.
    """

    name: str
    wheel: str
    page: str | None
    module: str
    degree: int
    options: dict[str, float] = dataclasses.field(default_factory=dict)


_GRADIO = "gradio/templates/frontend/assets/"
_VUER = "vuer/client_build/assets/chunks/chunk-*.js"
VIEWERS = (
    Viewer("viser", "viser", None, "", 0),
    # The 0.3 px^2 of a PLY of 3D Gaussian Splatting, which it calls the blur before the opacity; as it comes it takes
    # a file for one that was fitted with the opacities of anti-aliasing, and lowers those of small Gaussians.
    Viewer("Spark", "vuer", "spark.js", _VUER, 3, {"preBlurAmount": 0.3, "blurAmount": 0.0}),
    Viewer("Spark, as it comes", "vuer", "spark.js", _VUER, 3),
    Viewer("Babylon.js", "gradio", "babylon.js", _GRADIO + "lib-*.js", 3),
    Viewer("gsplat.js", "gradio", "gsplatjs.js", _GRADIO + "Canvas3DGS-*.js", 0),
)
SHEET = ("viser", "Spark", "Babylon.js", "gsplat.js")
"""Viewers in the sheet of pictures."""


def folder_of(wheel: str, wheels: Path) -> Path | None:
    """Where pip put a distribution: the folder of `--wheels`, or one of `sys.path`; None where it is in neither."""
    for place in (str(wheels), *sys.path):
        found = next(iter(importlib.metadata.distributions(name=wheel, path=[place])), None)
        if found is not None:
            return Path(place)
    return None


def version_of(wheel: str, folder: Path) -> str:
    """Version of a distribution in a folder."""
    return next(iter(importlib.metadata.distributions(name=wheel, path=[str(folder)]))).version


def module_of(viewer: Viewer, folder: Path) -> Path:
    """The module of a viewer: of the files that match, the one that has its names."""
    wanted = {"spark.js": "SparkRenderer", "babylon.js": "CreateViewerForCanvas", "gsplatjs.js": "u_transformIndices"}
    for path in sorted(folder.glob(viewer.module), key=lambda path: -path.stat().st_size):
        if wanted[str(viewer.page)] in path.read_text(errors="replace"):
            return path
    sys.exit(f"viewers: {viewer.wheel} must have {viewer.name} in {viewer.module}, has not; take the version above")


def exported(module: str) -> dict[str, str]:
    """Long name -> short name of what a bundle exports: `export{SparkRenderer$1 as w, ...}`."""
    listed = re.findall(r"export\s*\{([^{}]*)\}", module)[-1]
    pairs = (entry.split(" as ") for entry in listed.split(",") if " as " in entry)
    return {re.sub(r"\$\d+$", "", long.strip()): short.strip() for long, short in pairs}


def with_exports(module: str) -> str:
    """The module of gsplat.js without what it imports of gradio's page, and with its classes exported.

    The component makes a scene, a camera and a renderer one after the other, and lets a loader read a file.
    """
    made = re.search(r"=new (\w+),\w+=new (\w+),\w+=new (\w+)\(\w+\)", module)
    loader = re.search(r"await (\w+)\.LoadAsync\(", module)
    head = re.match(r'import\{([^}]*)\}from"[^"]*";import"[^"]*";', module)
    if not (made and loader and head):
        sys.exit("viewers: gradio's Canvas3DGS must make a scene, a camera and a renderer, does not; take 6.31.0")
    names = ",".join(entry.split(" as ")[-1] for entry in head[1].split(","))
    body = module[head.end() :]
    classes = (*made.groups(), loader[1])
    listed = ",".join(f"{c} as {n}" for c, n in zip(classes, ("Scene", "Camera", "Renderer", "PLYLoader"), strict=True))
    return f"const [{names}]=Array({names.count(',') + 1}).fill(()=>()=>{{}});{body};export{{{listed}}};"


class Pages(http.server.SimpleHTTPRequestHandler):
    """Serves the pages, the modules of the wheels and the models, each under a first folder of its own."""

    roots: dict[str, Path] = {}
    texts: dict[str, str] = {}

    def log_message(self, *_: Any) -> None:
        """Say nothing."""

    def translate_path(self, path: str) -> str:
        _, first, *rest = path.split("?")[0].split("/")
        return str(self.roots.get(first, Path("/nowhere")).joinpath(*rest))

    def do_GET(self) -> None:
        if (text := self.texts.get(self.path)) is None:
            return super().do_GET()
        self.send_response(200)
        self.send_header("Content-Type", "text/javascript" if self.path.endswith(".js") else "text/html")
        self.end_headers()
        self.wfile.write(text.encode())
        return None


@contextlib.contextmanager
def serving(roots: dict[str, Path], texts: dict[str, str]) -> Iterator[str]:
    """Within, the address of a server of these folders and texts."""
    handler = type("Served", (Pages,), {"roots": roots, "texts": texts})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()


def said(camera: Camera) -> dict[str, Any]:
    """A camera as the pages take it."""
    k = np.asarray(camera.K, np.float64)
    w2c = np.asarray(camera.w2c, np.float64)
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": k[0, 0],
        "fy": k[1, 1],
        "cx": k[0, 2],
        "cy": k[1, 2],
        "world_to_camera": w2c.reshape(-1).tolist(),
    }


def pixels_of(png: bytes) -> torch.Tensor:
    """(H, W, 3) float32 in [0, 1] of a PNG, over black."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return over_black(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB))


def over_black(image: np.ndarray) -> torch.Tensor:
    """(H, W, 3) float32 in [0, 1] of 8-bit colors, with an opacity or without."""
    values = torch.from_numpy(image.astype(np.float32) / 255)
    return values[..., :3] * values[..., 3:] if values.shape[2] == 4 else values


def settled(take: Callable[[], torch.Tensor], where: str) -> torch.Tensor:
    """A picture that stays as it is, and is not empty."""
    end = time.monotonic() + PATIENCE
    seen: list[torch.Tensor] = []
    while time.monotonic() < end:
        seen = [*seen[1 - ALIKE :], take()]
        if len(seen) == ALIKE and all(torch.equal(seen[0], other) for other in seen[1:]) and bool(seen[0].any()):
            return seen[0]
        time.sleep(PAUSE)
    sys.exit(f"viewers: {where} must come to rest within {PATIENCE:.0f} s, did not; is the processor busy?")


def in_page(
    viewer: Viewer, folder: Path, browser: Any, ply: Path, cameras: list[Camera], far: float | None
) -> list[torch.Tensor]:
    """Pictures of a viewer that one of our pages opens, with another far plane unless that is None."""
    from playwright.sync_api import Error

    module = module_of(viewer, folder)
    text = module.read_text()
    texts = {"/": "<!doctype html><title>viewer</title><link rel='icon' href='data:,'>"}
    address = f"/wheel/{module.relative_to(folder)}"
    if viewer.page == "gsplatjs.js":
        address = "/gsplat.js"
        texts[address] = with_exports(text)
    names = exported(text) if viewer.page == "spark.js" else {}
    roots = {"pages": PAGES, "wheel": folder, "models": ply.parent}
    views = [said(camera) for camera in cameras]
    size = {"width": views[0]["width"], "height": views[0]["height"]}
    with serving(roots, texts) as server:
        page = browser.new_page(viewport=size, device_scale_factor=1)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
        try:
            page.set_default_timeout(1000 * PATIENCE)
            page.goto(server)
            spec = {
                "module": address,
                "names": names,
                "model": f"{server}/models/{ply.name}",
                "view": views[0],
                "options": viewer.options,
                "far": FAR if far is None and viewer.page != "gsplatjs.js" else far,
                "patience": 1000 * PATIENCE,
            }
            code = (
                f"async (spec) => {{ const opened = import('/pages/{viewer.page}').then((page) => page.open(spec)); "
                "const late = new Promise((_, no) => setTimeout(() => no(new Error('it takes too long')), "
                "spec.patience)); "
                "window.shown = await Promise.race([opened, late]); }"
            )
            try:
                page.evaluate(code, spec)
            except Error as error:
                text = " ".join([*str(error).split(), *errors])[:600]
                sys.exit(f"viewers: {viewer.name} must open {ply}, does not: {text}")
            pictures = []
            for view, camera in zip(views, cameras, strict=True):
                page.evaluate("(view) => { window.shown.look(view); }", view)
                time.sleep(PAUSE)
                take = functools.partial(page.screenshot, clip={"x": 0, "y": 0, **size})
                pictures.append(settled(lambda take=take: pixels_of(take()), f"{viewer.name} of {camera.name}"))
            return pictures
        finally:
            page.close()


def in_viser(browser: Any, g: Gaussians, cameras: list[Camera], far: float | None) -> list[torch.Tensor]:
    """Pictures of viser's client, of what `drgs view` sends it, with another far plane unless that is None.

    The pictures that it is asked for end 1000 units away whatever is said, so that the scene is made smaller instead.
    """
    import viser

    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        smaller = 1.0 if far is None else FAR / far
        sent = ClientGaussians.of(g)
        server.scene.add_gaussian_splats(
            "/g", sent.centers, sent.covariances, sent.rgbs, sent.opacities, scale=smaller * sent.scale
        )
        # Of the size of the views, and with their lens: `get_render` draws Gaussians by those of the window.
        size = {"width": cameras[0].width, "height": cameras[0].height}
        page = browser.new_page(viewport=size, device_scale_factor=1)
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        end = time.monotonic() + PATIENCE
        while not server.get_clients() and time.monotonic() < end:
            page.wait_for_timeout(200)
        (client,) = server.get_clients().values()
        pictures = []
        for camera in cameras:
            pose = pose_of(camera, np.asarray(g.origin, np.float64))
            pose = dataclasses.replace(pose, position=smaller * pose.position)
            taken: list[Any] = []
            client.camera.wxyz, client.camera.position, client.camera.fov = pose.wxyz, pose.position, pose.fov
            page.wait_for_timeout(1000 * SORTED)

            def take(camera: Camera = camera, pose: Any = pose, taken: list[Any] = taken) -> torch.Tensor:
                # The client answers only while playwright lets its page run.
                def ask() -> None:
                    taken.append(
                        client.get_render(
                            camera.height,
                            camera.width,
                            wxyz=pose.wxyz,
                            position=pose.position,
                            fov=pose.fov,
                            transport_format="png",
                        )
                    )

                thread = threading.Thread(target=ask, daemon=True)
                thread.start()
                while thread.is_alive():
                    page.wait_for_timeout(100)
                return over_black(taken[-1])

            pictures.append(settled(take, f"viser of {camera.name}"))
        page.close()
        return pictures
    finally:
        server.stop()


def of_degree(g: Gaussians, degree: int) -> Gaussians:
    """The same Gaussians with spherical harmonics up to a degree."""
    return dataclasses.replace(g, sh=g.sh[:, : (degree + 1) ** 2])


def drawn(g: Gaussians, camera: Camera, preset: str) -> torch.Tensor:
    """(H, W, 3) of ours, in steps of 8 bits as pictures of browsers are."""
    with torch.no_grad():
        image = render(g, camera, RenderSettings.preset(preset), outputs=()).rgb.cpu().clamp(0, 1)
    return (image * 255).round() / 255


def held_out(folder: Path, count: int) -> list[Frame]:
    """Evenly spaced held-out photographs of a run, at the size of the fit."""
    record = load_run(folder).record
    dataset = load_dataset(record.data, record.config)
    _, test = split_of(dataset, record.config)
    chosen = [test[round((i + 0.5) * len(test) / count - 0.5)] for i in range(min(count, len(test)))]
    return frames_for(chosen, record.config.data)


def measured(
    folder: Path, count: int, wheels: Path, browser: Any, far: float | None
) -> tuple[list[dict], dict[str, list[torch.Tensor]]]:
    """Rows of a run, and the pictures behind them by renderer and viewer; `far` as of `in_page`."""
    ply = Run(folder).point_cloud
    g = load_ply(ply)
    frames = held_out(folder, count)
    cameras = [frame.camera for frame in frames]
    photographs = [frame.image() for frame in frames]
    pictures = {"photograph": photographs}
    pictures |= {name: [drawn(g, camera, name) for camera in cameras] for name in ANY}
    degrees = {viewer.degree for viewer in VIEWERS}
    ours = {d: [drawn(of_degree(g, d), camera, "gsplat") for camera in cameras] for d in degrees}
    rows = []
    about = {"run": folder.name, "views": [frame.name for frame in frames], "gaussians": len(g.means), **ran()}
    about |= {} if far is None else {"far": far}

    def add(name: str, version: str | None, degree: int, options: dict) -> None:
        row = {"seen_with": name, "version": version, "degree": degree, "options": options}
        row["photograph"] = [psnr(a, b) for a, b in zip(pictures[name], photographs, strict=True)]
        row["gsplat"] = [psnr(a, b) for a, b in zip(pictures[name], ours[degree], strict=True)]
        rows.append({**about, **row})
        print(folder.name, name, *([round(x, 2) for x in row[key]] for key in ("photograph", "gsplat")), flush=True)

    for name in ANY:
        add(name, None, 3, {})
    pictures["gsplat, degree 0"] = ours[0]
    add("gsplat, degree 0", None, 3, {})
    for viewer in VIEWERS:
        place = folder_of(viewer.wheel, wheels)
        if place is None:
            advice = f"pip install --no-deps --target {wheels} {viewer.wheel}"
            print(f"viewers: {viewer.name} must have the wheel {viewer.wheel}, is left out without; {advice}")
            continue
        shown = (
            in_page(viewer, place, browser, ply, cameras, far) if viewer.page else in_viser(browser, g, cameras, far)
        )
        pictures[viewer.name] = shown
        add(viewer.name, version_of(viewer.wheel, place), viewer.degree, viewer.options)
    return rows, pictures


def unit_of(row: dict) -> tuple[str, float | None]:
    """Run and far plane of a row, None for that which a viewer has without."""
    return row["run"], row.get("far")


def table(found: list[dict]) -> str:
    """PSNR against photographs, by run and viewer."""
    runs = list(dict.fromkeys(unit_of(row) for row in found))
    names = [name for name in dict.fromkeys(row["seen_with"] for row in found) if name not in LEFT_OUT]
    titles = [f"`{run}`" + (f", far {far:,.0f}" if far else "") for run, far in runs]
    lines = [f"| seen with | {' | '.join(titles)} |", "|---" * (1 + len(runs)) + "|"]
    for name in names:
        cells = []
        for run in runs:
            row = next((row for row in found if (unit_of(row), row["seen_with"]) == (run, name)), None)
            if row is None:
                cells.append("-")
                continue
            cells.append(f"{statistics.mean(row['photograph']):.2f}")
        title = f"`{name}`" if name in ANY else "`gsplat`, degree 0" if name.startswith("gsplat,") else name
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def sheet_lines(found: list[dict]) -> list[list[str]]:
    """The data file: PSNR against photographs, and against our own picture."""
    lines = [["run", "far", "seen_with", "photograph", "gsplat"]]
    for row in found:
        numbers = f"{statistics.mean(row['photograph']):.2f}", f"{statistics.mean(row['gsplat']):.1f}"
        lines.append([row["run"], f"{row['far']:.0f}" if row.get("far") else "", row["seen_with"], *numbers])
    return lines


def sheet(rows: dict[str, list[torch.Tensor]], names: list[str], label_of: dict[str, str], at: int) -> np.ndarray:
    """One view of each run in a row, (H, W, 3) of 8 bits in BGR."""
    strips = []
    for pictures in rows.values():
        cells = []
        for name in names:
            image = (pictures[name][at].numpy() * 255).round().astype(np.uint8)[..., ::-1]
            height = round(CELL * image.shape[0] / image.shape[1])
            cells.append(cv2.resize(image, (CELL, height), interpolation=cv2.INTER_AREA))
        strips.append(
            np.concatenate([np.pad(cell, ((0, 4), (0, 4), (0, 0)), constant_values=255) for cell in cells], 1)
        )
    margin = 58
    body = [np.pad(strip, ((0, 0), (margin, 0), (0, 0)), constant_values=255) for strip in strips]
    head = np.full((24, body[0].shape[1], 3), 255, np.uint8)
    for i, name in enumerate(names):
        where = margin + i * (CELL + 4) + 4, 17
        cv2.putText(head, name, where, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    for run, strip in zip(rows, body, strict=True):
        where = 4, strip.shape[0] // 2
        cv2.putText(strip, label_of[run], where, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([head, *body])


def write_jpeg(path: Path, image: np.ndarray, most: int = 200_000) -> None:
    """Write a JPEG of at most so many bytes."""
    for quality in range(90, 20, -5):
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= most:
            path.write_bytes(data)
            return
    sys.exit(f"viewers: {path} must fit into {most} bytes, does not; give fewer runs")


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path, help="folders that `drgs fit` wrote")
    parser.add_argument("--wheels", type=Path, default=ROOT / "out" / "viewers", help="where pip put vuer and gradio")
    parser.add_argument("--views", type=int, default=3, help="held-out photographs of each run")
    parser.add_argument("--far", type=float, help="far plane of all viewers, in units of the scene")
    parser.add_argument("--page", action="store_true", help="write docs/data/viewers.csv")
    parser.add_argument("--picture", type=Path, help="JPEG of one view in all of them, a run a row")
    parser.add_argument("--at", type=int, default=0, help="which of the views the picture shows")
    parser.add_argument("--keep", type=Path, help="folder for all pictures")
    args = parser.parse_args()
    shown: dict[str, dict[str, list[torch.Tensor]]] = {}
    if args.runs:
        chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
        if chromium is None:
            sys.exit("viewers: needs Chromium, found none; run `make browser`")
        try:
            from playwright.sync_api import sync_playwright
        except ImportError:
            sys.exit("viewers: needs playwright; pip install playwright")
        with sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
            for folder in args.runs:
                rows, shown[folder.name] = measured(folder, args.views, args.wheels, browser, args.far)
                others = [row for row in read_rows(ROWS) if unit_of(row) != (folder.name, args.far)]
                ROWS.write_text("")
                for row in [*others, *rows]:
                    add_row(ROWS, row)
            browser.close()
    if args.keep:
        args.keep.mkdir(parents=True, exist_ok=True)
        for run, pictures in shown.items():
            for name, images in pictures.items():
                for i, image in enumerate(images):
                    bgr = (image.numpy() * 255).round().astype(np.uint8)[..., ::-1]
                    cv2.imwrite(str(args.keep / f"{run}-{name.replace(' ', '_')}-{i}.png"), bgr)
    if args.picture and shown:
        names = ["photograph", *ANY, *(name for name in SHEET if all(name in found for found in shown.values()))]
        write_jpeg(args.picture, sheet(shown, names, {run: f"{run.split('-')[-1]}" for run in shown}, args.at))
    text = table(read_rows(ROWS))
    print(text)
    if args.page:
        write_csv(PAGE_DATA / "viewers.csv", sheet_lines(read_rows(ROWS)))


if __name__ == "__main__":
    main()
