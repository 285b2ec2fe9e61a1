"""Teacher features for generated scenes: those of a network of LSeg's kind, errors included.

A class has a unit embedding of 512 dimensions; any two have a cosine of about 0.6, classes that are easily confused
(`GROUPS`) one of about 0.8, as texts of CLIP do. The map of a view starts from the shares of the clean classes in each
cell, and then errs, each time by a generator of the seed and the view:

- Boundaries: every cell looks up the classes of a place up to two cells away (a smooth field, standard deviation 0.7
  cells), and the shares are blurred (Gaussian, 0.8 cells).
- Wrong patches of the view: where a smooth field of 5 cells exceeds its 92 % quantile, 60 to 100 % of each class go to
  the one that it is confused with. They are elsewhere in the next view: views that are fused can outvote them.
- Wrong places of the room: the same for 3 % of space (waves of 0.5 to 1.5 m), alike from every view: no fusing helps.
  Where nothing is known about space, as in photographs with labels, there are none of these; the patches of the view
  take their share as well (they begin at the 89 % quantile): as much is wrong, but fusing could help everywhere.
- Noise: smooth (4 cells), in the span of the embeddings, standard deviation 0.12 a class; and white in all 512
  dimensions, together 0.4 of the norm. The norm itself is about 4, as that of four summed scales, and varies by 10 %.

What is confused with what is a `Confusions`, by default the room's. At the room's defaults, seed 0 and 75 views, the
largest cosine gives 81.9 % of the pixels their clean class back (`accuracy`; single views 71 to 89 %), 75.9 % as the
average over classes; mean IoU 0.614 (walls 0.78, thin chairs 0.35).
"""

from __future__ import annotations

import dataclasses
import io

import numpy as np

__all__ = [
    "CONFUSED",
    "DIMENSIONS",
    "GROUPS",
    "ROOM",
    "Confusions",
    "accuracy",
    "embeddings",
    "feature_map",
    "load",
    "read_labels",
    "tensor_bytes",
]

DIMENSIONS = 512  # channels of a feature, as CLIP ViT-B has
GROUPS = (
    ("wall", "ceiling", "curtain"),
    ("floor", "rug"),
    ("window", "picture", "door"),
    ("sofa", "cushion", "chair"),
    ("table", "cabinet", "shelf", "book"),
    ("lamp", "vase", "plant"),
)
CONFUSED = {
    "wall": "ceiling", "ceiling": "wall", "curtain": "wall", "floor": "rug", "rug": "floor", "window": "picture",
    "picture": "window", "door": "wall", "sofa": "chair", "cushion": "sofa", "chair": "table", "table": "cabinet",
    "cabinet": "shelf", "shelf": "cabinet", "book": "shelf", "lamp": "vase", "vase": "lamp", "plant": "vase",
}  # fmt: skip
_NORM = 4.0  # length of a feature vector, on average; as `drgs.features.encoders.MAP_NORM`
_PATCH = 1.405  # a normal field of unit variance exceeds its 92 % quantile there
_PLACE = 1.881  # and its 97 % quantile there
_PATCH_ALONE = 1.239  # and its 89.2 % quantile: what both together leave right, 0.92 * 0.97


@dataclasses.dataclass(frozen=True)
class Confusions:
    """Which classes a teacher confuses.

    Attributes:
        partner: Class -> the one that it is taken for, of every class.
        groups: Classes whose embeddings are alike; a class is in one at most.
    """

    partner: dict[str, str]
    groups: tuple[tuple[str, ...], ...] = ()


ROOM = Confusions(CONFUSED, GROUPS)


def embeddings(names, seed=0, confusions=ROOM):
    """Unit embeddings (classes, 512) float32 of class names; those of a group are alike."""
    rng = np.random.default_rng([seed, 11])
    partner, groups = confusions.partner, confusions.groups
    common = rng.standard_normal(DIMENSIONS)
    own = {name: rng.standard_normal(DIMENSIONS) for name in partner}
    grouped = {name for group in groups for name in group}
    groups = (*groups, *((name,) for name in partner if name not in grouped))
    shared = {name: vector for group in groups for vector in [rng.standard_normal(DIMENSIONS)] for name in group}
    rows = [np.sqrt(0.6) * common + np.sqrt(0.2) * shared[name] + np.sqrt(0.2) * own[name] for name in names]
    rows = np.array(rows)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def _smooth(rng, height, width, sigma, count):
    """(height, width, count) normal fields of unit variance that are smooth over `sigma` cells."""
    import cv2

    pad = int(3 * sigma) + 1
    white = rng.standard_normal((height + 2 * pad, width + 2 * pad, count), dtype=np.float32)
    field = cv2.GaussianBlur(white, (0, 0), sigma).reshape(*white.shape)[pad:-pad, pad:-pad]
    return field * 2 * np.sqrt(np.pi) * sigma  # what the blur takes from the variance


def _waves(points, seed):
    """A field of about unit variance in space, (n,) at points (n, 3) in meters."""
    rng = np.random.default_rng([seed, 12])
    ways = rng.standard_normal((24, 3))
    ways *= (2 * np.pi / rng.uniform(0.5, 1.5, 24) / np.linalg.norm(ways, axis=1))[:, None]
    return np.cos(points @ ways.T + rng.uniform(0, 2 * np.pi, 24)).sum(1) / np.sqrt(12)


def feature_map(labels, points, names, size, seed, view, confusions=ROOM):
    """The teacher's map of one view, (512, h, w) float16.

    Args:
        labels: (height, width) clean classes, 1-based, 0 for none.
        points: (height, width, 3) world points of the pixels in meters; None where they are not known.
        names: Names of the classes.
        size: (w, h) of the map, at most the labels' own.
        seed: Seed of the embeddings and of the errors.
        view: Number of the view, which has errors of its own.
        confusions: What is taken for what.
    """
    import cv2

    rng = np.random.default_rng([seed, 13, view])
    w, h = size
    count = len(names)
    vectors = embeddings(names, seed, confusions)
    height, width = labels.shape
    shares = np.zeros((height, width, count), np.float32)
    y, x = np.nonzero(labels)
    shares[y, x, labels[y, x].astype(int) - 1] = 1
    # One class at a time: by a factor that is not whole OpenCV averages at most four channels.
    shares = np.stack([cv2.resize(shares[..., k], (w, h), interpolation=cv2.INTER_AREA) for k in range(count)], -1)
    y, x = np.mgrid[:h, :w].astype(np.float32)
    moved = np.clip(0.7 * _smooth(rng, h, w, 1.5, 2), -2, 2)
    at_x, at_y = (
        np.clip(v, 0, n - 1).astype(int) for v, n in ((x + moved[..., 0] + 0.5, w), (y + moved[..., 1] + 0.5, h))
    )
    shares = cv2.GaussianBlur(shares[at_y, at_x], (0, 0), 0.8).reshape(h, w, count)

    wrong = _smooth(rng, h, w, 5.0, 1)[..., 0] > (_PATCH_ALONE if points is None else _PATCH)
    if points is not None:
        rows, columns = ((np.arange(n) + 0.5) * big / n for n, big in ((h, height), (w, width)))
        place = points[rows.astype(int)[:, None], columns.astype(int)[None]]
        wrong |= _waves(place.reshape(-1, 3), seed).reshape(h, w) > _PLACE
    part = wrong * (0.8 + 0.2 * np.tanh(_smooth(rng, h, w, 5.0, 1)[..., 0]))
    partner = [names.index(confusions.partner[name]) for name in names]
    taken = shares * part[..., None]
    shares -= taken
    for k, other in enumerate(partner):
        shares[..., other] += taken[..., k]

    shares += 0.12 * _smooth(rng, h, w, 4.0, count)
    feature = shares.reshape(-1, count) @ vectors
    feature /= np.maximum(np.linalg.norm(feature, axis=1, keepdims=True), 1e-6)  # 0 where no class is
    feature += 0.4 / np.sqrt(DIMENSIONS) * rng.standard_normal(feature.shape, dtype=np.float32)
    feature *= _NORM * (1 + 0.1 * _smooth(rng, h, w, 4.0, 1).reshape(-1, 1))
    return np.ascontiguousarray(feature.T.reshape(DIMENSIONS, h, w).astype(np.float16))


def tensor_bytes(array):
    """The content of a `.pt` file that holds a plain tensor."""
    import torch

    file = io.BytesIO()
    torch.save(torch.from_numpy(array), file)
    return file.getvalue()


def load(path):
    """(512, h, w) float32 of a teacher's file."""
    import torch

    return torch.load(path, weights_only=True).numpy().astype(np.float32)


def read_labels(feature, vectors, size=None):
    """Classes (h, w), 1-based, by the largest cosine; of `size` (width, height) by the nearest cell."""
    import cv2

    flat = feature.reshape(len(feature), -1).T
    found = (flat @ vectors.T).argmax(1).reshape(feature.shape[1:]).astype(np.uint8) + 1
    return found if size is None else cv2.resize(found, size, interpolation=cv2.INTER_NEAREST)


def accuracy(pairs, vectors):
    """Share of the labelled pixels whose class the teacher's features give back.

    Args:
        pairs: Pairs of a feature map and clean labels (height, width).
        vectors: (classes, 512) embeddings.
    """
    right = total = 0
    for feature, labels in pairs:
        found = read_labels(feature, vectors, labels.shape[::-1])
        right += int(((found == labels) & (labels > 0)).sum())
        total += int((labels > 0).sum())
    return right / max(total, 1)
