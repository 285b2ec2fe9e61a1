"""Claims about damaged files that the fuzzers have found (benchmarks/fuzz.py): one line each, and nothing is allocated
that a file only claims.
"""

from __future__ import annotations

import io
import json
import resource
import struct
import sys
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import splat_encoders as encode
import torch
from splat_samples import sog_scene, write_sample
from test_bad_values import save, write_transforms

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

from fuzz_seeds import DUMPS, dumped

from drgs.cameras import Camera, intrinsics
from drgs.codecs import load_gaussians
from drgs.data import load
from drgs.data.camera_lists import load_cameras_json
from drgs.data.checks import check_npz, file_inside, read_npy
from drgs.data.images import can_hold, image_size, is_whole, read_image, stated_size
from drgs.features.decoder import Decoder, load_decoder, save_decoder
from drgs.features.teacher import read_map
from drgs.files import Run
from drgs.fitting.metrics import _read_weights
from drgs.lab.rasterizers import read_dump

pytestmark = pytest.mark.core


@pytest.fixture
def little_room():
    """No more than 512 MiB of address space beyond what is taken: more is an error that none of the tests allows."""
    if not Path("/proc/self/statm").exists():
        pytest.skip("needs Linux's /proc")
    before = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (512 << 20), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def refused(read, path, match: str, kind=ValueError) -> str:
    """The one line with which a file is refused."""
    with pytest.raises(kind, match=match) as error:
        read(path)
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 1000
    return text


# ---- images


def chunk(kind: bytes, body: bytes, length: int | None = None) -> bytes:
    stated = struct.pack(">I", len(body) if length is None else length)
    return stated + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def test_chunks_of_png_that_claim_more_than_the_file(tmp_path, little_room):
    """A gigabyte of IDAT in 70 bytes, of an image of 8x6 pixels."""
    path = tmp_path / "a.png"
    head = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 8, 6, 8, 0, 0, 0, 0))
    body = zlib.compress(bytes(6 * 9))
    path.write_bytes(head + chunk(b"IDAT", body) + chunk(b"IEND", b""))
    assert is_whole(path)
    assert read_image(path).shape == (6, 8)
    path.write_bytes(head + chunk(b"IDAT", body) + chunk(b"IEND", b"") + b"trailing bytes that are nothing")
    assert read_image(path).shape == (6, 8)
    for length in (len(body) + 17, 1 << 30, (1 << 32) - 1):
        path.write_bytes(head + chunk(b"IDAT", body, length) + chunk(b"IEND", b""))
        assert not is_whole(path)
        refused(read_image, path, "must be a whole image, its data end early")


def test_a_jpeg_that_is_cut_off(tmp_path):
    """Found by its end, before anything is decoded; an embedded preview has an end, too, and phones append more."""
    path = tmp_path / "a.jpg"
    picture = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    preview = cv2.imencode(".jpg", picture[:8, :8])[1].tobytes()
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(preview)) + preview + data[2:]
    for whole in (data, data + b"\xff\xd8 a film of the moment"):
        path.write_bytes(whole)
        assert is_whole(path)
        assert image_size(path) == (60, 40)
        assert read_image(path).shape == (40, 60, 3)
    for length in (len(data) // 2, len(data) - 100, len(data) - 1):
        path.write_bytes(data[:length])
        assert not is_whole(path)
        refused(image_size, path, "must be a whole image, its data end early")
        refused(read_image, path, "must be a whole image, its data end early")


def test_headers_of_a_few_bytes(tmp_path):
    """Every beginning of every kind of image says its size or none, and ends in one line."""
    picture = np.random.default_rng(0).integers(0, 255, (5, 7, 3), np.uint8)
    for suffix in (".png", ".jpg", ".bmp", ".webp", ".tiff"):
        path = tmp_path / f"a{suffix}"
        assert cv2.imwrite(str(path), picture)
        data = path.read_bytes()
        for length in range(1, 60):
            path.write_bytes(data[:length])
            assert stated_size(path) in (None, (7, 5))
            refused(read_image, path, "must be")


@pytest.mark.parametrize("order", ["<", ">"])
def test_sizes_of_bigtiff(tmp_path, order):
    """Its directory has other widths than that of a classic one; of two entries, the first counts."""
    begin = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HHHQ", 43, 8, 0, 16)
    entries = [(256, 7), (257, 5), (256, 1 << 20)]
    rows = b"".join(struct.pack(f"{order}HHQIxxxx", tag, 4, 1, value) for tag, value in entries)
    (tmp_path / "a.tif").write_bytes(begin + struct.pack(f"{order}Q", len(entries)) + rows)
    assert stated_size(tmp_path / "a.tif") == (7, 5)
    (tmp_path / "a.tif").write_bytes(begin[:8] + struct.pack(f"{order}Q", 1 << 63) + rows)
    assert stated_size(tmp_path / "a.tif") is None


def test_a_canvas_of_webp_that_no_webp_has(tmp_path, little_room):
    """24 bits a side in its extended header, of which an image has 14."""
    path = tmp_path / "a.webp"
    wide = (14_874_384).to_bytes(3, "little") + (70).to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<I", 10) + bytes(4) + wide
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
    assert stated_size(path) == (14_874_385, 71)
    assert not can_hold(path, 14_874_385, 71)
    refused(read_image, path, "its header says 14874385x71")


# ---- arrays


def test_headers_of_arrays_that_claim_gigabytes(tmp_path, little_room):
    """Of the header's own length, in all versions of the format, and of the array's."""
    file = io.BytesIO()
    np.save(file, np.arange(6.0))
    for version in (1, 2, 3):
        data = b"\x93NUMPY" + bytes([version, 0]) + (b"\xff\xff" if version == 1 else b"\xff\xff\xff\x7f") + bytes(50)
        (tmp_path / "a.npy").write_bytes(data)
        refused(read_npy, tmp_path / "a.npy", "must be a .npy file, got")
    (tmp_path / "a.npy").write_bytes(file.getvalue().replace(b"(6,)", b"(9999999999,)"))
    refused(read_npy, tmp_path / "a.npy", "claims shape|must be a .npy file")
    (tmp_path / "a.npy").write_bytes(file.getvalue())
    assert read_npy(tmp_path / "a.npy").tolist() == [0, 1, 2, 3, 4, 5]


def test_archives_of_arrays_that_claim_gigabytes(tmp_path, little_room):
    """What their headers, or the archive's own directory, say is compared with the file."""
    path, good = tmp_path / "a.npz", io.BytesIO()
    np.save(good, np.arange(6.0))
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        path.write_bytes(encode.zipped({"a.npy": good.getvalue(), "b.npy": good.getvalue()}, method=method))
        assert check_npz(path) == ["a", "b"]
    shape = b"(9999999999,), }"
    lying = good.getvalue().replace(b"(6,), }".ljust(len(shape)), shape)  # as many bytes
    assert lying != good.getvalue()
    path.write_bytes(encode.zipped({"a.npy": lying}))
    refused(check_npz, path, r"must hold arrays of numbers, got a.npy: the header claims shape \(9999999999,\)")
    path.write_bytes(encode.zipped({"a.npy": good.getvalue()}, method=zipfile.ZIP_LZMA))
    refused(check_npz, path, "a compression that NumPy does not write")
    data = bytearray(encode.zipped({"a.npy": good.getvalue()}))
    at = data.index(b"PK\x01\x02")
    struct.pack_into("<I", data, at + 24, 1 << 31)  # the size unpacked, in the directory
    path.write_bytes(data)
    refused(check_npz, path, "2147483648 bytes of a.npy")


def test_dumps_of_another_byte_order(tmp_path):
    """Arrays of big-endian numbers are the same numbers; torch refuses them as they are."""
    DUMPS[0](tmp_path)
    path = tmp_path / "dump.npz"
    wanted = read_dump(path, *dumped())
    with np.load(path) as arrays:
        swapped = {name: x.astype(x.dtype.newbyteorder(">")) for name, x in arrays.items()}
    np.savez(path, **swapped)
    found = read_dump(path, *dumped())
    assert torch.equal(found.images, wanted.images)
    assert all(torch.equal(found.gradients[name], x) for name, x in wanted.gradients.items())


def test_parts_of_torch_files_that_claim_gigabytes(tmp_path, little_room):
    """In the index of the archive: torch would allocate them. Decoders, maps of a teacher and weights alike."""
    save_decoder(Decoder(3, 5), tmp_path / "a.pth")
    torch.save(torch.ones(2, 3, 4), tmp_path / "a.pt")
    torch.save({"x": torch.ones(2)}, tmp_path / "weights.pth")
    for name, read in (("a.pth", load_decoder), ("a.pt", read_map), ("weights.pth", _read_weights)):
        read(tmp_path / name)
        data = bytearray((tmp_path / name).read_bytes())
        at = data.index(b"PK\x01\x02")
        struct.pack_into("<II", data, at + 20, 3 << 30, 3 << 30)
        (tmp_path / name).write_bytes(data)
        refused(read, tmp_path / name, "must be a whole file, '.*' claims 3221225472 bytes of")


# ---- names


@pytest.mark.parametrize("name", ["a\nb.png", "a\x00b", "\u2028", "1" * 5000, "../../etc/passwd", "/etc/passwd"])
def test_names_that_are_none(tmp_path, name):
    """Of several lines, of thousands of letters, or outside of the folder."""
    refused(lambda path: file_inside(path, name, f"{path}: file_path"), tmp_path, "must name a file in")
    data = write_transforms(tmp_path)
    data["ply_file_path"] = name
    save(tmp_path, data)
    refused(load, tmp_path, "ply_file_path must name a file in|could not|must be UTF-8|must be")


def test_names_that_are_unusual(tmp_path):
    """Spaces, other scripts and backslashes are names."""
    for name in ("a b.png", "庭\u3000園.png", "a\\b.png", "é/ß.png"):
        assert file_inside(tmp_path, name, "here") == tmp_path / name


def test_a_name_of_a_photograph_that_no_file_can_have(tmp_path):
    """It is one that is not there."""
    data = write_transforms(tmp_path)
    data["frames"][0]["file_path"] = "x" * 600
    save(tmp_path, data)
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        load(tmp_path, strict=True)
    assert "\n" not in str(error.value)


def test_names_of_cameras_are_cut_in_messages(tmp_path):
    """A list whose camera is called by a thousand letters and cannot be."""
    row = {"id": 0, "img_name": "1" * 5000, "width": 10, "height": 10, "fx": -1, "fy": 1}
    row |= {"position": [0, 0, 0], "rotation": np.eye(3).tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps([row]))
    refused(load_cameras_json, tmp_path / "cameras.json", "camera 0: Camera '1+': ")
    with pytest.raises(ValueError, match="^Camera 'x{80}': "):
        Camera(intrinsics(1, 1, 1, 1), 2 * np.eye(4), 4, 4, name="x" * 5000)


# ---- Gaussians


def test_lists_in_a_compressed_ply_claim_nothing(tmp_path, rng, little_room):
    """A list of 2^31 numbers in a column that is not used."""
    write_sample(tmp_path / "packed.ply", "packed.ply", rng)
    data = (tmp_path / "packed.ply").read_bytes()
    kept, _, body = data.partition(b"end_header\n")
    kept = kept.replace(b"property float max_b\n", b"property float max_b\nproperty list int int x\n")
    row = body[:72] + struct.pack("<i", (1 << 31) - 1)
    (tmp_path / "a.ply").write_bytes(kept + b"end_header\n" + row + body[72:] + bytes(100))
    refused(load_gaussians, tmp_path / "a.ply", "must be a readable PLY")


def test_lists_for_numbers_in_a_compressed_ply(tmp_path):
    """A column of SH that is a list, of a length that fits the file."""
    packed = np.zeros((1, 4), "<u4")
    names = [f"{end}_{name}" for end in ("min", "max") for name in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {x}" for x in names)]
    lines += ["element vertex 1", *(f"property uint packed_{x}" for x in ("position", "rotation", "scale", "color"))]
    for listed in (False, True):
        kind = "list uchar uchar" if listed else "uchar"
        own = ["element sh 1", f"property {kind} f_rest_0", *(f"property uchar f_rest_{i}" for i in range(1, 9))]
        header = "\n".join([*lines, *own, "end_header", ""]).encode()
        body = np.ones(12, "<f4").tobytes() + packed.tobytes() + (b"\x01" if listed else b"") + bytes(9)
        (tmp_path / f"{listed}.ply").write_bytes(header + body)
    assert len(load_gaussians(tmp_path / "False.ply")) == 1
    refused(load_gaussians, tmp_path / "True.ply", "the sh column f_rest_0 must be a number, is a list")


def test_messages_about_sog_scenes_are_short(tmp_path, rng):
    """Versions, names and decoders' own words that go on for pages."""
    meta, images, _ = sog_scene(rng)
    path = tmp_path / "a.sog"
    path.write_bytes(encode.zipped(encode.sog_files(meta | {"version": "1" * 5000}, images)))
    refused(load_gaussians, path, "SOG must be of version 1 or 2, got '1")
    for name in ("a" * 5000, "a\nb", "\u2028"):
        changed = meta | {"quats": {"files": [name]}}
        path.write_bytes(encode.zipped(encode.sog_files(changed, images)))
        refused(load_gaussians, path, "files must be named without a folder|a text without control")
        folder = tmp_path / "scene"
        folder.mkdir(exist_ok=True)
        for file, content in encode.sog_files(changed, images).items():
            (folder / file).write_bytes(content)
        refused(load_gaussians, folder, "files must be named without a folder|a text without control")
    data = bytearray(encode.zipped(encode.sog_files(meta, images)))
    local = data.index(b"quats.webp", data.index(b"RIFF"))
    data[local - 4 : local - 2] = (3000).to_bytes(2, "little")  # the length of its name
    path.write_bytes(data)
    refused(load_gaussians, path, "quats.webp must be readable")


def test_a_sog_bundle_of_another_compression_that_is_damaged(tmp_path, rng):
    """LZMA, which zip archives may have, has an error of its own."""
    meta, images, _ = sog_scene(rng)
    data = bytearray(encode.zipped(encode.sog_files(meta, images), method=zipfile.ZIP_LZMA))
    (tmp_path / "a.sog").write_bytes(data)
    assert len(load_gaussians(tmp_path / "a.sog")) == 70
    at = data.index(b"quats.webp") + 60
    data[at : at + 40] = bytes(40)
    (tmp_path / "a.sog").write_bytes(data)
    refused(load_gaussians, tmp_path / "a.sog", "must be readable")


def test_windows_of_zstandard(tmp_path):
    """A frame that asks for a window of 2 GiB is refused as any other."""
    import zstandard

    packer = zstandard.ZstdCompressor(
        compression_params=zstandard.ZstdCompressionParameters(window_log=31, enable_ldm=True, format=0)
    )
    stream = packer.compressobj()
    frame = stream.compress(bytes(9)) + stream.flush()
    parts = [bytes(9), bytes(1), bytes(3), bytes(3), bytes(4)]
    data = encode.spz_file_4(0, parts, 1)
    head, first = data[: 32 + 80], zstandard.ZstdCompressor().compress(parts[0])
    table = struct.pack("<QQ", len(frame), 9) + head[48:]
    (tmp_path / "a.spz").write_bytes(head[:32] + table + frame + data[112 + len(first) :])
    refused(load_gaussians, tmp_path / "a.spz", "must be a Zstandard frame, got a window above 128 MiB")


def test_messages_about_runs_are_short(tmp_path):
    """A schema of thousands of letters."""
    (tmp_path / "config.json").write_text(json.dumps({"schema": "1" * 5000}))
    refused(lambda path: Run(path).config(), tmp_path, "schema must be 1 or 2, got '1+; fit again")
