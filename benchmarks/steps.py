"""Units of the optimizer's steps: held-out PSNR of fits whose tensors are moved by other rules, and of averaged ones.

    python benchmarks/steps.py [--scenes banana ...] [--rules size ...] [--units 3] [--trained fast] [--page]

Appends one row a fit to benchmarks/steps.jsonl as it ends and leaves out what is there, then writes
docs/data/steps.csv, of which docs/real-data.md tells. Rules were tried on CHOOSING, and those that were best there were
then measured on SHOWING; fits of a scene take turns, one thread. Rules multiply the steps that Adam has made, and of
"pairs" two photographs make one update, as many photographs in all; `drgs fit` has none of them. Seconds are those that
the process computed in its steps, whatever ran beside it. Averages over the last steps are of the same fits. Made
scenes are folders of `--made` (docs/real-data.md has their commands).
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
from fits import psnr_by_renderer, split_of  # noqa: E402
from studies import PAGE_DATA, write_csv  # noqa: E402
from where import DATA, UNITS, add_row, ran, read_rows  # noqa: E402

from drgs.data import load  # noqa: E402
from drgs.ellipsoids import semi_axes  # noqa: E402
from drgs.fitting.config import FitConfig  # noqa: E402
from drgs.fitting.frames import frames_for  # noqa: E402
from drgs.fitting.start import start_plain  # noqa: E402
from drgs.fitting.trainer import Trainer  # noqa: E402
from drgs.settings import RenderSettings  # noqa: E402
from drgs.studies.statistics import Unit, estimate  # noqa: E402

ROWS = ROOT / "benchmarks" / "steps.jsonl"
CHOOSING = ("banana", "fern", "office", "still0")
SHOWING = ("head", "statue", "lego", "bonsai", "street", "room22")
MADE = ("still0", "still7", "room21", "room22")
PATHS = {"street": "street/sparse_dev/0"}
SIZE = {"max_steps": 300, "max_pixels": 12_000, "max_gaussians": 8_000}
SEEN = ("fast", "exact", "gsplat")
WINDOWS = (0.05, 0.1, 0.2)  # shares of the steps, the last ones, that averages are of; density control ends at 0.8
AVERAGED = ("Adam", "size")  # rules whose averages are measured, too
KEY = ("scene", "rule", "trained", "seed", "offset", *SIZE)

Factors = dict[str, torch.Tensor | float]
Rule = Callable[[Trainer], Factors]
"""Tensor -> factor of the step that Adam makes, before the step; tensors that are left out keep Adam's."""


def sizes(trainer: Trainer) -> torch.Tensor:
    """(N,) geometric means of the scales, over their median."""
    log_sizes = trainer.rows.tensors["log_scales"].detach().mean(1)
    return (log_sizes - log_sizes[trainer.rows.far :].median()).exp()


def means(power: float) -> Rule:
    """The means, by a power of the size of their Gaussian."""
    return lambda trainer: {"means": (sizes(trainer) ** power).clamp(1 / 8, 8)[:, None]}


def scales(power: float) -> Rule:
    """Log-scales, likewise."""
    return lambda trainer: {"log_scales": (sizes(trainer) ** power).clamp(1 / 8, 8)[:, None]}


def axes(trainer: Trainer) -> Factors:
    """The means, along each axis of the Gaussian by its scale: (N, 3, 3) factors."""
    t = {name: x.detach() for name, x in trainer.rows.tensors.items()}
    median = t["log_scales"][trainer.rows.far :].mean(1).median()
    scale = (t["log_scales"] - median).exp().clamp(1 / 8, 8)
    rotation = semi_axes(t["quats"], torch.ones_like(scale))
    return {"means": rotation @ (scale[:, :, None] * rotation.transpose(1, 2))}


class ByPhotographs:
    """By a power of how many photographs show a mean, or of its Gaussian's size in their pixels, over the median."""

    def __init__(self, power: float, *names: str, pixels: bool = False) -> None:
        self.power, self.names, self.pixels = power, names, pixels
        self.factor = torch.ones(0)

    def __call__(self, trainer: Trainer) -> Factors:
        if len(self.factor) != len(trainer.rows) or trainer.step_index % 10 == 0:
            places = trainer.rows.places().numpy()
            shown, scale = np.zeros(len(places)), np.zeros(len(places))
            for frame in trainer.frames:
                pixels, depth = frame.camera.project(places)
                here = frame.camera.contains(pixels, depth)
                shown += here
                scale[here] += frame.camera.K[0, 0] / depth[here]
            is_shown = torch.from_numpy(shown > 0)
            values = (
                torch.from_numpy(scale / shown.clip(1)) * sizes(trainer) if self.pixels else torch.from_numpy(shown)
            )
            factor = (values / values[is_shown].median()) ** self.power
            self.factor = torch.where(is_shown, factor.clamp(1 / 8, 8), 1.0).float()
        shapes = {name: trainer.rows.tensors[name].dim() - 1 for name in self.names}
        return {name: self.factor.reshape(-1, *[1] * more) for name, more in shapes.items()}


def opacity(trainer: Trainer) -> Factors:
    """Logits, so that opacities move alike: by 0.25 / (o (1 - o)), at most 8."""
    o = trainer.rows.tensors["logit_opacities"].detach().sigmoid()
    return {"logit_opacities": (0.25 / (o * (1 - o))).clamp(max=8)}


def falling(last: float, *names: str) -> Rule:
    """Rates that fall to a part `last`, log-linear."""
    return lambda trainer: {name: last**trainer.part for name in names}


def cooled(share: float, *names: str) -> Rule:
    """Rates that fall to 0 over the last `share` of the steps, linear."""
    return lambda trainer: {name: min(1.0, (1 - trainer.part) / share) for name in names}


def faster(factor: float) -> Rule:
    """All rates times a factor."""
    return lambda trainer: dict.fromkeys(trainer.rows.tensors, factor)


REST = ("quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest")
RULES: dict[str, Callable[[], Rule]] = {
    "Adam": lambda: lambda trainer: {},
    "size": lambda: means(1.0),
    "size^0.5": lambda: means(0.5),
    "axes": lambda: axes,
    "scales by size^0.5": lambda: scales(0.5),
    "scales by size^-0.5": lambda: scales(-0.5),
    "scales by pixels": lambda: ByPhotographs(1.0, "log_scales", pixels=True),
    "scales by pixels^0.5": lambda: ByPhotographs(0.5, "log_scales", pixels=True),
    "scales by pixels^-0.5": lambda: ByPhotographs(-0.5, "log_scales", pixels=True),
    "scales by photographs^0.5": lambda: ByPhotographs(0.5, "log_scales"),
    "scales by photographs^-0.5": lambda: ByPhotographs(-0.5, "log_scales"),
    "SH by photographs": lambda: ByPhotographs(1.0, "sh_rest"),
    "opacity": lambda: opacity,
    "opacity by photographs^0.5": lambda: ByPhotographs(0.5, "logit_opacities"),
    "opacity by photographs^-0.5": lambda: ByPhotographs(-0.5, "logit_opacities"),
    "pairs": lambda: faster(1.0),
    "pairs, rates x 1.4": lambda: faster(2**0.5),
    "all but means fall to 0.1": lambda: falling(0.1, *REST),
    "all fall to 0 in the last 0.2": lambda: cooled(0.2, "means", *REST),
    "all fall to 0 in the last 0.4": lambda: cooled(0.4, "means", *REST),
}


def paired(trainer: Trainer) -> None:
    """Let an update have the gradient of two photographs, whose sum moves as their mean does: Adam divides by it."""
    optimizer = trainer.rows.optimizer
    step, zero_grad = optimizer.step, optimizer.zero_grad
    optimizer.step = lambda: step() if trainer.step_index % 2 else None
    optimizer.zero_grad = lambda set_to_none: None if trainer.step_index % 2 else zero_grad(set_to_none)


def hooked(trainer: Trainer, rule: Rule) -> None:
    """Let every step of the optimizer be changed by a rule."""
    before: dict[str, torch.Tensor] = {}
    factors: Factors = {}

    def note(*_: object) -> None:
        factors.clear()
        factors.update(rule(trainer))
        before.update({name: trainer.rows.tensors[name].detach().clone() for name in factors})

    def change(*_: object) -> None:
        with torch.no_grad():
            for name, factor in factors.items():
                x = trainer.rows.tensors[name]
                step = x - before[name]
                whole = isinstance(factor, torch.Tensor) and factor.dim() == step.dim() + 1
                x.copy_(before[name] + ((factor @ step[..., None])[..., 0] if whole else factor * step))

    trainer.rows.optimizer.register_step_pre_hook(note)
    trainer.rows.optimizer.register_step_post_hook(change)


def fit(scene: str, rule: str, trained: str, seed: int, offset: int, made: Path) -> list[dict]:
    """The rows of one fit and of its averages; `made` is the folder of the made scenes."""
    dataset = load(made / scene if scene in MADE else DATA / PATHS.get(scene, scene))
    config = FitConfig().replace(
        renderers=(trained,),
        seed=seed,
        test_offset=offset,
        skybox="off",
        semantics="ignore",
        **SIZE,
    )
    train, test = split_of(dataset, config)
    frames = frames_for(train, config.data)
    trainer = start_plain(dataset, train, frames, config)
    hooked(trainer, RULES[rule]())
    if rule.startswith("pairs"):
        paired(trainer)
    windows = WINDOWS if rule in AVERAGED else ()
    sums: dict[float, dict[str, torch.Tensor]] = {}
    began = time.process_time()
    for step in range(config.max_steps):
        trainer.step()
        for window in windows:
            if step >= config.max_steps - round(window * config.max_steps):
                old = sums.setdefault(window, {})
                for name, x in trainer.rows.tensors.items():
                    old[name] = x.detach().double() + old.get(name, 0.0)
    seconds = time.process_time() - began
    held_out = frames_for(test, config.data)
    renderers = {name: RenderSettings.preset(name) for name in SEEN}
    rows = []
    for window in (0.0, *windows):
        for name, x in sums.get(window, {}).items():
            trainer.rows.tensors[name].data.copy_(x / round(window * config.max_steps))
        key = (scene, f"{rule}{f', mean of the last {window:g}' if window else ''}", trained, seed, offset)
        psnr = psnr_by_renderer(trainer.gaussians(), held_out, renderers if not window else {"fast": renderers["fast"]})
        rows.append({**dict(zip(KEY, (*key, *SIZE.values()), strict=True)), "psnr": psnr, "seconds": seconds, **ran()})
    return rows


Gains = dict[Unit, float]
"""Unit -> what a rule adds to Adam, dB."""


def gains(
    rows: list[dict], rule: str, trained: str, scenes: Sequence[str], seen: str, base: str = "Adam"
) -> tuple[Gains, Gains]:
    """Of the mean, and of the worst held-out view, where this rule and `base` were fitted."""
    found: tuple[Gains, Gains] = ({}, {})
    for row in rows:
        other = next((x for x in rows if all(x[k] == (row | {"rule": base})[k] for k in KEY)), None)
        if (row["rule"], row["trained"]) != (rule, trained) or row["scene"] not in scenes or other is None:
            continue
        if seen not in row["psnr"] or seen not in other["psnr"]:
            continue
        unit = (row["scene"], (8, row["offset"]), (str(row["seed"]),))
        now, before = row["psnr"][seen], other["psnr"][seen]
        found[0][unit] = statistics.mean(now) - statistics.mean(before)
        found[1][unit] = min(now) - min(before)
    return found


def lines(rows: list[dict], rule: str, trained: str, scenes: Sequence[str], base: str = "Adam") -> list[str]:
    """Cells of a line: units, and what a rule adds in each renderer, with the interval over several scenes."""
    cells: list[str] = []
    for seen in SEEN:
        mean, worst = gains(rows, rule, trained, scenes, seen, base)
        if not mean:
            cells.append("")
            continue
        effect = estimate(mean)
        cells.append(f"{effect.mean:+.2f} / {estimate(worst).mean:+.2f}")
        if effect.scenes > 1:
            cells[-1] += f" [{effect.low:+.2f}, {effect.high:+.2f}]"
        if seen == SEEN[0]:
            cells.insert(0, str(effect.units))
    return cells


def took_of(rows: list[dict], rule: str, trained: str, scene: str) -> float:
    """Seconds of a fit, the mean."""
    same = [row for row in rows if (row["rule"], row["trained"], row["scene"]) == (rule, trained, scene)]
    return statistics.mean(row["seconds"] for row in same)


def over_adam(rows: list[dict], rule: str, trained: str, scene: str) -> str:
    """Seconds of a fit over Adam's of the same unit and day, means; empty without: what runs beside differs by day."""
    same = [row for row in rows if (row["trained"], row["scene"]) == (trained, scene)]
    pairs = [
        (own["seconds"], adam["seconds"])
        for own in same
        for adam in same
        if own["rule"] == rule and adam["rule"] == "Adam" and all(own[k] == adam[k] for k in ("seed", "offset", "date"))
    ]
    return f"{sum(own for own, _ in pairs) / sum(adam for _, adam in pairs):.2f}" if pairs else ""


def write_data(rows: list[dict]) -> None:
    """The data file: every rule by capture, then over those that it was tried on and those that it was shown on."""
    everything = [["rule", "trained", "scene", "fits", *(f"{seen}: mean / worst, dB" for seen in SEEN), "time"]]
    for trained in sorted({row["trained"] for row in rows}, reverse=True):
        for rule in dict.fromkeys(row["rule"] for row in rows if row["rule"] != "Adam"):
            for scenes in (CHOOSING, SHOWING):
                own = [scene for scene in scenes if gains(rows, rule, trained, [scene], "fast")[0]]
                for scene in own:
                    took = over_adam(rows, rule, trained, scene)
                    everything.append([rule, trained, scene, *lines(rows, rule, trained, [scene]), took])
                if len(own) > 1:
                    everything.append([rule, trained, ", ".join(own), *lines(rows, rule, trained, own), ""])
    write_csv(PAGE_DATA / "steps.csv", everything)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(CHOOSING), help="names of captures")
    parser.add_argument("--rules", nargs="+", choices=RULES, default=list(RULES))
    parser.add_argument("--units", type=int, default=1, help="seeds, each with other views held out")
    parser.add_argument("--trained", default="fast", help="as `drgs fit --for` takes it")
    parser.add_argument("--made", type=Path, default=ROOT / "runs" / "made", help="folder of the made scenes")
    parser.add_argument(
        "--page", action="store_true", help="fit nothing, write the data file of the rows that there are"
    )
    args = parser.parse_args()
    for unit, (seed, offset) in enumerate(UNITS[: args.units]):
        for scene in [] if args.page else args.scenes:
            for rule in args.rules if unit % 2 == 0 else args.rules[::-1]:
                done = {tuple(row[name] for name in KEY) for row in read_rows(ROWS)}
                if (scene, rule, args.trained, seed, offset, *SIZE.values()) in done:
                    continue
                rows = fit(scene, rule, args.trained, seed, offset, args.made)
                for row in rows:
                    add_row(ROWS, row)
                mean = [sum(row["psnr"]["fast"]) / len(row["psnr"]["fast"]) for row in rows]
                print(scene, seed, rule, *(f"{x:.2f}" for x in mean), f"{rows[0]['seconds']:.1f} s", flush=True)
    write_data(read_rows(ROWS))


if __name__ == "__main__":
    main()
