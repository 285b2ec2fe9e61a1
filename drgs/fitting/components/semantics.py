"""Features of Gaussians and their decoder, fitted to the maps of a teacher beside the colors, as Feature 3DGS does.

The features of a Gaussian begin at 0, the decoder as torch makes it: where all features are 0 the decoder's weights
have no gradient yet, but its bias and the features have, and once these have moved the weights follow.

What is outside a mask has no say, of whichever kind the mask is: a teacher has features for the surroundings of an
object, too, and where nothing is drawn the decoder could answer them by its bias alone.

`semantics` in config.json and in the checkpoint's header says what was fitted; `text_embeddings.npy` in the run folder
holds the embeddings of the classes, (K, C) float32 in NumPy's format, in the order of their names: so a run needs no
data set to be asked about them.

Reference:
    [1] Zhou et al., "Feature 3DGS: Supercharging 3D Gaussian Splatting to Enable Distilled Feature Fields", CVPR 2024;
        orders and rates as in its code.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from drgs.fitting.components.base import Checkpoint, Component, Conflict, Fit, Setup
from drgs.fitting.networks import Network
from drgs.integrator import Output, render
from drgs.io.json_files import check_json
from drgs.io.outputs import atomic_write

if TYPE_CHECKING:
    from drgs.data import Dataset, Semantics, View
    from drgs.ellipsoids import Gaussians
    from drgs.features.decoder import Decoder
    from drgs.features.segmentation import Classes
    from drgs.fitting.config import FeatureSize, FitConfig
    from drgs.fitting.frames import Frame
    from drgs.information.scoring import Scoring
    from drgs.settings import RenderSettings

EMBEDDINGS = "text_embeddings.npy"
"""File of a run with the text embeddings of its classes."""
_KIND = {
    "teacher": str,
    "labels": str,
    "channels": int,
    "width": int,
    "map_size": [int],
    "classes": (None, [str]),
    "embeddings": bool,
}
_ADVICE = "restore the file, or fit again in another folder"

_INSIDE = 0.5  # share of a cell of the teacher's map that the mask must keep
_CHUNK = 1 << 22  # decoded numbers at a time: 16 MB, where a map of 512x360x480 has 354 MB


@dataclasses.dataclass(frozen=True)
class SemanticRecord:
    """What the features of a run were fitted to.

    Attributes:
        teacher: Name of the folder with the teacher's maps.
        labels: Name of the folder with the data set's own labels; empty without.
        channels: C, of the maps.
        width: D, features a Gaussian.
        map_size: (w, h) of the maps.
        classes: Names of classes 1..K, or None.
        embeddings: Whether the run has text embeddings of the classes.
    """

    teacher: str
    labels: str
    channels: int
    width: int
    map_size: tuple[int, int]
    classes: tuple[str, ...] | None
    embeddings: bool

    @classmethod
    def of(cls, dataset: Dataset, config: FitConfig, views: Sequence[View]) -> SemanticRecord | None:
        """What a fit of a data set with a config would record; None where it fits no features.

        Args:
            dataset: Data set that was loaded.
            config: Configuration of the fit.
            views: Those that may be read at the start: no other's map is opened, as long as one of them has a map,
                and never that of a held-out view.
        """
        known = dataset.semantics if config.features.semantics == "auto" else None
        if known is None or not known.maps:
            return None
        train, _ = dataset.split(config.data.test_every, config.data.test_offset, config.data.test_cameras)
        path = next((view.teacher_path for view in (*views, *train) if view.teacher_path is not None), None)
        if path is None:  # maps of held-out views alone teach nothing
            return None
        from drgs.features.teacher import read_map

        channels, height, width = read_map(path).shape
        # Without either file, classes would be the numbers that are found in all label images, of any view.
        classes = known.classes if known.class_file or known.embedding_file else None
        return cls(
            known.teacher,
            known.labels,
            channels,
            config.features.feature_width,
            (width, height),
            None if classes is None else classes.names,
            classes is not None and classes.embeddings is not None,
        )

    @classmethod
    def from_json(cls, value: Any, where: str) -> SemanticRecord | None:
        """The inverse of `to_json`; None where there is none.

        Raises:
            ValueError: If a field is missing or of another type, or a number is out of range.
        """
        if value is None:
            return None
        check_json(where, value, _KIND, _ADVICE)
        size, names = value["map_size"], value["classes"]
        if len(size) != 2 or min(value["channels"], value["width"], *size) < 1:
            raise ValueError(
                f"{where}: channels, width and the two numbers of map_size must be >= 1, got {value['channels']}, "
                f"{value['width']} and {size}; {_ADVICE}"
            )
        if names is not None and not (names and all(names)):
            raise ValueError(f"{where}: classes must be names, or null, got {names}; {_ADVICE}")
        fields = {name: value[name] for name in _KIND}
        return cls(**{**fields, "map_size": tuple(size), "classes": None if names is None else tuple(names)})

    def to_json(self) -> dict:
        """As config.json and the checkpoint's header hold it."""
        names = None if self.classes is None else list(self.classes)
        return {**dataclasses.asdict(self), "map_size": list(self.map_size), "classes": names}

    def write_embeddings(self, run: Path, semantics: Semantics | None) -> None:
        """Write `EMBEDDINGS` of a data set into a run folder, atomically, if there are any; no label image is read."""
        classes = semantics.classes if self.embeddings and semantics is not None else None
        if classes is None or classes.embeddings is None:
            return
        with atomic_write(run / EMBEDDINGS) as file:
            np.save(file, classes.embeddings.numpy(), allow_pickle=False)

    def read_classes(self, run: Path) -> Classes | None:
        """The classes, with their embeddings from the run folder.

        Raises:
            FileNotFoundError: If the embeddings are missing.
            ValueError: If they are damaged, or not those of these classes and channels.
        """
        import torch

        from drgs.data.checks import read_npy
        from drgs.features.segmentation import Classes

        if self.classes is None:
            return None
        if not self.embeddings:
            return Classes(self.classes)
        path = run / EMBEDDINGS
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: must hold the text embeddings of the run's classes, found none; {_ADVICE}"
            )
        array = read_npy(path)
        if array.shape != (len(self.classes), self.channels) or array.dtype != np.float32:
            raise ValueError(
                f"{path}: must be float32 of shape {(len(self.classes), self.channels)}, a row for each class, got "
                f"{array.dtype} of shape {array.shape}; {_ADVICE}"
            )
        try:
            return Classes(self.classes, torch.from_numpy(np.ascontiguousarray(array)))
        except ValueError as error:
            raise ValueError(f"{path}: {error}; {_ADVICE}") from None

    def decoder(self, networks: dict[str, dict[str, torch.Tensor]], gaussians: Gaussians, where: str) -> Decoder:
        """The fitted decoder.

        Args:
            networks: Networks that `drgs.fitting.networks.saved_networks` finds in a checkpoint.
            gaussians: Gaussians of the same checkpoint.
            where: It, for the message.
        Raises:
            ValueError: If there is none, or it does not go with the Gaussians' features or the teacher's channels.
        """
        from drgs.features.decoder import Decoder

        if "decoder" not in networks:
            raise ValueError(f"{where}: network 'decoder' must be there, as config.json says, found none; {_ADVICE}")
        decoder = Decoder.of_state(networks["decoder"], where)
        features = 0 if gaussians.features is None else gaussians.features.shape[1]
        if not (decoder.width == self.width == features and decoder.channels == self.channels):
            raise ValueError(
                f"{where}: the decoder must take {self.width} features to {self.channels} channels, as config.json "
                f"says, got one from {decoder.width} to {decoder.channels} for Gaussians with {features}; {_ADVICE}"
            )
        return decoder


def check_same_teacher(now: SemanticRecord | None, was: SemanticRecord | None, where: str) -> None:
    """Refuse to go on with another teacher, or with other classes, than a fit began with.

    Args:
        now: Record of the data set and the config; None where no features are fitted.
        was: Record of the checkpoint.
        where: It, for the message.
    Raises:
        ValueError: On the first field that differs.
    """
    new, old = ({} if record is None else record.to_json() for record in (now, was))
    for name in new | old:
        if new.get(name) != old.get(name):
            raise ValueError(
                f"{where}: --resume must continue the same fit, {name} of its semantics was {old.get(name)!r} and is "
                f"{new.get(name)!r}; repeat the options, restore the data set or choose another run folder"
            )


@dataclasses.dataclass(frozen=True)
class FeatureDistance:
    """gamma times the mean L1 distance between decoded features and the teacher's map, over channels and cells.

    Attributes:
        decoder: Map from the Gaussians' features to the teacher's.
        weight: gamma.
        settings: Settings that the colors are rendered with.
        size: `image`: of the features in `output`, reduced to the size of the map bilinearly, corners on corners, as in
            [1]; it mixes the 2 x 2 pixels around each cell's place, hence before the decoder, which is linear and mixes
            channels: the same numbers from fewer products. `teacher`: a ray through the middle of each cell.
        couple: Whether gradients reach the geometry where features are rendered here.
    """

    decoder: Decoder
    weight: float
    settings: RenderSettings
    size: FeatureSize
    couple: bool
    name: ClassVar[str] = "features"
    outputs: ClassVar[tuple[str, ...]] = ()

    def is_shown(self, frame: Frame) -> bool:
        """Whether the features are to be rendered with the colors of a photograph."""
        return frame.teacher is not None and self.size == "image"

    def __call__(self, output: Output, frame: Frame, gaussians: Gaussians) -> torch.Tensor | None:
        """See `LossTerm`; None without a map, and where the mask keeps nothing of it."""
        if frame.teacher is None:
            return None
        target = frame.teacher()
        channels, height, width = target.shape
        if channels != self.decoder.channels:
            raise ValueError(
                f"view {frame.name!r}: the teacher's map must have {self.decoder.channels} channels as the others, got "
                f"{channels}; make it again"
            )
        shown = self._shown(output, frame, gaussians, width, height).reshape(height * width, -1)
        cells = target.reshape(channels, height * width)
        if frame.mask is not None:
            kept = torch.nn.functional.interpolate(frame.mask[None, None], (height, width), mode="area").flatten()
            kept = kept > _INSIDE
            if not bool(kept.any()):
                return None
            shown = shown[kept]
            cells = cells[:, kept]
        return self.weight * _Distance.apply(shown, self.decoder.matrix, self.decoder.bias, cells)

    def _shown(self, output: Output, frame: Frame, gaussians: Gaussians, width: int, height: int) -> torch.Tensor:
        """(h, w, D) features at the size of the teacher's map."""
        if self.size == "image":
            assert output.features is not None  # `is_shown`: they are an output
            planes = output.features.permute(2, 0, 1)[None]  # as it lies, channels last
            small = torch.nn.functional.interpolate(planes, (height, width), mode="bilinear", align_corners=True)
            return small[0].permute(1, 2, 0)
        # Constants but for the features: what an uncoupled derivative needs not compute.
        seen = gaussians if self.couple else gaussians.detach().replace(features=gaussians.features)
        camera = frame.camera.resized(width, height)
        shown = render(seen, camera, self.settings, outputs=(), couple_features=self.couple).features
        assert shown is not None
        return shown


class _Distance(torch.autograd.Function):
    """Mean |W f + b - t|, with its gradients, some cells at a time: nothing as large as a map is held.

    Args:
        features: (n, D).
        matrix, bias: W (C, D) and b (C,).
        cells: (C, n) t, of any floating type; gets no gradient.
    """

    @staticmethod
    def forward(
        ctx: Any, features: torch.Tensor, matrix: torch.Tensor, bias: torch.Tensor, cells: torch.Tensor
    ) -> torch.Tensor:
        """The loss is a number, so that its gradients are known with it, up to a factor."""
        total = 0.0
        step = max(1, _CHUNK // len(matrix))
        slopes = torch.empty_like(features), torch.zeros_like(matrix), torch.zeros_like(bias)
        for k in range(0, len(features), step):
            f = features[k : k + step]
            error = torch.addmm(bias, f, matrix.T).sub_(cells[:, k : k + step].T)
            total += float(error.abs().sum())
            sign = error.sign_()
            torch.mm(sign, matrix, out=slopes[0][k : k + step])
            slopes[1].addmm_(sign.T, f)
            slopes[2].add_(sign.sum(0))
        ctx.save_for_backward(*(x.div_(cells.numel()) for x in slopes))
        return features.new_tensor(total / cells.numel())

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Of everything but the map."""
        return (*(grad * x for x in ctx.saved_tensors), None)


def features_of(config: FitConfig, channels: int) -> tuple[FeatureDistance, Network]:
    """The term and the decoder of a fit to `channels` of a teacher.

    The decoder's first weights are those of torch, drawn by the config's seed; torch's own generator stays as it was.
    """
    from drgs.features.decoder import Decoder

    wanted = config.features
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        decoder = Decoder(wanted.feature_width, channels)
    term = FeatureDistance(
        decoder, wanted.feature_weight, config.settings, wanted.feature_resolution, wanted.couple_features
    )
    return term, Network("decoder", decoder, wanted.decoder_rate)


class SemanticsComponent(Component):
    """Features of Gaussians and their decoder as a part of a fit, where the data set has maps of a teacher.

    Attributes:
        known: What they are fitted to; None in a fit without.
        decoder: The decoder; None before the fit has begun.
    """

    name = "semantics"
    option = ("semantics", "ignore")
    where = "where features are fitted, too"
    files = (EMBEDDINGS,)
    conflicts = (Conflict("begin", "its Gaussians have no features", "ignore semantics, or fit anew"),)
    block = ("semantic", "a fit without a teacher's maps")

    def __init__(self, known: SemanticRecord | None = None) -> None:
        self.known = known
        self.decoder: Decoder | None = None
        self._term: FeatureDistance | None = None
        self._semantics: Semantics | None = None
        self._folder: Path | None = None

    def prepare(self, setup: Setup) -> None:
        """See `Component`: one map of the views that may be read is opened."""
        self.known = SemanticRecord.of(setup.dataset, setup.config, setup.views)
        self._semantics = setup.dataset.semantics
        self.pictures = ("semantics.png",) if self.known else ()

    def setting(self, setup: Setup) -> str | None:
        """See `Component`."""
        return None if self.known is None else setup.config.features.semantics

    def begin(self, setup: Setup, resumed: bool) -> None:
        """See `Component`: what labels are measured against is read, and checked."""
        if self.known is not None and self.known.embeddings:
            from drgs.fitting.segments import check_references

            check_references(setup.held_out)

    def start(self, fit: Fit, setup: Setup) -> None:
        """See `Component`."""
        if self.known is not None:
            self._use(fit.config, self.known)
            self.restart(fit)

    def restart(self, fit: Fit) -> None:
        """See `Component`: features of new Gaussians are 0."""
        if self.known is not None:
            fit.rows.add_tensor("features", torch.zeros(len(fit.rows), self.known.width))

    def resume(self, fit: Fit, checkpoint: Checkpoint) -> None:
        """See `Component`.

        Raises:
            ValueError: If the fit began with another teacher.
        """
        was = SemanticRecord.from_json(checkpoint.header.get("semantics"), checkpoint.where)
        check_same_teacher(self.known, was, checkpoint.where)
        if self.known is not None:
            self._use(fit.config, self.known)

    def _use(self, config: FitConfig, known: SemanticRecord) -> None:
        self._term, network = features_of(config, known.channels)
        self.decoder = self._term.decoder
        self.terms, self.networks = [self._term], [network]
        self.rates = {"features": config.features.feature_rate}
        self.rendering = {"couple_features": config.features.couple_features}

    def rendered(self, gaussians: Gaussians, frame: Frame) -> Gaussians:
        """See `Component`: features are rendered with colors only where the term asks for them."""
        if self._term is None or gaussians.features is None or self._term.is_shown(frame):
            return gaussians
        return gaussians.replace(features=None)

    def state(self, fit: Fit) -> tuple[dict[str, torch.Tensor], dict]:
        """See `Component`."""
        return {}, {} if self.known is None else {"semantics": self.known.to_json()}

    def write_files(self, folder: Path) -> None:
        """See `Component`: once, for embeddings of classes stay as they are."""
        if self.known is not None and self._folder is None:
            self.known.write_embeddings(folder, self._semantics)
        self._folder = folder

    def record(self, fit: Fit, before: Mapping[str, Any]) -> dict[str, Any]:
        """See `Component`."""
        return {} if self.known is None else {"semantics": self.known.to_json()}

    def scoring(self, scoring: Scoring) -> Scoring:
        """See `Component`: features count in the metric of their decoder."""
        if self.decoder is None:
            return scoring
        from drgs.information.semantics import SemanticMetric

        return dataclasses.replace(scoring, semantics=SemanticMetric(self.decoder.metric()))

    def labels(self) -> tuple[Classes | None, Decoder | None]:
        """See `Component`."""
        if self.known is None or self._folder is None:
            return None, None
        return self.known.read_classes(self._folder), self.decoder

    def log_fields(self, fit: Fit, terms: Sequence[Mapping[str, float]]) -> dict[str, Any]:
        """See `Component`: the mean distance of features."""
        values = [x for one in terms if math.isfinite(x := one.get("features", math.nan))]
        return {"features": float(np.mean(values))} if values and self.known is not None else {}

    def evaluation(self, fit: Fit, held_out: list[Frame]) -> dict[str, Any]:
        """See `Component`."""
        if self.known is None or self._folder is None:
            return {}
        from drgs.fitting.segments import segmentation_of

        classes = self.known.read_classes(self._folder)
        folders = self.known.labels, self.known.teacher
        return {"segmentation": segmentation_of(fit.gaussians(), self.decoder, classes, *folders, held_out)}
