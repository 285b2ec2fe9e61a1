"""`drgs cite`: BibTeX of what a run rests on, or of what every use does.

The entries are in `references.bib`, each below a comment that says what of the work is used. Whether a run used it is
said here, by the entry's key, and read from the run's config.json and metrics.json alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from drgs.fitting.renderers import RendererSchedule
from drgs.io.json_files import read_json
from drgs.runtime import version

if TYPE_CHECKING:
    from drgs.commands.options import Cite
    from drgs.fitting.config import SelectionConfig
    from drgs.fitting.records import FitRecord
    from drgs.settings import RenderSettings


class _Used(NamedTuple):
    """What a run did, as far as it says what to cite.

    Attributes:
        record: Record of its fit.
        format: Format of its data set.
        selection: How views were chosen, or None if none were.
        lpips: Whether LPIPS was measured.
    """

    record: FitRecord
    format: str
    selection: SelectionConfig | None
    lpips: bool

    def rendered(self) -> tuple[RenderSettings, ...]:
        """What its steps were rendered with."""
        config = self.record.config
        return RendererSchedule.of(config.renderers, config.settings).all_settings

    def chose(self, *policies: str) -> bool:
        """Whether views were chosen by one of these policies."""
        return self.selection is not None and self.selection.policy in policies

    def scored(self, *criteria: str) -> bool:
        """Whether policy `fisher` scored by one of these criteria."""
        return self.chose("fisher") and self.selection is not None and self.selection.scoring.criterion in criteria

    def with_fisherrf(self) -> bool:
        """Whether FisherRF's criterion, policy or method chose views."""
        by_method = self.chose("fisher") and self.selection is not None and self.selection.scoring.method == "fisherrf"
        return self.chose("fisherrf") or self.scored("eig") or by_method


_Test = Callable[[_Used], bool]

_EVERY_USE = ("drgs", "jakob2022drjit", "mitsuba3", "kerbl2023gaussians", "li2025nextbestview")
"""Keys of what is cited whatever was done, also without a run."""

_RUNS: dict[str, _Test] = {
    "kheradmand2024mcmc": lambda used: True,
    "moenneloccoz2024raytracing": lambda used: any(s.response == "peak" for s in used.rendered()),
    "zwicker2001ewa": lambda used: any(s.response == "ewa" for s in used.rendered()),
    "ye2025gsplat": lambda used: any("gsplat" in (s.fov_clamp, s.culling) for s in used.rendered()),
    "wu2025threedgut": lambda used: any(s.nearest_preset()[0] == "3dgut" for s in used.rendered()),
    "yu2024mipsplatting": lambda used: used.record.config.filter_3d == "on",
    "schoenberger2016sfm": lambda used: used.format == "colmap",
    "zhou2024feature3dgs": lambda used: used.record.semantics is not None,
    "wu2024fourd": lambda used: bool(used.record.times),
    "jiang2024fisherrf": _Used.with_fisherrf,
    "wilson2025popgs": lambda used: used.scored("logdet", "trace_cov", "block_logdet"),
    "ash2021bait": lambda used: used.scored("v_opt"),
    "ewen2025moments": lambda used: used.chose("moments"),
    "wang2004ssim": lambda used: True,
    "andersson2020flip": lambda used: True,
    "zhang2018lpips": lambda used: used.lpips,
}
"""Key -> whether a run used the work."""


def run(args: Cite) -> None:
    """`drgs cite [RUN]`."""
    print(cited(args.run))


def cited(folder: Path | None) -> str:
    """BibTeX of what a run used; without one, of what every use does.

    Args:
        folder: Run folder, or None.
    Raises:
        FileNotFoundError: If it is no run folder.
        ValueError: If its config.json is damaged.
    """
    keys = list(_EVERY_USE)
    if folder is not None:
        used = _used(folder)
        keys += [key for key, test in _RUNS.items() if test(used)]
    entries = _entries()
    return "\n\n".join(entries[key] for key in keys)


def _used(folder: Path) -> _Used:
    """What a run did; it need not have come to its end."""
    from drgs.fitting.records import fit_record
    from drgs.io.run import Run  # loads torch, which a list without a run does not need

    run = Run(folder)
    record = fit_record(run)
    path = run.path / "metrics.json"
    metrics: Any = read_json(path, "a run's metrics.json") if path.is_file() else {}
    mean = metrics.get("mean") if isinstance(metrics, dict) else None
    lpips = isinstance(mean, dict) and mean.get("lpips") is not None
    return _Used(record, str(run.config().get("format", "")), record.config.selection, lpips)


def _entries() -> dict[str, str]:
    """Key -> text of each entry of `references.bib`, with its comment; the program's own says its version, too."""
    blocks = Path(__file__).with_name("references.bib").read_text().strip().split("\n\n")
    entries = {re.search(r"^@\w+\{(\w+),$", block, flags=re.M)[1]: block for block in blocks}
    entries["drgs"] = entries["drgs"].removesuffix("}") + f"  version = {{{version()}}},\n}}"
    return entries
