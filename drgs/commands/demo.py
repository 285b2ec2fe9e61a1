"""`drgs demo`: photographs become Gaussians, and every claim about the renderer is measured on them.

The still life is path traced from meshes by scenes/still_life.py, so nothing is downloaded and
nothing in it is a Gaussian. Times are medians of interleaved runs with warm kernels on this machine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from drgs import reference, runtime
from drgs.cameras import Camera, intrinsics_from_fov, look_at
from drgs.cameras.sizes import cropped
from drgs.commands.options import Demo
from drgs.commands.report import report_of
from drgs.commands.scene import maker_of
from drgs.data import Dataset, load
from drgs.display import pictures, tables
from drgs.display.progress import Bar
from drgs.ellipsoids import Gaussians
from drgs.fitting import metrics
from drgs.fitting.frames import Frame, frames_for
from drgs.fitting.losses import psnr_of
from drgs.information.expected_error import error_record, expected_error
from drgs.integrator import render
from drgs.io.journal import SCHEMA
from drgs.io.outputs import LockedFolder, lock_folder, write_json
from drgs.pages.report.write import FILE
from drgs.settings import RenderSettings
from drgs.train import FitConfig, FitResult, fit

_PRESETS = {
    "exact": "exact order along every ray, nothing cut off above 1e-5",
    "fast": "one depth a Gaussian, cut at 3 sigma",
    "inria": "INRIA's rasterizer: projected covariance, its cut-offs",
    "gsplat": "gsplat's rasterizer, its cut-offs",
    "3dgut": "as exact at each hit, gsplat's order and cut-offs",
    "mitsuba": "as fast, on Mitsuba's acceleration structure, entry order",
}
_DIFFERENCE_GAIN = 8  # factor of difference pictures: differences of a few of 255 levels become visible; chosen
_PANEL_WIDTH = 600  # pixels of width of a picture in overview.png; chosen
_OWN_COMMANDS = ("demo", "eval", "report")  # commands whose files in the run may be replaced
_TARGET = (0.0, -0.02, 0.12)  # the middle of the table, in meters
_DISTANCE = 1.1  # meters from there to the cameras of the turntable, outside of the table; chosen


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """How much of everything; the defaults take minutes.

    Attributes:
        views: Number of photographs of the still life.
        width, height: Size of these in pixels.
        spp: Light paths a pixel.
        steps: Number of steps of the fit.
        gaussians: Largest number of Gaussians of the fit.
        crop: Width and height of the part that the float64 oracle renders.
        repeats: Number of rounds of interleaved timing.
        frames: Number of frames of the turntable.
    """

    views: int = 28
    width: int = 240
    height: int = 180
    spp: int = 30
    steps: int = 1500
    gaussians: int = 24_000
    crop: tuple[int, int] = (48, 36)
    repeats: int = 5
    frames: int = 48

    @classmethod
    def quick(cls) -> Plan:
        """Half a minute, to see that everything runs; its pictures are poor."""
        return cls(views=9, width=80, height=60, spp=4, steps=60, gaussians=1500, crop=(16, 12), repeats=2, frames=6)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PresetRow:
    """One preset on the held-out views.

    Attributes:
        preset: Name of the preset.
        what: Rules of the preset in words.
        psnr_to_photographs: Mean PSNR to the photographs in dB.
        psnr_to_exact: Mean PSNR to the images of `exact` in dB; None of `exact` itself.
        max_difference: Largest difference from the images of `exact`; None of `exact` itself.
        seconds: Median time of a view.
        time_of_exact: Median ratio to the time of `exact` in the same round.
    """

    preset: str
    what: str
    psnr_to_photographs: float
    psnr_to_exact: float | None
    max_difference: float | None
    seconds: float
    time_of_exact: float


def run(args: Demo) -> None:
    """`drgs demo`."""
    make_demo(args.output, Plan.quick() if args.quick else Plan(), progress=not args.quiet)


def make_demo(out_dir: Path, plan: Plan, progress: bool = False) -> dict:
    """Make, fit, render, compare; writes pictures and demo.json.

    Args:
        out_dir: Its folders `still_life` (kept if it is there) and `run` (replaced) belong to the demo; a folder of
            that name that an earlier demo did not make is refused.
        plan: How much of everything.
        progress: Whether to say what comes out, on stdout, and how far it is, on stderr.
    Returns:
        What demo.json holds.
    Raises:
        FileNotFoundError: In a checkout without links.
        ValueError: If something is in the way that an earlier demo did not make.
    """
    with (
        lock_folder(out_dir, "demo", ["overview.png", "comparison.png", "turntable.webm", "demo.json"]),
        lock_folder(Path(out_dir) / "run", "demo") as run_folder,
    ):
        return _make_demo(Path(out_dir), run_folder, plan, progress)


def _make_demo(out_dir: Path, run_folder: LockedFolder, plan: Plan, progress: bool) -> dict:
    """The tour, in folders that belong to it: six stages, each timed, and demo.json at the end."""
    run_folder.check_all(_OWN_COMMANDS)
    tour = _Demo(out_dir, plan, progress)
    began = time.perf_counter()
    dataset = load(tour.still_life())
    run_folder.clear(_OWN_COMMANDS)
    fitted, frames = tour.fit(dataset)
    g = fitted.gaussians
    images, rows = tour.compare(g, frames)
    oracle = tour.check(g, frames, images)
    peer = tour.race(g, frames)
    tour.draw(dataset, fitted, frames, images)
    tour.seconds["total"] = time.perf_counter() - began
    tour.say(f"All of it took {tour.seconds['total']:.0f} s; numbers: {out_dir / 'demo.json'}")
    measured = fitted.metrics
    report = {
        "schema": SCHEMA,
        "command": "demo",
        "plan": dataclasses.asdict(plan),
        "fit": {
            "gaussians": len(g),
            "seconds": fitted.seconds,
            "split": measured["split_rule"],
            "mean": measured["mean"],
        },
        "presets": [dataclasses.asdict(row) for row in rows],
        "oracle": oracle,
        "peer": peer,
        "seconds": tour.seconds,
        "env": runtime.info(),
    }
    write_json(out_dir / "demo.json", report)
    return report


@dataclasses.dataclass
class _Demo:
    """The stages of the demo; each says what comes out, and how long it took is in `seconds`."""

    out_dir: Path
    plan: Plan
    progress: bool
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def config(self) -> FitConfig:
        """The fit's configuration."""
        return FitConfig().replace(
            renderers=("fast",),  # the picture shows what others make of it; to take all in turn takes twice as long
            max_steps=self.plan.steps,
            max_gaussians=self.plan.gaussians,
            max_pixels=self.plan.width * self.plan.height,
            save_every=self.plan.steps,
        )

    def say(self, text: str) -> None:
        """A line on stdout."""
        if self.progress:
            print(text, flush=True)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """The time of a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = time.perf_counter() - start

    def still_life(self) -> Path:
        """1. The photographs; their folder."""
        plan = self.plan
        size = {"views": plan.views, "width": plan.width, "height": plan.height, "spp": plan.spp}
        with self.timed("still life"), Bar("path tracing", plan.views, self.progress) as bar:
            show = lambda done, total: bar.update(done, total)  # noqa: E731
            data = maker_of("still_life").generate(self.out_dir / "still_life", **size, progress=show)
        took = self.seconds["still life"]
        size_text = f"{plan.views} views of {plan.width}x{plan.height}"
        self.say(f"1. Still life: {size_text}, path traced from meshes ({took:.0f} s)")
        return data

    def fit(self, dataset: Dataset) -> tuple[FitResult, list[Frame]]:
        """2. The fit, and its held-out views."""
        plan = self.plan
        with self.timed("fit"):
            fitted = fit(dataset, self.out_dir / "run", self.config, progress=self.progress)
        mean = fitted.metrics["mean"]
        frames = frames_for(dataset.split()[1], self.config.data)
        self.say(
            f"2. Fit: {len(fitted.gaussians)} Gaussians, {plan.steps} steps in {fitted.seconds:.0f} s; {len(frames)} "
            f"views that it never saw: PSNR {mean['psnr']:.2f} dB, SSIM {mean['ssim']:.3f}, FLIP {mean['flip']:.3f}"
        )
        return fitted, frames

    def compare(self, g: Gaussians, frames: list[Frame]) -> tuple[dict[str, list[torch.Tensor]], list[PresetRow]]:
        """3. Images of the presets, and what they differ in."""
        with self.timed("comparison"), Bar("presets compared", show=self.progress):
            images, rows = _compare(g, frames, self.plan.repeats)
        self.say(f"3. The same Gaussians by the rules of other renderers ({len(frames)} held-out views)")
        self.say("   They are fitted for fast alone; drgs fit without --for fits for all of them.")
        if self.progress:
            _table(rows)
        return images, rows

    def check(self, g: Gaussians, frames: list[Frame], images: dict[str, list[torch.Tensor]]) -> dict:
        """4. `exact` against the float64 oracle."""
        with self.timed("oracle"), Bar("float64 oracle", show=self.progress):
            oracle = _check(g, frames[0], images["exact"][0], self.plan.crop)
        self.say(
            f"4. Float64 oracle, {oracle['width']}x{oracle['height']} pixels of view {oracle['view']}: `exact` is off "
            f"by at most {oracle['max_error']:.1e} (claimed: 1e-5) where no two of {oracle['hits_a_ray']:.0f} hits a "
            f"ray tie ({100 * oracle['ties']:.0f} % of the pixels do)"
        )
        return oracle

    def race(self, g: Gaussians, frames: list[Frame]) -> dict:
        """5. `fast` against Mitsuba's integrator."""
        with self.timed("peer"), Bar("Mitsuba's integrator", show=self.progress):
            peer = _race(g, frames[0].camera, self.plan.repeats)
        self.say(
            f"5. Mitsuba's own volprim_rf_basic: {1e3 * peer['volprim_rf_basic']:.0f} ms a view, `fast`: "
            f"{1e3 * peer['fast']:.0f} ms, {peer['ratio']:.1f} times as fast (interleaved, {self.plan.repeats} rounds)"
        )
        return peer

    def draw(
        self, dataset: Dataset, fitted: FitResult, frames: list[Frame], images: dict[str, list[torch.Tensor]]
    ) -> None:
        """6. Pictures, and the report of the fit."""
        page = fitted.run.path / FILE
        g = fitted.gaussians
        with self.timed("pictures"):
            fitted_frames = frames_for(dataset.split()[0], self.config.data)
            pictures.write_png(self.out_dir / "overview.png", _overview(g, fitted_frames, frames, images["exact"]))
            pictures.write_png(self.out_dir / "comparison.png", _sheet(frames, images))
            _turntable(g, self.out_dir / "turntable.webm", self.plan, self.progress)
            report_of(fitted.run, page, dataset)
        names = ", ".join(str(self.out_dir / name) for name in ("overview.png", "comparison.png", "turntable.webm"))
        self.say(f"6. Pictures: {names}; the fit's report: {page}")


def _compare(g: Gaussians, frames: list[Frame], repeats: int) -> tuple[dict[str, list[torch.Tensor]], list[PresetRow]]:
    """Images of every preset, and one row of numbers each."""
    settings = {name: RenderSettings.preset(name) for name in _PRESETS}
    images = {name: [_draw(g, frame.camera, s) for frame in frames] for name, s in settings.items()}
    times: dict[str, list[float]] = {name: [] for name in settings}
    for i in range(repeats):
        frame = frames[i % len(frames)]
        for name, s in settings.items():
            times[name].append(_seconds(lambda s=s, camera=frame.camera: _draw(g, camera, s)))
    rows = []
    for name in settings:
        pairs = list(zip(images[name], images["exact"], strict=True))
        photos = [metrics.psnr(a.clamp(0, 1), f.image()) for a, f in zip(images[name], frames, strict=True)]
        same = name == "exact"
        rows.append(
            PresetRow(
                preset=name,
                what=_PRESETS[name],
                psnr_to_photographs=statistics.mean(photos),
                psnr_to_exact=None if same else statistics.mean(metrics.psnr(a, b) for a, b in pairs),
                max_difference=None if same else max(float((a - b).abs().max()) for a, b in pairs),
                seconds=statistics.median(times[name]),
                time_of_exact=statistics.median(t / e for t, e in zip(times[name], times["exact"], strict=True)),
            )
        )
    return images, rows


def _draw(g: Gaussians, camera: Camera, settings: RenderSettings) -> torch.Tensor:
    """(H, W, 3) on the CPU, computed when this returns."""
    import drjit as dr

    with torch.no_grad():  # a picture, not optimized
        image = render(g, camera, settings, outputs=()).rgb.cpu()
    dr.sync_thread()
    return image


def _seconds(work: Callable) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _check(g: Gaussians, frame: Frame, image: torch.Tensor, crop: tuple[int, int]) -> dict:
    """The middle of an `exact` image against the float64 oracle."""
    camera = frame.camera
    width, height = crop
    x, y = (camera.width - width) // 2, (camera.height - height) // 2
    part = cropped(camera, x, y, width, height)
    with torch.no_grad():  # compared, not optimized
        truth = reference.render(g, part, RenderSettings.preset("exact"))
    error = (image[y : y + height, x : x + width].double() - truth.rgb).abs()
    # Where two peaks are nearer than float32 can tell, either order is right: the oracle marks such pixels.
    error = error[~truth.ambiguous]
    return {
        "view": frame.name,
        "width": width,
        "height": height,
        "max_error": float(error.max()),
        "mean_error": float(error.mean()),
        "ties": float(truth.ambiguous.double().mean()),
        "hits_a_ray": float(truth.count.double().mean()),
    }


def _race(g: Gaussians, camera: Camera, repeats: int) -> dict:
    """`fast` and Mitsuba's `volprim_rf_basic` at its defaults, in turn; seconds a view."""
    mi = runtime.mitsuba()
    from drgs.ellipsoids import ellipsoids_shape

    settings = RenderSettings.preset("fast")
    sensor = camera.relative_to(g.origin).to_mitsuba()
    sensor["sampler"] = {"type": "stratified", "sample_count": 1, "jitter": False}  # pixel centers, as ours
    # Its sRGB step is for colors in linear light; those of Gaussians are not.
    integrator = {"type": "volprim_rf_basic", "srgb_primitives": False}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, "shape": ellipsoids_shape(g)})

    def peer() -> np.ndarray:
        return np.asarray(mi.render(scene, spp=1))

    def ours() -> np.ndarray:
        return _draw(g, camera, settings).numpy()

    theirs = peer()[..., :3]
    mse = float(np.mean((np.clip(theirs, 0, 1) - np.clip(ours(), 0, 1)) ** 2))  # as pictures are shown
    times = [(_seconds(ours), _seconds(peer)) for _ in range(repeats)]
    return {
        "fast": statistics.median(a for a, _ in times),
        "volprim_rf_basic": statistics.median(b for _, b in times),
        "ratio": statistics.median(b / a for a, b in times),
        "psnr_between": psnr_of(mse),
        "note": "its defaults: 3 sigma, 64 hits a ray, transmittance 0.01; srgb_primitives off; 1 sample a pixel",
    }


def _overview(g: Gaussians, fitted: list[Frame], frames: list[Frame], images: list[torch.Tensor]) -> np.ndarray:
    """The held-out view that is met worst: photograph, rendering, error, and the error that was to be expected without
    this photograph.
    """
    import cv2

    photos = [frame.image() for frame in frames]
    worst = min(range(len(frames)), key=lambda i: metrics.psnr(images[i].clamp(0, 1), photos[i]))
    frame, photo, image = frames[worst], photos[worst], images[worst].clamp(0, 1)
    settings = RenderSettings.preset("fast")  # that of the fit
    record = error_record(g, [x.camera for x in fitted], [x.image() for x in fitted], settings)
    expected = expected_error(g, frame.camera, record).sqrt().numpy()
    error = (image - photo).square().mean(-1).sqrt().numpy()
    # Each on a scale of its own: where an error is largest, its mean over all that may be there is smaller.
    shown = {"error": error, "expected error": expected}
    panels = {
        "photograph, held out": photo.numpy(),
        "rendering": image.numpy(),
        **{text: pictures.inferno(x / max(np.percentile(x, 99.5), 1e-6)) for text, x in shown.items()},
    }
    wide = (_PANEL_WIDTH, round(_PANEL_WIDTH * frame.camera.height / frame.camera.width))
    large = {
        text: cv2.resize(x if x.dtype == np.uint8 else pictures.to_bytes(x), wide, interpolation=cv2.INTER_CUBIC)
        for text, x in panels.items()
    }
    cells = [pictures.caption(x, text, times=2) for text, x in large.items()]
    return np.concatenate([np.concatenate(cells[:2], axis=1), np.concatenate(cells[2:], axis=1)])


def _sheet(frames: list[Frame], images: dict[str, list[torch.Tensor]]) -> np.ndarray:
    """Rows of photograph, render and differences, for up to three views."""
    rows = []
    for i, frame in enumerate(frames[:3]):
        exact = images["exact"][i]
        photo = frame.image()
        parts = {f"view {frame.name}": photo, "exact": exact}
        parts[f"|exact - photograph| x {_DIFFERENCE_GAIN // 2}"] = (_DIFFERENCE_GAIN // 2) * (
            exact.clamp(0, 1) - photo
        ).abs()
        for name in ("fast", "inria", "gsplat"):
            parts[f"|{name} - exact| x {_DIFFERENCE_GAIN}"] = _DIFFERENCE_GAIN * (images[name][i] - exact).abs()
        rows.append(np.concatenate([pictures.caption(x.numpy(), text) for text, x in parts.items()], axis=1))
    return np.concatenate(rows, axis=0)


def _turntable(g: Gaussians, path: Path, plan: Plan, progress: bool) -> None:
    """A swing over the arc that the cameras cover: behind it, nothing was ever seen."""
    settings = RenderSettings.preset("fast")
    K = intrinsics_from_fov(50.0, plan.width, plan.height)
    with pictures.Video(path) as movie, Bar("turntable", plan.frames, progress) as bar:
        for i in range(plan.frames):
            phase = 2 * np.pi * i / plan.frames
            azimuth = np.radians(-90 + 75 * np.sin(phase))
            rise = np.radians(30 + 10 * np.cos(phase))
            level = np.cos(rise)
            eye = _DISTANCE * np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(rise)])
            camera = Camera(K=K, w2c=look_at(eye, _TARGET), width=plan.width, height=plan.height)
            movie.write(_draw(g, camera, settings).numpy())
            bar.advance()


def _table(rows: list[PresetRow]) -> None:
    """Print the rows on stdout."""
    cells = []
    for row in rows:
        same = row.psnr_to_exact is None
        cells.append(
            (
                row.preset,
                f"{row.psnr_to_photographs:.2f}",
                "-" if same else f"{row.psnr_to_exact:.1f}",
                "-" if same else f"{row.max_difference:.3f}",
                f"{1e3 * row.seconds:.0f}",
                f"{row.time_of_exact:.2f}",
            )
        )
    columns = ("preset", "dB to photos", "dB to exact", "most off", "ms a view", "time / exact")
    tables.show("", columns, cells)
