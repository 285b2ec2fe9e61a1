"""Active views: fit to a few photographs, and choose one more every so often by its information.

The loops of [1]: two views, then one more every 200 steps, or, where things move, all cameras at the first time, then
one camera at each later time (timetable.py). The optimization continues with the present Gaussians.
The camera file gives the poses and image sizes of all candidates. Nothing else of a view is read before it is picked:
not its pixels, mask, depth or size on disk, no points or observations that it took part in; the extent of the scene
and the initial points come from the initial views. (`--init-points all`, the rule of [1], breaks this and says so.)

What is unknown of a photograph besides the scene begins when it joins (`Component.join`); until then it is eliminated
from the information of the view (`drgs.information.complement`).

Reference:
    [1] Next Best View Selections for Semantic and Dynamic 3D Gaussian Splatting, arXiv 2512.22771.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from drgs.cameras.sizes import at_most, resized_alike
from drgs.data.camera_lists import camera_to_json
from drgs.display.progress import Bar
from drgs.ellipsoids import Scene
from drgs.fitting.config import FitConfig
from drgs.fitting.frames import Frame, frames_for
from drgs.fitting.timetable import Timetable
from drgs.information.quantity import opacity_of
from drgs.information.region import NothingOfRegion, RegionText, check_masks, masked_photographs
from drgs.io.journal import SCHEMA
from drgs.io.outputs import write_json
from drgs.io.run import Run
from drgs.sfm.guided import Matches

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drgs.cameras import Camera
    from drgs.data import Semantics, View
    from drgs.features.decoder import Decoder
    from drgs.features.segmentation import Classes
    from drgs.information.choices import Block
    from drgs.information.scoring import Scoring
    from drgs.selection.pool import Pool, Selection, Workers

SELECTION = "selection.json"
_COVERED = 0.5  # opacity from which on a pixel needs no new points: more of it is Gaussians than background
# Share of a view's pixels that are open, below which no new points are sought; chosen, not tuned.
_LEAST_OPEN_SHARE = 0.01
_MOST_DRAWN = 20  # times a view's share of the budget: most points drawn from its depth map; chosen, not tuned
# Triangulated points from which on `--restart auto` keeps the Gaussians; see docs/next-views.md.
_ENOUGH_TRIANGULATED = 1000
_FEWEST_POINTS = 4  # points: each Gaussian's width is of its distances to the three nearest others


class ActiveViews:
    """The training split of an active fit: the views picked so far, and the choice of the next one.

    Attributes:
        active: How views are chosen.
        views: The training split, in its order; files of views that are not picked are not opened.
        timetable: Steps at which views are picked, and among which.
        chosen: Indices of views that may be read, in the order in which they came.
        picks: One record a pick, as in selection.json.
        measured: One record for each number of views at which the held-out views were measured on the way.
        pool_leak: Whether initial points have seen views that were not picked.
    """

    def __init__(
        self,
        views: list[View],
        config: FitConfig,
        moves: bool = False,
        workers: Workers | None = None,
    ) -> None:
        """
        Args:
            views: The training split.
            config: What the fit does; its `selection` says how views are chosen.
            moves: Whether a deformation is fitted.
            workers: Processes that score candidates, as `drgs.select` takes them.
        Raises:
            ValueError: As `Timetable.of`, and if there are no views, or no such policy.
        """
        from drgs.information.criteria import criterion_named
        from drgs.selection.policies import policy_named

        active = config.selection
        if active is None:
            raise ValueError("active: config must have a selection, got none; e.g. SelectionConfig()")
        if not views:
            raise ValueError("active: there must be at least one training view, got none; add photographs")
        self.active = active
        self.views = list(views)
        self._config = config
        self._workers = workers
        policy_named(active.policy)  # now, not at the first pick
        criterion_named(active.scoring.criterion, "--criterion")
        self.timetable = Timetable.of(self.views, config, moves)
        first = len(self.timetable.start)
        last = len(self.timetable.start) + self.timetable.add - 1
        for count in active.measure:
            if not first <= count <= last:
                raise ValueError(
                    f"active: --measure must be numbers of views that one more is added to, {first} to {last}, got "
                    f"{count}; drop it (with all views the end of the fit is measured)"
                )
        self.chosen = list(self.timetable.start)
        self.picks = list[dict]()
        self.measured = list[dict]()
        self.pool_leak = config.data.init_points == "all"
        # Photographs of another time do not say where things are at this one.
        wanted = not self.pool_leak and self.timetable.schedule == "views"
        grows = {"auto": wanted, "uncovered": True, "none": False}[active.pick_points]
        self._share = config.density.max_gaussians // (len(self.chosen) + self.timetable.add) if grows else 0
        self._generator = torch.Generator().manual_seed(config.seed)
        self._matches = Matches()
        self._began: int | None = None  # triangulated points of the start, once they are known
        self._sizes: dict[tuple[int, int], tuple[int, int]] = {}

    def check_blocks(self, lacking: Mapping[Block, str]) -> None:
        """Raise ValueError for blocks that the fit does not have, before its first step and not at the first pick.

        Args:
            lacking: Blocks of information that there are not, and what the fit is without them, in words.
        """
        for name in self.active.scoring.blocks or () if self.active.policy == "fisher" else ():
            if name in lacking:
                raise ValueError(
                    f"active: blocks must be of what is fitted, got {name} for {lacking[name]}; use geometry"
                )

    def check_region(self, semantics: Semantics | None) -> None:
        """Raise ValueError for a region that there is not, before the first step and not at the first pick.

        Args:
            semantics: Those of the data set; None where it has none, or they are not fitted.
        """
        from drgs.selection.policies import check_region

        if self.active.region is None:
            return
        check_region(self.active.region, self.active.policy)
        text = RegionText.of(self.active.region, "active")
        if text.kind == "masks":  # those of the start are read now, to say before the fit what is wrong with them
            check_masks(Path(text.name), self.views, "active")
            with contextlib.suppress(NothingOfRegion):
                start = [self.views[i] for i in self.timetable.start]
                masked_photographs(Path(text.name), start, [view.camera for view in start], "active")
            return
        # Without a file of classes they would be the numbers in label images of all views.
        is_named = semantics is not None and (semantics.class_file or semantics.embedding_file)
        classes = semantics.classes if semantics is not None and is_named and text.kind == "class" else None
        region = text.region(lambda folder: ([], []), lambda: (classes, None), where="active")
        if not region.is_crossed([self._camera(i) for i in range(len(self.views))]):
            raise ValueError(
                f"active: region {text} must be in sight of a photograph, no camera of {len(self.views)} looks at it; "
                "give it in the world coordinates of the data set"
            )

    @property
    def scoring(self) -> Scoring:
        """How candidates are scored, by the selection alone."""
        return dataclasses.replace(self.active.scoring, settings=self._config.settings)

    @property
    def names(self) -> list[str]:
        """Names of the views that have been seen, in the order of `chosen`."""
        return [self.views[i].name for i in self.chosen]

    def start_views(self) -> list[View]:
        """The views that initial points may be made from, checked against their images."""
        views = self.views if self.pool_leak else [self.views[i] for i in self.chosen[: len(self.timetable.start)]]
        return [view.checked() for view in views]

    @property
    def reserved(self) -> int:
        """How many Gaussians density control leaves room for: the shares of the views that are still to be picked."""
        return self._share * (self.timetable.add - len(self.picks))

    def points(self, frame: Frame, scene: Scene) -> tuple[torch.Tensor, torch.Tensor, bool]:
        """Points for new Gaussians from the view that was picked last.

        Those that can be triangulated with it, and guesses beside these where the scene leaves its pixels more than
        half transparent. Of a view with a depth map: points of the map, there only.

        Args:
            frame: Its photograph.
            scene: Scene at this step, seen at the time of the view.
        Returns:
            (P, 3) points and (P, 3) colors, at most an even share of the budget, and whether they are of a depth map.
        """
        from drgs.sfm.points import added_points, initial_points

        nothing = torch.empty(0, 3), torch.empty(0, 3), False
        if not self._share:
            return nothing
        is_open = opacity_of(scene, frame.camera, self._config.settings).numpy() < _COVERED
        if frame.mask is not None:
            is_open &= frame.mask.numpy() > _COVERED
        if (empty := frame.empty()) is not None:
            is_open &= empty.numpy() < 1 - _COVERED
        worth = is_open.mean() >= _LEAST_OPEN_SHARE
        seen = [self.views[i] for i in self.chosen]
        dense = seen[-1].depth_path is not None
        if dense and not worth:
            return nothing
        seed = self._config.seed + len(self.picks)
        with Bar("points of the new view") as bar:
            if dense:
                wanted = min(math.ceil(self._share / is_open.mean()), _MOST_DRAWN * self._share)
                points, colors, _ = initial_points(seen[-1:], seed, wanted, bar.stage)
                found = 0
            else:
                points, colors, found = added_points(seen, seed, self._matches, bar.stage)
        pixels, depth = frame.camera.project(points)
        inside = frame.camera.contains(pixels, depth)
        # What is triangulated goes in where Gaussians are, too: it knows where things are, and they may have begun at
        # random.
        guessed = np.flatnonzero(inside[found:]) + found
        columns, rows = pixels[guessed].astype(int).T
        guessed = guessed[is_open[rows, columns]] if worth else guessed[:0]
        sure = np.random.default_rng(seed).permutation(np.flatnonzero(inside[:found]))
        kept = np.concatenate([sure, guessed])[: self._share]
        if len(kept) < _FEWEST_POINTS:
            return nothing
        return torch.from_numpy(points[kept]), torch.from_numpy(colors[kept]), dense

    def compared_points(self, given: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """Points by which the photographs seen so far are compared: of the data set, if the fit begins with these, of
        depth maps, or those that are triangulated with the photographs.

        Args:
            given: (P, 3) points of the data set; None where it has none, or they are not read.
        Returns:
            (P, 3) points and, of those that are triangulated, which of the V photographs show which, (V, P) bool; else
            None.
        """
        from drgs.sfm.points import initial_points, matched_points

        if self.pool_leak and given is not None:
            return given, None
        seen = [self.views[i] for i in self.chosen]
        with Bar("points of all views") as bar:
            if any(view.depth_path is not None for view in seen):
                most = self._config.density.max_gaussians
                return initial_points(seen, self._config.seed, most, bar.stage)[0], None
            if len(seen) < 2:
                return np.empty((0, 3)), None
            self._count_start(bar)  # before there are more pictures
            return matched_points(seen, self._matches, bar.stage)

    def _count_start(self, bar: Bar) -> int:
        """Number of points triangulated from the initial views alone; matches are kept."""
        from drgs.sfm.points import triangulated_count

        if self._began is None:
            start = [self.views[i] for i in self.chosen[: len(self.timetable.start)]]
            self._began = triangulated_count(start, self._matches, bar.stage) if len(start) > 1 else 0
        return self._began

    def new_start(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """(P, 3) points and (P, 3) colors to begin the fit again with, as all views seen so far show them together;
        None where the Gaussians are kept.

        What a few photographs put at wrong depths stays there: it explains these, and hides what comes later. But to
        begin again loses what was learned. So `auto` does it until a start has had enough triangulated points.
        """
        from drgs.sfm.points import triangulated_count, triangulated_points

        seen = [self.views[i] for i in self.chosen]
        restart = self.active.restart
        dense = any(view.depth_path is not None for view in seen)
        if restart == "never" or not self._share or dense:
            return None
        seed = self._config.seed + len(self.picks)
        room = self._config.density.max_gaussians - self.reserved
        last = next((pick["triangulated"] for pick in reversed(self.picks) if pick.get("restarted")), None)
        with Bar("points of all views") as bar:
            began = self._count_start(bar) if last is None else last
            if restart == "auto" and began >= _ENOUGH_TRIANGULATED:  # the Gaussians are kept, and the points not needed
                found = triangulated_count(seen, self._matches, bar.stage)
                self.picks[-1] |= {"triangulated": found, "restarted": False}
                return None
            points, colors, found = triangulated_points(seen, seed, room, self._matches, bar.stage)
        again = len(points) > 0
        self.picks[-1] |= {"triangulated": found, "restarted": again}
        return (torch.from_numpy(points), torch.from_numpy(colors)) if again else None

    def frames(self) -> list[Frame]:
        """The photographs seen so far."""
        return [self._read(i) for i in self.chosen]

    def is_due(self, step: int) -> bool:
        """Whether a view is to be added before step `step` (from 0)."""
        return len(self.picks) < self.timetable.due(step)

    @property
    def is_to_be_measured(self) -> bool:
        """Whether the held-out views are wanted now, before the next pick."""
        count = len(self.chosen)
        return count in self.active.measure and all(record["views"] != count for record in self.measured)

    def add_measured(self, step: int, result: dict) -> None:
        """Record the means of `drgs.fitting.metrics.evaluate`.

        Args:
            step: Steps done.
            result: Metrics that it returned.
        """
        labels = (result.get("segmentation") or {}).get("run") or {}
        record = {"views": len(self.chosen), "step": step, "mean": result["mean"], "median": result["median"]}
        numbers = {name: x for name, x in labels.items() if isinstance(x, float)}
        self.measured.append(record | ({"segmentation": {"run": numbers}} if numbers else {}))

    def pick(
        self,
        scene: Scene,
        frames: list[Frame],
        step: int,
        scoring: Scoring | None = None,
        labels: tuple[Classes | None, Decoder | None] = (None, None),
    ) -> tuple[Frame, dict]:
        """Choose one more view, then read it.

        Args:
            scene: Scene at this step, seen by each view at its time.
            frames: The photographs seen so far; of these, too, only the cameras matter, and the masks.
            step: Steps done.
            scoring: How candidates are scored, as components of the fit have completed it; default `scoring`.
            labels: Classes and decoder of the scene's features, where it has some.
        Returns:
            The photograph, and the record that was appended to `picks`.
        """
        from drgs.information.inputs import mask_list
        from drgs.selection.pool import Pool

        began = time.perf_counter()
        active = self.active
        left = self.timetable.left(len(self.picks), self.chosen)
        pixels = active.info_pixels or self._config.data.max_pixels
        scoring = scoring or self.scoring
        seen = [at_most(frame.camera, pixels) for frame in frames]
        with Bar("choosing a view", len(left) + len(frames)) as bar:
            masks = [_reduced(frame.mask, camera) for frame, camera in zip(frames, seen, strict=True)]
            pool = Pool(
                scene=scene,
                candidates=[at_most(self._camera(i), pixels) for i in left],
                train=seen,
                k=1,
                scoring=scoring,
                rng=self._generator,
                masks=mask_list("select", masks, seen),
                empty_outside=all(frame.is_object for frame in frames if frame.mask is not None),
                progress=bar.update,
                workers=self._workers,
            )
            selection = self._chosen(pool, labels)
        index = left[selection.picks[0].index]
        views = [{"index": i, "name": self.views[i].name, **self._where(i)} for i in left]
        record = {
            "number": len(self.picks) + 1,
            "step": step,
            **selection.picks_json(views)[0],
            "seconds": time.perf_counter() - began,
            "policy": active.policy,
            "criterion": scoring.criterion if active.policy == "fisher" else None,
            "prior": selection.prior_json(scoring, active.policy),
            **selection.blocks_json(),
            **(scoring.nuisances.if_any() if active.policy == "fisher" else {}),
            "gaussians": len(scene.at(frames[0].camera.time)),
            "left_out": selection.left_out,
            "notes": selection.notes,
            "candidates": selection.candidates_json(views, no_parts={}),
        }
        self.chosen.append(index)
        self.picks.append(record)
        return self._read(index), record

    def _chosen(self, pool: Pool, labels: tuple[Classes | None, Decoder | None]) -> Selection:
        """The choice of the policy, by the region as far as something is known of it yet."""
        from drgs.selection.policies import choose

        if self.active.region is None:
            return choose(self.active.policy, pool)

        def photographs(folder: Path) -> tuple[list[torch.Tensor], list[Camera]]:
            return masked_photographs(folder, [self.views[i] for i in self.chosen], list(pool.train), "active")

        text = RegionText.of(self.active.region, "active")
        try:
            region = text.region(photographs, lambda: labels, pool.scoring.settings, "active")
            return choose(self.active.policy, dataclasses.replace(pool, region=region))
        except NothingOfRegion:
            selection = choose(self.active.policy, pool)
            selection.notes.append(f"region {text}: nothing of it is known yet; at this pick the whole scene counts")
            return selection

    def to_json(self) -> dict:
        """Contents of selection.json."""
        initial = self.chosen[: len(self.timetable.start)]
        return {
            "schema": SCHEMA,
            "command": "fit",
            **self._resolved(self.active.flat()),
            "start_rule": self.active.start,  # `start` are the views
            "seed": self._config.seed,
            "init_points": "all" if self.pool_leak else "views",
            "pool_leak": self.pool_leak,
            "pool": [view.name for view in self.views],
            "start": [{"index": i, "name": self.views[i].name, **self._where(i)} for i in initial],
            "cameras": [camera_to_json(self._camera(i)) for i in self.chosen],
            "picks": self.picks,
            "measured": self.measured,
        }

    def write(self, run: Run) -> None:
        """Write selection.json, atomically."""
        write_json(run.path / SELECTION, self.to_json())

    def state(self) -> tuple[dict[str, torch.Tensor], dict]:
        """Tensors and header that a checkpoint adds to the trainer's."""
        # Nothing that the clock says: two fits to the same bits have the same checkpoint.
        picks = [{name: x for name, x in pick.items() if name != "seconds"} for pick in self.picks]
        header = {"pool": [view.name for view in self.views], "picks": picks}
        header |= {"measured": self.measured}
        return {"policy_rng": self._generator.get_state()}, {"active": header}

    def restore(self, tensors: dict[str, torch.Tensor], header: dict, where: str) -> None:
        """Continue from a checkpoint.

        Raises:
            ValueError: If the checkpoint chose by another rule, or from other views.
        """
        old = header["active"]
        selection = FitConfig.from_json(header["config"]).selection
        assert selection is not None
        new = self._resolved(self.active.flat())
        was = self._resolved(selection.flat())
        for key in new:
            if new[key] != was[key]:
                raise ValueError(
                    f"{where}: --resume must continue the same fit, {key} was {was[key]!r} and is "
                    f"{new[key]!r}; repeat the options or choose another run folder"
                )
        if old["pool"] != [view.name for view in self.views]:
            raise ValueError(
                f"{where}: --resume must have the same training views, the data set, --test-every or --test-offset has "
                "changed; repeat the options or choose another folder"
            )
        self.picks = old["picks"]
        self.measured = old.get("measured", [])
        self.chosen = self.chosen[: len(self.timetable.start)] + [pick["index"] for pick in self.picks]
        self._generator.set_state(tensors["policy_rng"])

    def _resolved(self, config: dict) -> dict:
        """The configuration with this fit's schedule and numbers in place of those that it leaves to the data set."""
        timetable = self.timetable
        filled: dict = {"add": timetable.add, "every": timetable.every}
        filled = {name: x for name, x in filled.items() if config[name] is None}
        if config["schedule"] == "auto":
            filled["schedule"] = timetable.schedule
        if timetable.schedule != "views":
            filled["initial"] = len(timetable.start)
        return {**config, **filled}

    def _where(self, index: int) -> dict:
        """Camera and time of a view, where these are what is picked."""
        if self.timetable.schedule == "views":
            return {}
        view = self.views[index]
        return {"camera": view.camera_name, "time": view.camera.time}

    def _read(self, index: int) -> Frame:
        """Open a view's files, for the first time if it has just been picked."""
        stated = self.views[index].camera
        self.views[index] = view = self.views[index].checked()
        self._sizes[stated.width, stated.height] = view.camera.width, view.camera.height
        return frames_for([view], self._config.data)[0]

    def _camera(self, index: int) -> Camera:
        """The camera of a candidate, as its frame would have it."""
        view = self.views[index]
        camera = dataclasses.replace(view.camera.undistorted(), name=view.name)
        if not view.is_checked:
            camera = resized_alike(camera, self._sizes)
        return at_most(camera, self._config.data.max_pixels)


def _reduced(mask: torch.Tensor | None, camera: Camera) -> torch.Tensor | None:
    """A mask at the size of a camera's image."""
    if mask is None or tuple(mask.shape) == (camera.height, camera.width):
        return mask
    return torch.nn.functional.interpolate(mask[None, None], (camera.height, camera.width), mode="area")[0, 0]
