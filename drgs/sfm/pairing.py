"""Which pairs of photographs are matched: all of few; of many, neighbors by name and the nearest by appearance.

Appearance is a global descriptor of a photograph's own local features: they are assigned to the nearest of a few
centers, found in the capture itself by k-means, and their differences from it are summed up by center (VLAD). No
vocabulary is downloaded; pycolmap's wheel carries none.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drgs.sfm.matching import sequential_pairs

MAX_EXHAUSTIVE = 60
"""Photographs of which all pairs are matched by default."""
MAX_EXHAUSTIVE_MASKED = 150
"""The same with masks: an object alone has a tenth of the features to compare."""
_SEQUENTIAL_WINDOW = 10  # photographs that follow, with which one is matched: COLMAP's own sequential overlap
_NARROW_WINDOW = 4  # the same beside matches by appearance; chosen
_NEAREST_BY_APPEARANCE = 20  # photographs most alike, with which one is matched; chosen
_NEAREST_FOR_NEW = 30  # the same for photographs that are added later and enter the model by these pairs alone; chosen
# cluster centers of VLAD, of 16, 64 and 256 that Jegou et al. (2010) test: 64 x 128 numbers describe a photograph
_VLAD_CENTERS = 64
_FEATURES_PER_PHOTO = 400  # features of a photograph that the centers are fitted to: bounds time
_KMEANS_ROUNDS = 12  # rounds of k-means, at most; chosen


@dataclass(frozen=True)
class Pairing:
    """Pairs of photographs that are matched.

    Attributes:
        pairs: Their names.
        total: Number of all pairs.
        left_out: A sentence about those that are not; empty if all are.
    """

    pairs: list[tuple[str, str]]
    total: int
    left_out: str = ""


def choose_pairs(database: Path, names: list[str], matching: str, is_masked: bool, seed: int) -> Pairing:
    """The pairs to match.

    Args:
        database: COLMAP's database, with the features of all photographs.
        names: Photographs in their order.
        matching: `exhaustive`, `sequential`, `retrieval`, or `auto`, which decides by the number of photographs.
        is_masked: Whether features are those of an object alone.
        seed: Seed of the k-means.
    """
    total = len(names) * (len(names) - 1) // 2
    if matching == "auto":
        most = MAX_EXHAUSTIVE_MASKED if is_masked else MAX_EXHAUSTIVE
        matching = "exhaustive" if len(names) <= most else "retrieval"
    if matching == "exhaustive":
        return Pairing(list(itertools.combinations(names, 2)), total)
    if matching == "sequential":
        pairs = sequential_pairs(names, _SEQUENTIAL_WINDOW)
        what = f"the {_SEQUENTIAL_WINDOW} next by name, and some further on"
    else:
        near = nearest_pairs(global_descriptors(database, names, seed), _NEAREST_BY_APPEARANCE)
        by_name = sequential_pairs(names, _NARROW_WINDOW)
        place = {name: index for index, name in enumerate(names)}
        pairs = sorted({*by_name, *((names[i], names[j]) for i, j in near)}, key=lambda p: (place[p[0]], place[p[1]]))
        what = f"the {_NEAREST_BY_APPEARANCE} nearest by appearance, and the {_NARROW_WINDOW} next by name"
    if len(pairs) == total:
        return Pairing(pairs, total)
    left_out = f"{len(pairs):,} of {total:,} pairs are matched: {what}; --matcher exhaustive matches all"
    return Pairing(pairs, total, left_out)


def choose_new_pairs(database: Path, old: list[str], new: list[str], seed: int) -> Pairing:
    """The pairs to match where photographs join others that are matched already: all with few, else the nearest.

    Args:
        database: COLMAP's database, with the features of all photographs.
        old, new: Photographs that are there, and those that join them.
        seed: Seed of the k-means.
    """
    names = [*old, *new]
    total = len(new) * (len(new) - 1) // 2 + len(new) * len(old)
    if len(names) <= MAX_EXHAUSTIVE:
        return Pairing([(names[i], names[j]) for j in range(len(old), len(names)) for i in range(j)], total)
    near = nearest_pairs(global_descriptors(database, names, seed), _NEAREST_FOR_NEW, firsts=len(old))
    pairs = sorted({*((names[i], names[j]) for i, j in near), *sequential_pairs(new, _NARROW_WINDOW)})
    if len(pairs) == total:
        return Pairing(pairs, total)
    what = f"the {_NEAREST_FOR_NEW} nearest by appearance, and the {_NARROW_WINDOW} next by name"
    left_out = f"{len(pairs):,} of {total:,} pairs with new photographs are matched: {what}"
    return Pairing(pairs, total, left_out)


def nearest_pairs(descriptors: np.ndarray, count: int, firsts: int | None = None) -> list[tuple[int, int]]:
    """Index pairs (i, j), i < j, of each photograph with its nearest ones.

    Args:
        descriptors: (V, D) of length 1.
        count: Partners of each.
        firsts: Photographs before this number have no partners of their own: those that are there when others come.
    """
    alike = descriptors @ descriptors.T
    np.fill_diagonal(alike, -np.inf)
    # Stable: of equal ones the lower index wins on every machine.
    nearest = np.argsort(-alike, axis=1, kind="stable")[:, : min(count, len(alike) - 1)]
    return sorted({(min(i, j), max(i, j)) for i in range(firsts or 0, len(alike)) for j in nearest[i].tolist()})


def global_descriptors(database: Path, names: list[str], seed: int = 0) -> np.ndarray:
    """(V, 64 * 128) float32 of length 1: VLAD of the SIFT features of each photograph.

    Residuals are normalized by center, then the root is taken of their sizes, as in the references.

    Args:
        database: COLMAP's database, with features.
        names: Photographs.
        seed: Seed of the sample and the first centers.
    Reference:
        Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010; Arandjelovic and
        Zisserman, "All about VLAD", CVPR 2013.
    """
    from scipy.cluster.vq import vq

    rng = np.random.default_rng(seed)
    samples = []
    for features in _features(database, names):
        few = len(features) > _FEATURES_PER_PHOTO
        samples.append(
            features[np.sort(rng.choice(len(features), _FEATURES_PER_PHOTO, replace=False))] if few else features
        )
    centers = _centers(np.concatenate(samples), rng)
    descriptors = np.zeros((len(names), len(centers), 128), np.float32)
    for index, features in enumerate(_features(database, names)):
        if len(features):
            label, _ = vq(features, centers)
            np.add.at(descriptors[index], label, features - centers[label])
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=2, keepdims=True), 1e-12)
    flat = descriptors.reshape(len(names), -1)
    flat = np.sign(flat) * np.sqrt(np.abs(flat))
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)


def _features(database: Path, names: list[str]) -> Iterator[np.ndarray]:
    """(N, 128) float32 of length 1 of each photograph, in the order of names; one is held at a time."""
    from drgs.data.colmap_bindings import opened_database

    with opened_database(database) as handle:
        numbers = {image.name: image.image_id for image in handle.read_all_images()}
        for name in names:
            data = np.asarray(handle.read_descriptors(numbers[name]).data, np.float32).reshape(-1, 128)
            yield data / np.maximum(np.linalg.norm(data, axis=1, keepdims=True), 1e-12)


def _centers(features: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(K, 128) float32 by k-means (Lloyd 1982), begun at random features; one that no feature is nearest to stays."""
    from scipy.cluster.vq import kmeans2

    count = min(_VLAD_CENTERS, len(features))
    if not count:
        return np.zeros((0, 128), np.float32)
    first = features[np.sort(rng.choice(len(features), count, replace=False))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is such a center
        return kmeans2(features, first, iter=_KMEANS_ROUNDS, minit="matrix")[0]
