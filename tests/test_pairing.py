"""Which pairs are matched: all of few photographs, and of many the nearest by name and by appearance."""

from __future__ import annotations

import numpy as np
import pytest

from drgs.sfm.pairing import MAX_EXHAUSTIVE, choose_new_pairs, choose_pairs, global_descriptors, nearest_pairs

pycolmap = pytest.importorskip("pycolmap")

SEEN = 24  # landmarks on each of the photographs of a ring
STEP = 4  # of them, from one photograph to the next


def write_features(path, features) -> list[str]:
    """A database of COLMAP's with descriptors (N, 128) uint8 of each photograph, and their names."""
    names = [f"{index:03d}.jpg" for index in range(len(features))]
    with pycolmap.Database.open(path) as handle:
        camera = handle.write_camera(
            pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId.SIMPLE_RADIAL, 500.0, 640, 480)
        )
        for name, found in zip(names, features, strict=True):
            number = handle.write_image(pycolmap.Image(name=name, camera_id=camera))
            handle.write_descriptors(number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, found))
    return names


def ring(count: int, rng) -> list[np.ndarray]:
    """Descriptors of photographs around a place: each shows landmarks that its neighbors show, too, and noise."""
    landmarks = rng.gamma(0.6, 40, (count * STEP, 128))
    found = []
    for index in range(count):
        shown = landmarks[(index * STEP + np.arange(SEEN)) % len(landmarks)]
        noise = rng.gamma(0.6, 40, (6, 128))
        found.append(np.clip(np.concatenate([shown + rng.normal(0, 6, shown.shape), noise]), 0, 255).astype(np.uint8))
    return found


@pytest.fixture
def shuffled(tmp_path, rng):
    """A ring of 80 photographs whose names say nothing of their order: database, names, and place on the ring."""
    place = rng.permutation(80)
    features = ring(80, rng)
    names = write_features(tmp_path / "database.db", [features[at] for at in place])
    return tmp_path / "database.db", names, place


def apart(i: int, j: int, count: int) -> int:
    return min((i - j) % count, (j - i) % count)


def test_appearance_finds_neighbors(shuffled):
    """Of 80 photographs in no order the nearest four are those beside, on the ring, which closes."""
    database, names, place = shuffled
    found = global_descriptors(database, names)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1, abs=1e-5)
    pairs = nearest_pairs(found, 4)
    assert all(i < j for i, j in pairs)
    steps = np.array([apart(place[i], place[j], 80) for i, j in pairs])
    assert (steps <= 4).mean() > 0.9
    near = {(min(i, j), max(i, j)) for i in range(80) for j in range(80) if apart(place[i], place[j], 80) == 1}
    assert near <= set(pairs)


def test_the_same_pairs_each_time(shuffled):
    """The seed decides, not the order in which photographs are named."""
    database, names, _ = shuffled
    first = choose_pairs(database, names, "retrieval", False, 3)
    assert choose_pairs(database, names, "retrieval", False, 3) == first


def test_what_is_matched(shuffled):
    """All of few; of many what was asked for, with a sentence about the rest."""
    database, names, place = shuffled
    total = 80 * 79 // 2
    exhaustive = choose_pairs(database, names, "exhaustive", False, 0)
    assert len(exhaustive.pairs) == total
    assert exhaustive.left_out == ""
    assert choose_pairs(database, names[:MAX_EXHAUSTIVE], "auto", False, 0).left_out == ""
    assert choose_pairs(database, names, "auto", True, 0).left_out == ""  # masked
    auto = choose_pairs(database, names, "auto", False, 0)
    assert auto.pairs == choose_pairs(database, names, "retrieval", False, 0).pairs
    assert len(auto.pairs) == len(set(auto.pairs)) < total / 2
    assert all(a < b for a, b in auto.pairs)
    assert {(names[i], names[i + 1]) for i in range(79)} <= set(auto.pairs)
    at = dict(zip(names, place.tolist(), strict=True))
    beside = {tuple(sorted((a, b))) for a in names for b in names if apart(at[a], at[b], 80) == 1}
    assert beside <= set(auto.pairs)
    assert auto.left_out == (
        f"{len(auto.pairs):,} of {total:,} pairs are matched: the 20 nearest by appearance, and the 4 next by name; "
        "--matcher exhaustive matches all"
    )
    sequential = choose_pairs(database, names, "sequential", False, 0)
    assert not beside <= set(sequential.pairs)
    assert "the 10 next by name" in sequential.left_out


def test_photographs_that_come_later(shuffled):
    """Pairs with new ones alone: with all others where they are few, else with the nearest."""
    database, names, place = shuffled
    few = choose_new_pairs(database, names[:5], names[5:8], 0)
    assert few.left_out == ""
    assert len(few.pairs) == 3 * 5 + 3
    many = choose_new_pairs(database, names[:70], names[70:], 0)
    assert len(many.pairs) < 70 * 10 + 45
    assert f"{len(many.pairs):,} of 745 pairs with new photographs are matched" in many.left_out
    assert all(b in names[70:] for _, b in many.pairs)
    at = dict(zip(names, place.tolist(), strict=True))
    beside = {tuple(sorted((a, b))) for a in names[70:] for b in names if apart(at[a], at[b], 80) == 1}
    assert beside <= {tuple(sorted(pair)) for pair in many.pairs}


def test_photographs_without_features(tmp_path, rng):
    """Blank ones are like none, and blank ones alone are no error."""
    features = ring(70, rng)
    features[5] = features[6] = np.zeros((0, 128), np.uint8)
    names = write_features(tmp_path / "some.db", features)
    found = global_descriptors(tmp_path / "some.db", names)
    assert np.isfinite(found).all()
    assert not found[5].any()
    assert choose_pairs(tmp_path / "some.db", names, "auto", False, 0).pairs
    names = write_features(tmp_path / "none.db", [np.zeros((0, 128), np.uint8)] * 70)
    assert choose_pairs(tmp_path / "none.db", names, "auto", False, 0).pairs
