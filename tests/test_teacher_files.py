"""A teacher's feature maps on disk: what a file must hold, what is read of it, and when."""

from __future__ import annotations

import os
import zipfile

import numpy as np
import pytest
import torch

from drgs.features import teacher

FULL = torch.randn(8, 6, 5, generator=torch.Generator().manual_seed(0))


class Command:
    """What a hostile file makes of itself when it is unpickled."""

    def __init__(self, text):
        self.text = text

    def __reduce__(self):
        return os.system, (self.text,)


def packed(path, tensor, method=zipfile.ZIP_STORED, change=lambda name, content: content):
    """A tensor's file, its parts written again."""
    torch.save(tensor, path)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in parts.items():
            archive.writestr(name, change(name, content))


def message(path, kind=ValueError):
    """The one line that a file is refused with, without its path."""
    with pytest.raises(kind) as error:
        teacher.read_map(path)
    text = str(error.value)
    assert text.startswith(f"{path}: must ")
    assert "\n" not in text
    assert len(text) < len(str(path)) + 260
    return text.removeprefix(str(path))


@pytest.mark.parametrize("tensor", [FULL.half(), FULL, FULL[:, :4], torch.nn.Parameter(FULL)])
def test_tensors_that_encoders_write(tensor, tmp_path):
    """Half and single precision, views into larger tensors (SAM's maps are cropped ones), values to the last bit."""
    path = tmp_path / "a.b_fmap_CxHxW.pt"
    torch.save(tensor, path)
    found = teacher.used_map(path)
    assert found.dtype == tensor.dtype
    assert not found.requires_grad
    assert torch.equal(found, tensor.detach())
    assert teacher.map_name(path) == "a.b"
    assert teacher.map_name(tmp_path / "a.pt") is None


def test_files_that_hold_something_else(tmp_path):
    """One line each: another object, type, rank, format; nothing in the file runs."""
    path = tmp_path / "a_fmap_CxHxW.pt"
    assert "found none" in message(path, FileNotFoundError)
    for value, words in (
        ({"map": FULL}, "got a dict"),
        ([FULL], "got a list"),
        (FULL.int(), "torch.int32"),
        (FULL.bfloat16(), "bfloat16"),
        (FULL[None], "(1, 8, 6, 5)"),
        (FULL[:, :0], "(8, 0, 5)"),
        (FULL.to_sparse(), "sparse_coo"),
        (Command(f"touch {tmp_path / 'executed'}"), "other Python objects"),
    ):
        torch.save(value, path)
        assert words in message(path)
    assert not (tmp_path / "executed").exists()
    torch.save(FULL, path, _use_new_zipfile_serialization=False)
    assert "other bytes" in message(path)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    assert "git lfs pull" in message(path)
    path.write_bytes(b"")
    assert "other bytes" in message(path)


def test_files_that_lie(tmp_path):
    """Cut short, a claim beyond what the file holds, compressed parts, numbers in the name that are not the shape."""
    path = tmp_path / "a_fmap_CxHxW.pt"
    torch.save(FULL, path)
    content = path.read_bytes()
    for length in (len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        message(path)
    packed(path, FULL, change=lambda name, content: content[:64] if name.endswith("data/0") else content)
    assert "whole" in message(path)
    packed(path, FULL, zipfile.ZIP_DEFLATED)
    assert "compressed" in message(path)
    named = tmp_path / "a_fmap_8x6x6.pt"
    torch.save(FULL, named)
    assert "8x6x6" in message(named)
    torch.save(torch.cat([FULL, FULL[..., :1]], -1), named)
    assert teacher.read_map(named).shape == (8, 6, 6)


@pytest.mark.parametrize("side", [2000, 5000])
@pytest.mark.parametrize("read", [teacher.read_map, teacher.used_map, teacher.read_tensor])
def test_a_header_that_repeats_numbers(side, read, tmp_path):
    """A kilobyte that claims gigabytes is refused by its header: nothing of that size is read or allocated."""
    path = tmp_path / "a_fmap_CxHxW.pt"
    torch.save(torch.zeros(1, dtype=torch.float16).expand(512, side, side), path)
    assert path.stat().st_size < 2000
    with pytest.raises(ValueError, match=r"must hold every number that it claims, \(512, .* bytes, the file has"):
        read(path)
    torch.save(FULL.as_strided((8, 6, 500), (30, 5, 0)), path)
    assert "the file has" in message(path)


def test_damaged_files(tmp_path):
    """Whatever bytes are overwritten: one line, or a tensor (17,000 such files were tried once, these are 200)."""
    path = tmp_path / "a_fmap_CxHxW.pt"
    torch.save(FULL.half(), path)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    rng, refused = np.random.default_rng(0), []
    for _ in range(200):
        damaged = content.copy()
        start = rng.integers(len(content))
        damaged[start : start + rng.integers(1, 64)] = rng.integers(256)
        path.write_bytes(damaged.tobytes())
        try:
            assert teacher.used_map(path).ndim == 3
        except ValueError as error:
            refused.append(str(error))
    assert 20 < len(refused) < 200
    assert not [text for text in refused if "\n" in text]


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
@pytest.mark.parametrize("value", [float("nan"), float("-inf")])
def test_a_map_is_looked_through_when_it_is_used(dtype, value, tmp_path):
    """NaN is found by `used_map`, with its place, not by `read_map`; and again after the file has changed."""
    path = tmp_path / "a_fmap_CxHxW.pt"
    torch.save(FULL.to(dtype), path)
    assert teacher.used_map(path).isfinite().all()
    wrong = FULL.to(dtype).clone()
    wrong[5, 4, 3], wrong[7, 0, 0] = value, value
    torch.save(wrong, path)
    os.utime(path, ns=(0, 1))  # another time, however coarse the file system's clock is
    assert teacher.read_map(path)[0].isfinite().all()
    with pytest.raises(ValueError, match=f"got {value} at channel 5, row 4, column 3; make this map again$"):
        teacher.used_map(path)


def test_the_largest_number_is_finite(tmp_path):
    """Neither 65504 of half precision nor the least subnormal is taken for an infinity."""
    for kind in (np.float16, np.float32):
        info = np.finfo(kind)
        edge = torch.from_numpy(np.array([info.max, info.min, info.smallest_subnormal, 0.0], kind).reshape(1, 2, 2))
        teacher.check_finite(edge, tmp_path)


def resident(kind):
    """MiB of this process in memory, by kind: RssAnon is its own, RssFile pages of files."""
    with open("/proc/self/status") as file:
        return {line.split(":")[0]: int(line.split()[1]) / 1024 for line in file if line.startswith("Rss")}[kind]


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs Linux's /proc")
def test_maps_are_not_held(tmp_path):
    """Thirty maps of 8 MiB open at once take no memory; looking through one takes its pages, and no copy of them."""
    path = tmp_path / "a_fmap_CxHxW.pt"
    torch.save(torch.zeros(64, 256, 256).half(), path)
    teacher.used_map(path)  # whatever the first use imports and allocates
    own, mapped = resident("RssAnon"), resident("RssFile")
    maps = [teacher.read_map(path) for _ in range(30)]
    # Of 240 MiB; 6 MiB are the allocator's arenas and the pages of headers, far less than one map.
    assert resident("RssAnon") - own < 6
    assert resident("RssFile") - mapped < 6
    teacher.check_finite(maps[0], path)
    assert resident("RssAnon") - own < 6  # planes of 128 KiB, one at a time
    assert resident("RssFile") - mapped < 8 + 6
