"""Vector quantization: codebooks of numbers, palettes of vectors, and an order in which neighbors are close.

Lloyd's algorithm throughout (Lloyd, "Least squares quantization in PCM", 1982): each value goes to the entry nearest to
it, each entry to the mean of its values. Every step is deterministic: the same Gaussians give the same file.
"""

from __future__ import annotations

import numpy as np

from drgs.display.progress import Bar

_BINS = 1 << 16  # of a histogram: 256 to an entry of the codebook
_CODEBOOK_STEPS = 40  # of Lloyd's algorithm, on the histogram
_PALETTE_STEPS = 6  # of the same, on all rows, which takes most of the time of writing
_BLOCK = 4096  # rows that are compared with all centers at a time
_SEED = 0  # of k-means' first centers: the same Gaussians give the same bytes
_MORTON_BITS = 20  # an axis: a few Gaussians far away shall not leave one cell for all others


def codebook(values: np.ndarray, weights: np.ndarray | None = None, size: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """At most `size` numbers that approximate values, ascending, and the index of the nearest for each.

    Args:
        values: (N, ...) finite, N >= 1.
        weights: (N,) positive, by which errors count; None: all alike.
        size: Largest number of entries.
    Returns:
        (size,) float64 entries, the last one repeated where fewer are needed; and indices of the shape of `values`.
    """
    flat = np.asarray(values, np.float64).ravel()
    distinct = np.unique(flat)
    if len(distinct) > size:
        each = np.ones(len(flat)) if weights is None else np.repeat(weights, len(flat) // len(weights))
        entries = _lloyd(flat, each, size)
    else:
        entries = np.concatenate([distinct, np.full(size - len(distinct), distinct[-1])])
    middles = (entries[1:] + entries[:-1]) / 2
    return entries, np.searchsorted(middles, values, side="left")


def _lloyd(values: np.ndarray, weights: np.ndarray, size: int) -> np.ndarray:
    """Entries between the ends of values, on a histogram: bins are finer than any step between entries."""
    low, high = values.min(), values.max()
    counts, edges = np.histogram(values, _BINS, (low, high), weights=weights)
    centers = (edges[1:] + edges[:-1]) / 2
    weight = np.concatenate([[0], np.cumsum(counts)]).astype(np.float64)
    moment = np.concatenate([[0.0], np.cumsum(counts * centers)])
    # Half evenly over the range, so that what is rare has entries near by, half by how many values there are.
    spread = np.sqrt(np.linspace(0, 1, size) * np.linspace(0, 1, size))
    by_count = np.interp((np.arange(size) + 0.5) / size * weight[-1], weight, edges)
    entries = 0.5 * (low + (high - low) * spread) + 0.5 * by_count
    for _ in range(_CODEBOOK_STEPS):
        ends = np.concatenate([[0], np.searchsorted(centers, (entries[1:] + entries[:-1]) / 2), [_BINS]])
        each = weight[ends[1:]] - weight[ends[:-1]]
        sums = moment[ends[1:]] - moment[ends[:-1]]
        entries = np.sort(np.where(each > 0, sums / np.where(each > 0, each, 1), entries))
    return entries


def palette(rows: np.ndarray, weights: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `size` vectors that approximate rows, and the index of the nearest for each.

    In two levels, which takes a hundredth of the comparisons: clusters of rows first, and in each as many vectors as
    its share of what would be lost. A row is compared with the vectors of its own cluster.

    Args:
        rows: (N, D) finite, N >= 1.
        weights: (N,) positive, by which errors count.
        size: Largest number of vectors.
    Returns:
        (K, D) float32 vectors, K <= size, and (N,) indices.
    """
    rows = np.ascontiguousarray(rows, np.float32)
    distinct, inverse = np.unique(rows, axis=0, return_inverse=True)
    if len(distinct) <= size:
        return distinct, inverse.reshape(-1)
    rng = np.random.default_rng(_SEED)
    coarse = max(1, int(np.sqrt(size)))
    with Bar("palette", coarse) as bar:
        centers, which = _k_means(rows, weights, coarse, rng)
        lost = np.bincount(which, weights * ((rows - centers[which]) ** 2).sum(1), coarse)
        members = np.bincount(which, minlength=coarse)
        counts = _shares(lost, members, size)
        found, labels, taken = [], np.empty(len(rows), np.int64), 0
        for number in range(coarse):
            bar.update(number)
            mine = np.flatnonzero(which == number)
            if not len(mine):
                continue
            vectors, label = _k_means(rows[mine], weights[mine], int(counts[number]), rng)
            found.append(vectors)
            labels[mine] = label + taken
            taken += len(vectors)
    return np.concatenate(found), labels


def _shares(lost: np.ndarray, members: np.ndarray, size: int) -> np.ndarray:
    """How many vectors each cluster gets: by the square root of members times loss, at least 1, at most its members."""
    wish = np.sqrt(lost * members)
    wish = wish / max(wish.sum(), 1e-300) * (size - np.count_nonzero(members))
    return np.clip(1 + np.floor(wish).astype(np.int64), 1, np.maximum(members, 1))


def _k_means(
    rows: np.ndarray, weights: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """`count` centers of rows, and the nearest one of each row."""
    share = weights / weights.sum()
    centers = rows[np.sort(rng.choice(len(rows), min(count, len(rows)), replace=False, p=share))]
    which = _nearest(rows, centers)
    for _ in range(_PALETTE_STEPS):
        order = np.argsort(which, kind="stable")
        starts = np.flatnonzero(np.diff(which[order], prepend=-1))
        sums = np.add.reduceat(rows[order] * weights[order, None], starts, axis=0)
        there = which[order][starts]
        sizes = np.add.reduceat(weights[order], starts)
        centers = centers.copy()
        centers[there] = (sums / sizes[:, None]).astype(np.float32)
        which = _nearest(rows, centers)
    return centers, which


def _nearest(rows: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Index of the center nearest to each row; of equal ones the first."""
    squares = (centers**2).sum(1)
    found = np.empty(len(rows), np.int64)
    for start in range(0, len(rows), _BLOCK):
        block = rows[start : start + _BLOCK]
        found[start : start + _BLOCK] = (squares - 2 * (block @ centers.T)).argmin(1)
    return found


def morton_order(means: np.ndarray) -> np.ndarray:
    """(N,) indices in the order of a Z-shaped curve through space: what follows each other is close.

    Args:
        means: (N, 3) finite.
    Reference:
        Morton, "A computer oriented geodetic data base", 1966.
    """
    means = means.astype(np.float64)
    low = means.min(0)
    step = (means.max(0) - low) / ((1 << _MORTON_BITS) - 1)
    cells = ((means - low) / np.where(step > 0, step, 1)).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
