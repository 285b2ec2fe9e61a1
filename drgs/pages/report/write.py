"""Make and write the report page of a run."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from drgs.cameras import Camera
from drgs.cameras.sizes import at_most
from drgs.data import Dataset, View
from drgs.data.camera_lists import camera_from_json
from drgs.display.progress import Bar
from drgs.fitting.errors import run_error_record
from drgs.fitting.records import LoadedRun, load_run
from drgs.io.outputs import write_whole
from drgs.io.run import Run
from drgs.pages.report import charts, pictures
from drgs.pages.report.account import Account, account_of
from drgs.pages.report.page import Drawings, page_html

FILE = "report.html"
_SHOWN_VIEWS = 4  # views that are shown with pictures; chosen for the size of the page
_MOST_RESIDUALS = 24  # photographs whose residuals stand for those of all, at most; chosen for its seconds


def write_report(run: Run, path: Path, command: str, command_text: str, dataset: Dataset | None) -> None:
    """Write the page of a run, atomically.

    Args:
        run: Folder of a fit that is done or is not.
        path: HTML file to write.
        command: Command that repeats the fit, for the page.
        command_text: What that command leaves out, for the page.
        dataset: Data set that was fitted, for its cameras and times; None where it is no longer there, which the page
            says.
    Raises:
        FileNotFoundError: If it is no run folder.
        ValueError: If one of its files is damaged.
    """
    with Bar("report"):
        account = account_of(run)
        page = page_html(account, _pictures_and_charts(account, dataset), command, command_text)
        write_whole(path, page.encode())


def _pictures_and_charts(account: Account, dataset: Dataset | None) -> Drawings:
    """Everything that can be drawn."""
    notes = []
    try:
        loaded = load_run(account.run)
    except FileNotFoundError:
        loaded = None
        notes.append("The fit has not reached its first checkpoint: nothing of it can be drawn yet.")
    if dataset is None:
        notes.append(
            f"The data set is not at {account.record.data} any more: no map of cameras, of information or over time."
        )
    names = _typical_views(account)
    run_cameras = None if dataset is None else _Cameras.of(account, dataset)
    found: dict[str, tuple[pictures.Picture, pictures.Picture]] = {}
    stills: list[pictures.Picture] = []
    still_name = ""
    if loaded is not None and run_cameras is not None:
        shown = {name: run_cameras.held[name] for name in names if name in run_cameras.held}
        try:
            if shown:
                settings = account.record.config.settings
                record = run_error_record(account.run, settings, most=_MOST_RESIDUALS, dataset=dataset)
                found = pictures.maps(loaded.scene, shown, record)
        except (OSError, ValueError) as error:
            notes.append(f"No maps of the expected error: {error}.")
        stills, still_name = _stills(account, loaded, run_cameras)
    picks = account.selection["picks"] if account.selection else []
    drawn: dict[str, str | None] = {}
    if charts.is_available():
        drawn = {"progress": charts.progress(account), "scores": charts.score_bars(picks)}
        drawn["cameras"] = (
            None
            if run_cameras is None
            else charts.camera_map(run_cameras.groups, run_cameras.picked, _marks_of_cameras(account))
        )
    return Drawings(
        charts=drawn,
        previews=pictures.previews(account),
        views=names,
        photos=pictures.view_pictures(account, names, "png"),
        semantics=pictures.view_pictures(account, names, "semantics.png") if account.record.semantics else {},
        maps=found,
        stills=stills,
        stills_of=still_name,
        notes=notes,
    )


def _marks_of_cameras(account: Account) -> list[tuple[Camera, np.ndarray, str]]:
    """Argument `ways` of `charts.camera_map`: the places for the next photographs."""
    where = str(account.run.path / "next.json")
    found = [(camera_from_json(where, place["camera"]), np.array(place["origin"], float)) for place in account.places]
    if odd := [origin for _, origin in found if origin.shape != (3,)]:
        raise ValueError(f"{where}: origin must be 3 numbers, got {len(odd[0])}; run `drgs capture --more` again")
    return [(*pair, str(place["rank"])) for pair, place in zip(found, account.places, strict=True)]


def _typical_views(account: Account) -> list[str]:
    """Names of a few measured views, from the worst to the best."""
    rows = [] if account.metrics is None else account.metrics["views"]
    ranked = sorted(rows, key=lambda row: row["psnr"] if row.get("psnr") is not None else float("inf"))
    return [row["name"] for row in pictures.spread(ranked, _SHOWN_VIEWS)]


def _stills(account: Account, loaded: LoadedRun, run_cameras: _Cameras) -> tuple[list[pictures.Picture], str]:
    """One camera over all times, of a scene that moves."""
    if loaded.moving is None or not account.record.times:
        return [], ""
    name, camera = next(iter(run_cameras.held.items()), ("", None))
    if camera is None:
        return [], ""
    return pictures.stills(loaded.scene, camera, account.record.times, account.record.config.settings), name


@dataclasses.dataclass(frozen=True)
class _Cameras:
    """The cameras of a fit.

    Attributes:
        fitted: Cameras whose photographs the fit has seen.
        held: Name -> camera of each measured view.
        groups, picked: Arguments of `charts.camera_map`.
    """

    fitted: list[Camera]
    held: dict[str, Camera]
    groups: dict[str, list[Camera]]
    picked: list[tuple[Camera, str]]

    @classmethod
    def of(cls, account: Account, dataset: Dataset) -> _Cameras:
        """The cameras of a data set, by the split of the fit."""
        config = account.record.config
        train, test = dataset.split(config.data.test_every, config.data.test_offset, config.data.test_cameras)

        def camera(view: View) -> Camera:
            shown = dataclasses.replace(view, keeps_lens=config.data.undistort == "off").shown_camera
            return at_most(dataclasses.replace(shown, name=view.name), config.data.max_pixels)

        cameras = {view.name: camera(view) for view in train}
        tested = {view.name: camera(view) for view in test}
        measured = account.metrics["split"] if account.metrics else "test"
        held = {"test": tested, "train": cameras}.get(measured, cameras | tested)
        if account.selection is None:
            fitted = [cameras[name] for name in account.record.train if name in cameras]
            return cls(fitted, held, {"fitted": fitted, "held out": list(tested.values())}, [])
        start = [view["name"] for view in account.selection["start"]]
        numbers: dict[str, list[str]] = {}
        for pick in account.selection["picks"]:
            numbers.setdefault(pick["name"], []).append(str(pick["number"]))
        seen = [name for name in (*start, *numbers) if name in cameras]
        groups = {
            "not picked": [x for name, x in cameras.items() if name not in seen],
            "held out": list(tested.values()),
            "start": [cameras[name] for name in start if name in cameras],
        }
        picked = [(cameras[name], ", ".join(found)) for name, found in numbers.items() if name in cameras]
        return cls([cameras[name] for name in seen], held, groups, picked)
