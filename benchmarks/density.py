"""Where density control puts Gaussians: held-out PSNR of fits whose copies are drawn by other weights than opacity.

    python benchmarks/density.py [--scenes banana ...] [--rules error ...] [--steps 300] [--gaussians 8000] [--page]

Appends one row a fit to benchmarks/density.jsonl as it ends and leaves out what is there; `--page` writes
docs/data/density.csv, of which docs/real-data.md tells. Rules were tried on CHOOSING, and those that were best there
were then measured on SHOWING; `drgs fit` has none of them. A rule weighs the Gaussians at each step of density control
by what a few photographs or the gradients say; copies of one share its weight. Seconds are those that the process
computed in its steps, the photographs of the rule included. Made scenes are folders of `--made` (docs/real-data.md has
their commands).
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import torch  # noqa: E402
from fits import psnr_by_renderer, split_of  # noqa: E402
from steps import PATHS, SEEN, gains, lines, took_of  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import DATA, UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.data import load  # noqa: E402
from drgs.ellipsoids import Y_00  # noqa: E402
from drgs.fisher import removal_error  # noqa: E402
from drgs.fitting import density  # noqa: E402
from drgs.fitting import trainer as trainers  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import frames_for  # noqa: E402
from drgs.fitting.resolution import Resolution  # noqa: E402
from drgs.fitting.rows import GaussianRows  # noqa: E402
from drgs.fitting.start import start_plain  # noqa: E402
from drgs.fitting.trainer import Trainer  # noqa: E402
from drgs.integrator import render  # noqa: E402
from drgs.pruning import POWER  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402

ROWS = ROOT / "benchmarks" / "density.jsonl"
CHOOSING = ("banana", "fern", "office", "still0")
SHOWING = ("head", "statue", "street", "lego", "watch", "room22")
MADE = ("still0", "room22")
KEY = ("scene", "rule", "trained", "seed", "offset", "max_steps", "max_pixels", "max_gaussians")

Worths = tuple[torch.Tensor, torch.Tensor]
"""(N,) weight of each Gaussian as one to copy, and (N,) what it is worth: the least are moved."""
Rule = Callable[[Trainer], Worths]


def opacity(trainer: Trainer) -> torch.Tensor:
    """What density control draws by."""
    return trainer.rows.tensors["logit_opacities"].detach().sigmoid()


def plain(trainer: Trainer) -> Worths:
    """Density control as it is."""
    return opacity(trainer), opacity(trainer)


class Seen:
    """What photographs, by turns, say of Gaussians at a step of density control.

    Attributes:
        photographs: How many are looked at.
        power: Of the error of a pixel, a mean over its channels.
        weigh: (error, shares, opacity) -> weight: sums over the pixels of the share of a Gaussian in each, times the
            pixel's error, and of the shares.
    """

    def __init__(
        self,
        weigh: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor],
        photographs: int = 6,
        power: float = 1.0,
    ) -> None:
        self.weigh, self.photographs, self.power = weigh, photographs, power
        self.turn = 0
        self.error = self.seen = torch.zeros(0)

    def __call__(self, trainer: Trainer) -> Worths:
        gaussians = trainer.gaussians()
        settings = trainer.renderers.settings_at(trainer.step_index)
        count = min(self.photographs, len(trainer.frames))
        error, seen = torch.zeros(len(gaussians)), torch.zeros(len(gaussians))
        for _ in range(count):
            frame = trainer.frames[self.turn % len(trainer.frames)]
            self.turn += 1
            # The gradient of a sum of pixels by a color is the sum of the shares, but for channels that are below 0.
            sh = gaussians.sh.clone().requires_grad_()
            out = render(gaussians.replace(sh=sh), frame.camera, settings, outputs=("visibility",))
            residual = (out.rgb.detach().cpu() - frame.target()).abs().mean(2, keepdim=True) ** self.power
            if frame.mask is not None:
                residual *= frame.mask[..., None]
            (residual.to(out.rgb.device) * out.rgb).sum().backward()
            error += sh.grad[:, 0].amax(1).cpu() / Y_00
            seen += out.visibility.cpu()
        # Of what was seen before, as much as of an epoch is not seen now.
        left = 1 - count / len(trainer.frames) if len(self.error) else 0.0
        self.error = left * self.error + error if left else error * (len(trainer.frames) / count)
        self.seen = left * self.seen + seen if left else seen * (len(trainer.frames) / count)
        return self.weigh(self.error, self.seen, opacity(trainer)), self.seen.clone()

    def follow(self, source: torch.Tensor, moved: torch.Tensor | None) -> None:
        """Let Gaussians `moved`, or new ones, share with those that they are copies of."""
        unique, counts = source.unique(return_counts=True)
        for x in (self.error, self.seen):
            x[unique] /= counts + 1
        if moved is None:
            self.error, self.seen = (torch.cat([x, x[source]]) for x in (self.error, self.seen))
        else:
            self.error[moved], self.seen[moved] = self.error[source], self.seen[source]


class Looks:
    """Sum over the pixels of some photographs, by turns, of the share of each Gaussian times the pixel's error.

    Nothing is kept from one step of density control to the next. `photographs`: how many; 0: one in 10 steps.
    `halvings`: how many times they are halved.
    """

    def __init__(self, photographs: int, by_opacity: float = 0.0, halvings: int = 0) -> None:
        self.photographs, self.by_opacity = photographs, by_opacity
        self.resolution = Resolution(halvings, 10**9)
        self.order: list[int] = []

    def __call__(self, trainer: Trainer) -> Worths:
        gaussians, o = trainer.gaussians(), opacity(trainer)
        settings = trainer.renderers.settings_at(trainer.step_index)
        error = torch.zeros(len(gaussians))
        every = trainer.config.density.refine_every * trainer.config.max_steps
        for _ in range(min(self.photographs or max(1, round(every / 10)), len(trainer.frames))):
            self.order = self.order or torch.randperm(len(trainer.frames), generator=trainer.generator).tolist()
            index = self.order.pop()
            frame = self.resolution.resized(index, trainer.frames[index], 0)
            sh = gaussians.sh.clone().requires_grad_()
            out = render(gaussians.replace(sh=sh), frame.camera, settings)
            residual = (out.rgb.detach().cpu() - frame.target()).abs().mean(2, keepdim=True)
            if frame.mask is not None:
                residual *= frame.mask[..., None]
            (residual.to(out.rgb.device) * out.rgb).sum().backward()
            error += sh.grad[:, 0].amax(1).cpu() / Y_00
        return error * o**self.by_opacity, o


def removal(trainer: Trainer) -> Worths:
    """Those are moved without which all training photographs change least, by the error of `drgs prune`."""
    settings = trainer.renderers.settings_at(trainer.step_index)
    cameras, masks = [x.camera for x in trainer.frames], [x.mask for x in trainer.frames]
    return opacity(trainer), removal_error(trainer.gaussians(), cameras, settings, POWER, masks=masks)


def gradient(name: str, power: float = 1, by_opacity: float = 0, size: bool = False) -> Rule:
    """What Adam keeps of the gradients of a tensor (root of their mean square), perhaps times the size of the Gaussian.

    A mean is moved by a length, so that its gradient times the size is that by standard deviations.
    """

    def rule(trainer: Trainer) -> Worths:
        moments = trainer.rows.optimizer.state[trainer.rows.tensors[name]]["exp_avg_sq"]
        slopes = moments.flatten(1).sum(1).sqrt()
        if size:
            slopes = slopes * trainer.rows.tensors["log_scales"].detach().mean(1).exp()
        o = opacity(trainer)
        return slopes**power * o**by_opacity, o

    return rule


# Rule -> how it is made, and the share of the Gaussians that are moved at least at each step of density control; with
# `from half`, of a fit that begins with half of the budget, with `jitter`, of one whose copies are farther apart.
RULES: dict[str, tuple[Callable[[], Rule], float]] = {
    "opacity": (lambda: plain, 0),
    "error": (lambda: Seen(lambda e, w, o: e), 0),
    "error of 1 in 10 steps": (lambda: Looks(0), 0),
    "error of 1": (lambda: Looks(1), 0),
    "error of 2": (lambda: Looks(2), 0),
    "error of 4": (lambda: Looks(4), 0),
    "error of 4, halved": (lambda: Looks(4, 0, 1), 0),
    "error of 8, halved": (lambda: Looks(8, 0, 1), 0),
    "error of 2 opacity": (lambda: Looks(2, 1), 0),
    "error^0.5": (lambda: Seen(lambda e, w, o: e**0.5), 0),
    "error opacity": (lambda: Seen(lambda e, w, o: e * o), 0),
    "error^0.5 opacity^0.5": (lambda: Seen(lambda e, w, o: (e * o) ** 0.5), 0),
    "squared error": (lambda: Seen(lambda e, w, o: e, power=2), 0),
    "mean error opacity": (lambda: Seen(lambda e, w, o: e / w.clamp(min=1e-6) * o), 0),
    "gradient": (lambda: gradient("means", size=True), 0),
    "gradient^0.5": (lambda: gradient("means", 0.5, size=True), 0),
    "gradient^2": (lambda: gradient("means", 2, size=True), 0),
    "gradient opacity": (lambda: gradient("means", 1, 1, size=True), 0),
    "gradient^0.5 opacity^0.5": (lambda: gradient("means", 0.5, 0.5, size=True), 0),
    "gradient by length": (lambda: gradient("means"), 0),
    "gradient of scales": (lambda: gradient("log_scales"), 0),
    "gradient of color": (lambda: gradient("sh_dc"), 0),
    "opacity, 2 % by share": (lambda: Seen(lambda e, w, o: o), 0.02),
    "error, 1 % by share": (lambda: Seen(lambda e, w, o: e), 0.01),
    "error, 2 % by share": (lambda: Seen(lambda e, w, o: e), 0.02),
    "error, 5 % by share": (lambda: Seen(lambda e, w, o: e), 0.05),
    "error^0.5, 2 % by share": (lambda: Seen(lambda e, w, o: e**0.5), 0.02),
    "squared error, 2 % by share": (lambda: Seen(lambda e, w, o: e, power=2), 0.02),
    "opacity, 2 % by removal error": (lambda: removal, 0.02),
    "opacity, from half": (lambda: plain, 0),
    "error, from half": (lambda: Seen(lambda e, w, o: e), 0),
    "gradient, from half": (lambda: gradient("means", size=True), 0),
    "gradient of scales, from half": (lambda: gradient("log_scales"), 0),
    "gradient, moments anew": (lambda: gradient("means", size=True), 0),
    "gradient, jitter 0.5": (lambda: gradient("means", size=True), 0),
    "gradient, jitter 1": (lambda: gradient("means", size=True), 0),
    "gradient, 2 % by opacity": (lambda: gradient("means", size=True), 0.02),
}


def controlled(trainer: Trainer, rule: Rule, share: float, anew: bool = False) -> None:
    """Let density control draw by a rule's weights, and move a share of the Gaussians at least.

    `anew`: the means of those that are copied begin without moments, as those of their copies do.
    """
    weights = worth = torch.zeros(0)
    refine = trainer._refine

    def draw(rows: GaussianRows, among: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
        """Indices of Gaussians that are copied; these share the weight of the one that there was."""
        source = among[density._draw(weights[among] + 1e-12, count, generator)]
        unique, counts = source.unique(return_counts=True)
        weights[unique] /= counts + 1
        if anew:
            rows.overwrite(unique, {"means": rows.tensors["means"].detach()[unique]})
        return source

    def relocate(rows: GaussianRows, min_opacity: float, jitter: float, generator: torch.Generator) -> int:
        is_dead = rows.tensors["logit_opacities"].detach().sigmoid() <= min_opacity
        is_dead[: rows.far] = False
        more = int(share * (len(rows) - rows.far)) - int(is_dead.sum())
        if more > 0:
            rest = worth.masked_fill(is_dead, torch.inf)
            rest[: rows.far] = torch.inf
            is_dead[rest.argsort()[:more]] = True
        dead = is_dead.nonzero()[:, 0]
        alive = (~is_dead[rows.far :]).nonzero()[:, 0] + rows.far
        if not len(dead) or not len(alive):
            return 0
        source = draw(rows, alive, len(dead), generator)
        weights[dead] = weights[source]
        if isinstance(rule, Seen):
            rule.follow(source, dead)
        rows.overwrite(dead, density._copies(rows, source, min_opacity, jitter, generator))
        return len(dead)

    def add(rows: GaussianRows, count: int, min_opacity: float, jitter: float, generator: torch.Generator) -> int:
        if count <= 0 or len(rows) == rows.far:
            return 0
        source = draw(rows, torch.arange(rows.far, len(rows)), count, generator)
        if isinstance(rule, Seen):
            rule.follow(source, None)
        rows.append(density._copies(rows, source, min_opacity, jitter, generator))
        return count

    def ruled(*args: float) -> dict:
        nonlocal weights, worth
        weights, worth = (x.double() for x in rule(trainer))
        return refine(*args)

    trainer._refine = ruled
    trainers.relocate, trainers.add_gaussians = relocate, add


def halved(trainer: Trainer) -> None:
    """Begin with half of the budget at most, drawn from the initial points, and as much wider."""
    rows, most = trainer.rows, trainer.config.density.max_gaussians // 2
    if len(rows) <= most:
        return
    chosen = torch.randperm(len(rows), generator=trainer.generator)[:most].sort().values
    tensors = rows.take(chosen)
    tensors["log_scales"] = tensors["log_scales"] + 0.5 * math.log(len(rows) / most)  # points of surfaces
    trainer.rows = GaussianRows(tensors, rows.origin)
    trainer._start_count = most


def fit(
    scene: str, rule: str, trained: str, seed: int, offset: int, size: dict[str, int], folders: tuple[Path, Path]
) -> dict:
    """The row of one fit; `folders`: of the captures, and of the made scenes."""
    dataset = load(folders[scene in MADE] / PATHS.get(scene, scene))
    config = FitConfig().replace(
        renderers=(trained,), seed=seed, test_offset=offset, skybox="off", semantics="ignore", **size
    )
    if "jitter" in rule:
        config = config.replace(jitter=float(rule.split()[-1]))
    train, test = split_of(dataset, config)
    trainer = start_plain(dataset, train, frames_for(train, config.data), config)
    make, share = RULES[rule]
    controlled(trainer, make(), share, rule.endswith("anew"))
    if rule.endswith("from half"):
        halved(trainer)
    began = time.process_time()
    while trainer.step_index < config.max_steps:
        trainer.step()
    seconds = time.process_time() - began
    renderers = {name: RenderSettings.preset(name) for name in SEEN}
    psnr = psnr_by_renderer(trainer.gaussians(), frames_for(test, config.data), renderers)
    key = (scene, rule, trained, seed, offset, *size.values())
    return {**dict(zip(KEY, key, strict=True)), "psnr": psnr, "seconds": seconds, **ran()}


def write_data(rows: list[dict]) -> None:
    """The data file: every rule by capture, then over its captures."""
    seen = [f"{name}: mean / worst, dB" for name in SEEN]
    everything = [["rule", "trained", "steps", "Gaussians", "scene", "fits", *seen, "time"]]
    for trained, steps, gaussians in sorted({(x["trained"], x["max_steps"], x["max_gaussians"]) for x in rows})[::-1]:
        own = [x for x in rows if (x["trained"], x["max_steps"], x["max_gaussians"]) == (trained, steps, gaussians)]
        for rule in dict.fromkeys(row["rule"] for row in own if row["rule"] != "opacity"):
            scenes = [x for x in (*CHOOSING, *SHOWING) if gains(own, rule, trained, [x], "fast", "opacity")[0]]
            for some in [[scene] for scene in scenes] + ([scenes] if len(scenes) > 1 else []):
                took = ""
                if len(some) == 1 and not any("cuda" in row["machine"] for row in own):  # many fits shared a card
                    took = f"{took_of(own, rule, trained, *some) / took_of(own, 'opacity', trained, *some):.2f}"
                cells = lines(own, rule, trained, some, "opacity")
                everything.append([rule, trained, f"{steps}", f"{gaussians}", ", ".join(some), *cells, took])
    write_csv(PAGE_DATA / "density.csv", everything)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(CHOOSING), help="names of captures")
    parser.add_argument("--rules", nargs="+", choices=RULES, default=list(RULES))
    parser.add_argument("--units", type=int, default=1, help="seeds, each with other views held out")
    parser.add_argument("--trained", default="fast", help="as `drgs fit --for` takes it")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--pixels", type=int, default=12_000, help="of a photograph, at most")
    parser.add_argument("--gaussians", type=int, default=8_000)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the captures")
    parser.add_argument("--made", type=Path, default=ROOT / "runs" / "made", help="folder of the made scenes")
    parser.add_argument(
        "--page", action="store_true", help="fit nothing, write the data file of the rows that there are"
    )
    args = parser.parse_args()
    size = {"max_steps": args.steps, "max_pixels": args.pixels, "max_gaussians": args.gaussians}
    for unit, (seed, offset) in enumerate(UNITS[: args.units]):
        for scene in [] if args.page else args.scenes:
            for rule in args.rules if unit % 2 == 0 else args.rules[::-1]:
                done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
                if (scene, rule, args.trained, seed, offset, *size.values()) in done:
                    continue
                row = fit(scene, rule, args.trained, seed, offset, size, (args.data, args.made))
                add_row(ROWS, row)
                seen = [f"{sum(x) / len(x):.2f}/{min(x):.2f}" for x in row["psnr"].values()]
                print(scene, seed, rule, *seen, f"{row['seconds']:.1f} s", flush=True)
    if args.page:
        write_data(read_rows(ROWS))


if __name__ == "__main__":
    main()
