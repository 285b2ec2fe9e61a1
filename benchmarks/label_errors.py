"""Does the expected error of labels and of features say where they are wrong? AUSE on held-out views of fits.

    python benchmarks/label_errors.py [RUN ...]

Runs are folders of `drgs fit` with features and classes, whose data set is there, with labels of all views. Of labels
the true error of a pixel is 1 where the label that is drawn is not that of the data set. The expected error is once of
a record of the training views' labels, once of what the teacher's maps say, which err themselves. Features are compared
with the teacher's maps of held-out views, where there are some. AUSE as in benchmarks/expected_error.py. Rows are kept
(benchmarks/label_errors.jsonl), and the table is printed, of which docs/uncertainty.md tells. The part `unseen` was
chosen on CHOOSING.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import sys
from pathlib import Path

os.environ.setdefault("DRGS_THREADS", "1")

import numpy as np
import studies
import torch
from expected_error import ause
from studies import ROOT
from where import ran, rows_of_runs

import drgs
from drgs import fisher
from drgs.features.query import TEMPERATURE
from drgs.features.segmentation import classify, cosines
from drgs.fitting.frames import Frame, frames_for, load_dataset
from drgs.fitting.records import LoadedRun, load_run
from drgs.fitting.semantic_errors import feature_record, feature_residual, label_record, wrong_label
from drgs.gain import Prior, variances
from drgs.studies.tables import markdown_table, paragraph

CHOOSING = ("room21",)
ROWS = ROOT / "benchmarks" / "label_errors.jsonl"
OF_LABELS, OF_TEACHER = "expected, by labels", "expected, by the teacher"
RIVALS = ("entropy", "variance", "1 - alpha")


def measured(path: Path) -> dict:
    """The row of a run."""
    loaded = load_run(path)
    dataset = loaded.record.with_refined_poses(load_dataset(loaded.record.data, loaded.record.config, points=False))
    train, test = (frames_for(views, loaded.record.config.data) for views in dataset.split())
    records = {
        OF_LABELS: label_record(loaded, train),
        OF_TEACHER: label_record(loaded, [dataclasses.replace(frame, labels=None) for frame in train]),
    }
    of_features = feature_record(loaded, train)
    cameras, masks = [frame.camera for frame in train], [frame.mask for frame in train]
    of_colors = drgs.error_record(
        loaded.scene, cameras, [frame.image() for frame in train], loaded.record.config.settings, masks=masks
    )
    wrong: list[np.ndarray] = []
    far: list[np.ndarray] = []
    maps: dict[str, list[np.ndarray]] = {}
    feature_maps: dict[str, list[np.ndarray]] = {}
    for frame in test:
        seen, rivals = _seen(loaded, frame, of_colors)
        assert frame.labels is not None  # the runs of this study have labels
        labels = torch.from_numpy(frame.labels())
        keep = labels > 0 if frame.mask is None else (labels > 0) & (frame.mask > 0.5)
        found = classify(seen, loaded.classes, loaded.decoder)
        wrong.append((found != labels)[keep].double().numpy())
        told = {name: wrong_label(loaded.scene, frame.camera, record) for name, record in records.items()}
        for name, x in {**told, **rivals}.items():
            maps.setdefault(name, []).append(x[keep].double().numpy())
        if frame.teacher is not None:
            far.append(feature_residual(seen, frame, loaded.decoder)[keep].double().numpy())
            told = {"expected": drgs.expected_error(loaded.scene, frame.camera, of_features)}
            for name, x in {**told, **rivals}.items():
                feature_maps.setdefault(name, []).append(x[keep].double().numpy())
    error = np.concatenate(wrong)
    whole = {name: np.concatenate(x) for name, x in maps.items()}
    row = {
        "run": path.name,
        "views": [len(train), len(test)],
        "wrong": float(error.mean()),
        "wrong in training views": {name: x.mean_misfit for name, x in records.items()},
        "ause": {name: ause(error, x) for name, x in whole.items()},
        "told": {name: float(whole[name].mean()) for name in records},
        "features": None,
        **ran(),
    }
    if far:
        residual = np.concatenate(far)
        row["features"] = {name: ause(residual, np.concatenate(x)) for name, x in feature_maps.items()}
        row["features"]["true / expected"] = float(residual.mean() / np.concatenate(feature_maps["expected"]).mean())
    return row


def _seen(loaded: LoadedRun, frame: Frame, of_colors: drgs.ErrorRecord) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Rendered features (H, W, D) of a held-out view, and the maps that are no expected errors."""
    scene, camera, settings = loaded.scene, frame.camera, loaded.record.config.settings
    with torch.no_grad():
        out = drgs.render(scene, camera, settings, outputs=())
    likely = torch.softmax(cosines(out.features, loaded.classes.embeddings, loaded.decoder).double() / TEMPERATURE, 2)
    weights = variances(of_colors.information, Prior(1.0))
    return out.features, {
        "entropy": torch.special.entr(likely).sum(2),
        "variance": fisher.variance_map(scene, camera, weights, settings, sphere=of_colors.sphere),
        "1 - alpha": 1 - out.alpha,
    }


def label_table(rows: list[dict]) -> str:
    """A row a run: labels."""
    names = [OF_LABELS, OF_TEACHER, *RIVALS]
    lines = []
    for row in rows:
        ratios = (f"{row['wrong'] / row['told'][name]:.2f}" for name in (OF_LABELS, OF_TEACHER))
        chosen = " (chosen on)" if row["run"] in CHOOSING else ""
        cells = (f"{row['ause'][name]:.2f}" for name in names)
        lines.append([row["run"] + chosen, f"{row['wrong']:.1%}", *cells, *ratios])
    return markdown_table(
        ["run", "wrong labels", *names, "true / expected, by labels", "true / expected, by the teacher"], lines
    )


def feature_sentence(rows: list[dict]) -> str:
    """What the runs with maps of held-out views say about features."""
    some = [row for row in rows if row["features"]]
    if not some:
        return "No held-out view has a teacher's map."
    means = (f"{name} {statistics.mean(row['features'][name] for row in some):.2f}" for name in ("expected", *RIVALS))
    ratios = ", ".join(f"{row['features']['true / expected']:.2f}" for row in some)
    runs = ", ".join(row["run"] for row in some)
    return paragraph(
        f"Features against the teacher's maps of held-out views ({runs}), mean AUSE: {', '.join(means)}; true / "
        f"expected {ratios}."
    )


def main() -> int:
    rows = rows_of_runs(ROWS, measured, __doc__)
    text = [f"`python benchmarks/label_errors.py`, {studies.made(rows)}.", label_table(rows), feature_sentence(rows)]
    print("\n\n".join(text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
