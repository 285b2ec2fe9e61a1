"""HDR videos and photographs: patches of known colors come out as sRGB has them, whatever the file says them in."""

from __future__ import annotations

import importlib.util
import io
import struct

import numpy as np
import pytest
from PIL import Image

from drgs.data import video_decoding
from drgs.data.hdr import HdrReader, hdr_transfer
from drgs.data.images import heif_as_jpeg, read_image
from drgs.data.videos import VideoFrame

av = pytest.importorskip("av")

PATCH = 32  # pixels
# sRGB
PATCHES = np.array([[1, 1, 1], [0.5, 0.5, 0.5], [0.1, 0.1, 0.1], [0.8, 0.1, 0.1], [0.2, 0.6, 0.3], [0.1, 0.2, 0.9]])
TRC = {"HLG": 18, "PQ": 16}
# BT.2087: linear BT.709 to linear BT.2020
TO_2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])


def linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def signal(light: np.ndarray, kind: str) -> np.ndarray:
    """HLG's OETF of light of the scene, white at 75 %, or PQ's inverse EOTF, white of 203 cd/m2 (BT.2100)."""
    if kind == "PQ":
        power = (light * 203 / 10_000) ** (2610 / 16384)
        return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)
    light = light * 0.26496
    log = 0.17883277 * np.log(np.maximum(12 * light - 0.28466892, 1e-9)) + 0.55991073
    return np.where(light <= 1 / 12, np.sqrt(3 * light), log)


def write_hdr(path, kind: str, codec: str = "libx265", frames: int = 4, tagged: bool = True):
    """A video of patches in a row; of frame k the row begins with patch k."""
    rgb = signal(linear(PATCHES) @ TO_2020.T, kind)
    r, g, b = rgb.T
    y = 0.2627 * r + 0.6780 * g + 0.0593 * b
    codes = np.stack([64 + 876 * y, 512 + 896 * (b - y) / 1.8814, 512 + 896 * (r - y) / 1.4746]).round()
    with av.open(str(path), "w") as container:
        options = {"x265-params": "log-level=none:qp=0:keyint=2" + ("" if tagged else f":transfer={TRC[kind]}")}
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = PATCH * len(PATCHES), PATCH, "yuv420p10le"
        context = stream.codec_context
        context.color_range, context.colorspace = 1, 9
        context.color_primaries, context.color_trc = (9, TRC[kind]) if tagged else (2, 2)
        for k in range(frames):
            frame = av.VideoFrame(stream.width, stream.height, "yuv420p10le")
            frame.color_range, frame.colorspace = 1, 9
            frame.color_primaries, frame.color_trc = context.color_primaries, context.color_trc
            for plane, row in zip(frame.planes, codes, strict=True):
                buffer = np.zeros((plane.height, plane.line_size // 2), np.uint16)
                buffer[:, : plane.width] = np.repeat(np.roll(row, -k), plane.width // len(row))
                plane.update(buffer)
            frame.pts = k
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def patches_of(image: np.ndarray) -> np.ndarray:
    return image[PATCH // 2, PATCH // 2 :: PATCH] / 255


@pytest.mark.parametrize(("kind", "suffix"), [("HLG", "mp4"), ("PQ", "mov"), ("HLG", "mkv")])
def test_patches(tmp_path, kind, suffix):
    """Within two numbers of 8 bits, in any order of reading; frames are those of their numbers."""
    path = write_hdr(tmp_path / f"a.{suffix}", kind)
    for k in (0, 1, 3, 2, 0):
        image = VideoFrame(path, k).read()
        assert image.shape == (PATCH, PATCH * len(PATCHES), 3)
        np.testing.assert_allclose(patches_of(image), np.roll(PATCHES, -k, axis=0), atol=2.5 / 255)
    assert VideoFrame(path, 1).read_gray(PATCH * len(PATCHES)).shape == (PATCH, PATCH * len(PATCHES))


def test_the_decoder_says_it_where_the_file_does_not(tmp_path):
    """As files have it that were made without a box of colors."""
    path = write_hdr(tmp_path / "a.mp4", "HLG", tagged=False)
    assert b"colr" not in path.read_bytes()
    np.testing.assert_allclose(patches_of(VideoFrame(path, 0).read()), PATCHES, atol=2.5 / 255)


@pytest.mark.parametrize(("kind", "suffix"), [("HLG", "mp4"), ("PQ", "mov"), ("HLG", "mkv")])
def test_without_pyav_it_is_said(tmp_path, monkeypatch, caplog, kind, suffix):
    """By the header of the file."""
    path = write_hdr(tmp_path / f"a.{suffix}", kind)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert hdr_transfer(path, suffix != "mkv") == TRC[kind]
    video_decoding._Reader(path, [], 4, suffix != "mkv")
    assert caplog.messages == [
        f"{path}: is HDR video ({kind}), whose colors come out wrong without the package av; pip install "
        "'drgs[video]', or convert it to SDR"
    ]


def test_headers_that_say_nothing(tmp_path, monkeypatch):
    """Boxes that claim more than there is, or nothing, are no HDR video, and are not searched forever."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    path = tmp_path / "a.mp4"
    for data in (
        b"",
        b"\0\0\0\x08ftyp",
        b"\0\0\0\0moov",
        b"\0\0\0\0free",
        b"\0\0\0\x01moov" + b"\xff" * 8,
        b"\xff" * 30,
    ):
        path.write_bytes(data)
        assert hdr_transfer(path, True) == 0
        assert hdr_transfer(path, False) == 0


def test_a_video_that_is_turned(tmp_path):
    """By a quarter, clockwise, as phones state it: what is on the left comes to the top."""
    path = write_hdr(tmp_path / "a.mp4", "HLG")
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4 + 40
    data[start : start + 20] = struct.pack(">5i", 0, 1 << 16, 0, -(1 << 16), 0)
    path.write_bytes(data)
    image = VideoFrame(path, 0).read()
    assert image.shape == (PATCH * len(PATCHES), PATCH, 3)
    np.testing.assert_allclose(image[PATCH // 2 :: PATCH, PATCH // 2] / 255, PATCHES, atol=2.5 / 255)
    assert VideoFrame(path, 0).read_gray(1000).shape == (PATCH * len(PATCHES), PATCH)


@pytest.mark.parametrize("kind", ["HLG", "PQ"])
def test_photographs(tmp_path, kind):
    """HEIC as cameras make it, in 8 of its 10 bits; its EXIF stays where COLMAP gets it as JPEG."""
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    coded = np.round(255 * signal(linear(PATCHES) @ TO_2020.T, kind)).astype(np.uint8)
    pixels = np.repeat(np.repeat(coded[None], PATCH, axis=1), PATCH, axis=0)
    tags = {"color_primaries": 9, "transfer_characteristics": TRC[kind], "matrix_coefficients": 9, "full_range_flag": 1}
    exif = Image.Exif()
    exif[0x010F] = "a maker"
    path = tmp_path / "a.heic"
    Image.fromarray(pixels).save(path, quality=100, chroma=444, exif=exif, **tags)
    np.testing.assert_allclose(patches_of(read_image(path)), PATCHES, atol=8 / 255)  # a number of PQ is up to 5 of sRGB
    with Image.open(io.BytesIO(heif_as_jpeg(path, 98))) as shown:
        assert shown.getexif()[0x010F] == "a maker"
        np.testing.assert_allclose(patches_of(np.asarray(shown)), PATCHES, atol=12 / 255)


def test_a_frame_that_cannot_be_decoded(tmp_path):
    """There is none, which `VideoFrame` says in a line; those that are whole are read."""
    path = write_hdr(tmp_path / "a.mp4", "HLG", frames=6)
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    for at, size in packets[3:]:  # each unit keeps its length, which comes before it
        end = at + size
        while at < end:
            length = int.from_bytes(data[at : at + 4], "big")
            data[at + 4 : at + 4 + length] = b"\xff" * length
            at += 4 + length
    path.write_bytes(data)
    reader = HdrReader(path, TRC["HLG"], [])
    np.testing.assert_allclose(patches_of(reader.frame(0)), PATCHES, atol=2.5 / 255)
    assert reader.frame(5) is None
    assert reader.frame(1).shape == (PATCH, PATCH * len(PATCHES), 3)
