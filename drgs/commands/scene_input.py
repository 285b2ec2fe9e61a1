"""The scene of a command: a file of Gaussians, or a run with the record of its fit."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.codecs import load_gaussians, readable
from drgs.codecs.folders import cameras_of_model, file_of_folder
from drgs.commands.frames import in_frame_of_data
from drgs.data.camera_lists import is_camera_list
from drgs.fitting.records import FitRecord, fit_record, is_run, load_run
from drgs.io.checkpoint import state_header
from drgs.io.foreign import refuse_foreign
from drgs.io.run import Run
from drgs.settings import RenderSettings
from drgs.viewing.placed_views import NEXT, Ranking, read_ranking

if TYPE_CHECKING:
    from drgs.commands.options import Crossval, Fisher, Prune, Query, Render, Select, Share, Tradeoff, View
    from drgs.ellipsoids import Gaussians, Scene
    from drgs.features.decoder import Decoder
    from drgs.features.segmentation import Classes
    from drgs.information.nuisances import Nuisance
    from drgs.information.scoring import Scoring
    from drgs.information.semantics import SemanticMetric

    # They have options that name a data set.
    _Placed = Crossval | Fisher | Prune | Query | Render | Select | Share | Tradeoff | View

SELECTION = "selection.json"
"""File of a run that chose its views: their scores."""


@dataclasses.dataclass(frozen=True)
class SceneInput:
    """Gaussians, and the run that they are of.

    Attributes:
        gaussians: Gaussians of the file, or of the run's last checkpoint.
        run: The run folder; None for a file.
        record: How the run was fitted; None for a file.
        step: How many steps of the fit its checkpoint has; None for a file, and where only the PLY could be read.
        fields: Render settings that hold whatever the preset is: what --set says, over the background of the fit. A
            run was fitted over its background; over another one its edges show a halo.
        decoder, classes: What turns features into those of the teacher, and the classes, of a run that was fitted with
            semantics; else None.
        moving: The Gaussians and what moves them; None where nothing does.
    """

    gaussians: Gaussians
    run: Run | None = None
    record: FitRecord | None = None
    step: int | None = None
    fields: dict[str, Any] = dataclasses.field(default_factory=dict)
    decoder: Decoder | None = None
    classes: Classes | None = None
    moving: Scene | None = None

    @classmethod
    def of(cls, args: Crossval | Fisher | Prune | Query | Render | Select | Tradeoff | View) -> SceneInput:
        """The scene that the command line names.

        Raises:
            FileNotFoundError: If there is no such file, or the run has no checkpoint yet.
            ValueError: If --set is wrong or a file damaged.
        """
        replaced = args.replaced()
        given = cls.at(args.scene).in_frame_of(args)
        fitted = {} if given.record is None else {"background": given.record.config.settings.background}
        return dataclasses.replace(given, fields=fitted | replaced)

    @classmethod
    def at(cls, path: Path) -> SceneInput:
        """The scene of a file of Gaussians, a folder of them (SOG, INRIA's) or a run folder.

        Raises:
            FileNotFoundError: If there is no such file, a folder is no run's, or the run has no checkpoint yet.
            ValueError: If a file is damaged, or of a format that is not read.
        """
        if not path.is_dir():
            return cls(load_gaussians(path))
        if not is_run(path):
            if file_of_folder(path) is not None:
                return cls(load_gaussians(path))
            raise FileNotFoundError(
                f"{path}: must be a run folder, found no config.json of a fit; run `drgs fit` first, or name "
                f"{readable()}"
            )
        run = Run(path)
        loaded = load_run(run)
        scene = loaded.scene
        moving = None if scene is loaded.gaussians else scene
        known = {"step": loaded.step, "decoder": loaded.decoder, "classes": loaded.classes, "moving": moving}
        return cls(loaded.gaussians, run, loaded.record, **known)

    def in_frame_of(self, args: _Placed) -> SceneInput:
        """With Gaussians of a file in the frame of the data set that an option names, if one does."""
        if self.run is not None or (data := _data_of(args)) is None:
            return self
        return dataclasses.replace(self, gaussians=in_frame_of_data(self.gaussians, args.scene, data))

    def settings(self, preset: str) -> RenderSettings:
        """The render settings of a preset over the background of the fit."""
        return RenderSettings.preset(preset, **self.fields)

    def over_background(self, settings: RenderSettings) -> RenderSettings:
        """Settings of --preset and --set (`args.settings()`), over the background of the fit unless --set has one."""
        return settings if settings.background == self.background else settings.replace(background=self.background)

    def scoring(self, scoring: Scoring, settings: RenderSettings) -> Scoring:
        """A scoring for views of it: rendered with these settings, features in the metric of its decoder, and without
        the unknowns that its fit has estimated, unless the scoring says which are eliminated.
        """
        scoring = dataclasses.replace(scoring, settings=settings, semantics=self.semantics())
        return scoring.over(self.estimated)

    def semantics(self) -> SemanticMetric | None:
        """The metric of its decoder, for features in information about geometry; None without a decoder."""
        from drgs.information.semantics import SemanticMetric  # not for those that ask for no information

        return None if self.decoder is None else SemanticMetric(self.decoder.metric())

    def keeps_lenses(self, undistort: str = "auto") -> bool:
        """Whether cameras keep their lenses: what --undistort says, else as the run was fitted, else not."""
        if undistort == "auto" and self.record is not None:
            undistort = self.record.config.data.undistort
        return undistort == "off"

    @property
    def estimated(self) -> tuple[Nuisance, ...]:
        """Unknowns of the photographs that the run has estimated."""
        return () if self.record is None else self.record.estimated

    @property
    def far(self) -> int:
        """How many of the first Gaussians are a run's skybox."""
        return 0 if self.run is None or self.step is None else state_header(self.run.state).get("skybox", 0)

    @property
    def scene(self) -> Scene:
        """The scene that is rendered: Gaussians, or a `DynamicGaussians`."""
        return self.moving or self.gaussians

    @property
    def colors(self) -> Gaussians:
        """The Gaussians without their features, for renderings of colors alone."""
        return self.gaussians.replace(features=None)

    @property
    def background(self) -> tuple[float, float, float]:
        """Background color of the run, for every preset."""
        return tuple(self.fields.get("background", RenderSettings.background))


def _data_of(args: _Placed) -> Path | None:
    """The data set that an option names, itself or by a run on it; None where there are only lists and orbits."""
    for text in (getattr(args, name, None) for name in ("train", "data", "cameras", "candidates")):
        if text is None or text in ("orbit", "dome"):
            continue
        path = Path(text)
        if is_run(path):
            return fit_record(Run(path)).data
        if cameras_of_model(path) is None and not is_camera_list(path):
            return path
    return None


def ranking_of(selection: Path | None, given: SceneInput) -> Ranking | None:
    """Scores of cameras: those of a file, else of a run that chose its views, or places of its next photographs.

    Args:
        selection: What `--selection` names.
        given: The command's scene.
    Raises:
        FileNotFoundError, ValueError: If a file is not there, or damaged.
    """
    if selection is not None:
        refuse_foreign(selection, "a selection")
        return read_ranking(selection)
    if given.record is None or given.run is None:
        return None
    path = given.run.path / (SELECTION if given.record.is_active else NEXT)
    return read_ranking(path) if path.is_file() else None
