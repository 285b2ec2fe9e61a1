"""The step `poses` of a capture: cameras and points by structure from motion, and problems of the shoot."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from drgs.capturing import diagnosis
from drgs.capturing.budget import plan_poses, planned_poses
from drgs.data.dataset import HELD_OUT, write_held_out
from drgs.data.images import list_images
from drgs.display.progress import Bar
from drgs.fitting.records import fit_record
from drgs.io.outputs import lock_folder
from drgs.sfm.reconstruction import SfmOptions, run_sfm
from drgs.sfm.registration import register

if TYPE_CHECKING:
    from drgs.capturing.capture import Capture
    from drgs.sfm.findings import Finding

Outcome: TypeAlias = "tuple[str, list[Finding]]"
"""Result of a step: the line that is printed, and findings about the capture."""


def find_poses(capture: Capture) -> Outcome:
    """Poses of the first photographs, at a size that the budget allows.

    Raises:
        ValueError: If too few photographs can be connected; the message has what is wrong with them.
    """
    names = [path.name for path in list_images(capture.photos)]
    budget = capture.clock.budget
    size: dict[str, Any] = {}
    if budget is not None:
        plan = plan_poses(capture.photos, names, budget, capture.photographs.decode)
        capture.plan("poses", plan)
        size = {"max_image_size": plan.max_image_size}
        capture.say(planned_poses(plan, len(names), capture.clock.left, budget))
    with _with_findings(capture), Bar("poses") as bar:
        summary = run_sfm(
            capture.photos,
            capture.scene,
            SfmOptions(seed=capture.options.seed, masks=capture.options.masks, **size),
            bar.stage,
            _progress_on(bar),
        )
    capture.poses_changed()
    line = (
        f"{summary.registered} of {summary.total} photographs have a pose, {summary.points} points, "
        f"{summary.reprojection_error:.2f} px"
    )
    with Bar("what poses say"):
        findings = diagnosis.of_poses(capture.dataset, names, summary)
        return line, findings + diagnosis.of_exposure(capture.dataset, capture.options.seed)


def add_poses(capture: Capture) -> Outcome:
    """Poses of photographs that are added to others; those of the others do not change.

    Raises:
        ValueError: As `find_poses`.
    """
    scene, files = capture.scene, list_images(capture.photos)
    if not (scene / HELD_OUT).is_file():
        write_held_out(scene, fit_record(capture.run).test, "capture")
    posed, summary = _views_of_files(capture, files), None
    if not posed:
        with lock_folder(scene, "capture") as held:
            for link in _links_to(scene / "images", files):  # of a command that ended before it had poses
                held.remove(link)
        before = capture.record.batches[0].plan.get("poses", {})
        size = {key: before[key] for key in ("max_image_size",) if key in before}
        with _with_findings(capture), Bar("poses") as bar:
            options = SfmOptions(seed=capture.options.seed, **size)
            joined = register(scene, files, options, bar.stage, _progress_on(bar))
        summary = joined.summary
        capture.poses_changed()
        posed = _views_of_files(capture, files)
    with Bar("what poses say"):
        names = [path.name for path in list_images(scene / "images")]
        findings = diagnosis.of_poses(capture.dataset, names, summary)
        findings += diagnosis.of_exposure(capture.dataset, capture.options.seed)
    together = len(capture.dataset.views)
    return f"{len(posed)} of {len(files)} further photographs have a pose, {together} of all together", findings


def given_poses(capture: Capture) -> Outcome:
    """The result of a data set that comes with poses."""
    dataset, findings = capture.dataset, []
    if not dataset.is_dynamic:
        findings = diagnosis.of_poses(dataset, [view.name for view in dataset.views])
        findings += diagnosis.of_exposure(dataset, capture.options.seed)
    return f"{len(dataset.views)} photographs with their poses, as the data set has them", findings


@contextmanager
def _with_findings(capture: Capture) -> Iterator[None]:
    """Append the findings about the photographs to an error's text."""
    try:
        yield
    except ValueError as error:
        reasons = "".join(f"; {finding.line()}" for finding in capture.batch.findings)
        raise ValueError(f"poses: {error}{reasons}") from None


def _progress_on(bar: Bar) -> Callable[[str], None]:
    """Show the progress of mapping."""
    return lambda text: bar.update(bar.done, text=text)


def _views_of_files(capture: Capture, files: list[Path]) -> list[str]:
    """Names of the views of the data set whose photograph is one of the files."""
    named = {path.resolve() for path in files}
    views = capture.dataset.views
    return [view.name for view in views if view.image_path and view.image_path.resolve() in named]


def _links_to(folder: Path, files: list[Path]) -> list[Path]:
    """The links in a folder that lead to one of the files."""
    named = {path.resolve() for path in files}
    return [path for path in folder.iterdir() if path.is_symlink() and path.resolve() in named]
