"""Claims of drgs.codecs about bad files: one line, ValueError or FileNotFoundError, and no claim is allocated."""

from __future__ import annotations

import gzip
import json
import struct
import tracemalloc
import zipfile
import zlib

import cv2  # noqa: F401 (imported before memory is counted, as are the readers)
import numpy as np
import plyfile  # noqa: F401
import pytest
import splat_encoders as encode
import zstandard  # noqa: F401
from splat_samples import NAMES, glb_document, sog_scene, write_sample

from drgs.codecs import gltf, ksplat, load_gaussians, packed_ply, sog, splat, spz  # noqa: F401

pytestmark = pytest.mark.core

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 123456\n"


def refused(path, match: str, most: float = 5e6) -> str:
    """The line that a file is refused with; `most` bytes may be taken on the way."""
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=match) as error:
            load_gaussians(path)
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert taken < most
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("name", NAMES)
def test_truncated_files_are_refused_in_one_line(tmp_path, rng, name):
    """At many lengths; of .splat alone a whole number of rows is a file."""
    write_sample(tmp_path / name, name, rng)
    data = (tmp_path / name).read_bytes()
    path = tmp_path / f"cut.{name.rpartition('.')[2]}"
    lengths = {*range(0, min(40, len(data))), *rng.integers(0, len(data), 150).tolist(), len(data) - 1}
    for length in sorted(lengths):
        path.write_bytes(data[:length])
        if name.endswith(".splat") and length and length % 32 == 0:
            assert len(load_gaussians(path)) == length // 32
        else:
            assert len(refused(path, ".")) < 500


@pytest.mark.parametrize("count", [10**6, 2**32 - 1])
def test_headers_of_spz_that_lie_allocate_nothing(tmp_path, count):
    """Packed or not, of each version: the file's size says no."""
    (tmp_path / "a.spz").write_bytes(encode.spz_file(3, 3, bytes(100), count, packed=False))
    refused(tmp_path / "a.spz", f"the header claims {count} Gaussians, the file holds 116 bytes")
    (tmp_path / "b.spz").write_bytes(encode.spz_file(2, 3, bytes(100), count))
    refused(tmp_path / "b.spz", f"the header claims {count} Gaussians|must unpack to")
    parts = [bytes(9), b"\0", bytes(3), bytes(3), bytes(4)]
    (tmp_path / "c.spz").write_bytes(encode.spz_file_4(0, parts, count))
    refused(tmp_path / "c.spz", f"stream 0 must be of {9 * count} bytes")
    data = bytearray(encode.spz_file_4(0, parts, count))
    for i, each in enumerate((9, 1, 3, 3, 4)):  # the table lies as the header does
        struct.pack_into("<Q", data, 32 + 16 * i + 8, each * count)
    (tmp_path / "d.spz").write_bytes(data)
    refused(tmp_path / "d.spz", "must be of|must unpack to|must be memory for")


def test_bombs_are_not_unpacked(tmp_path):
    """100 MB behind a header of one Gaussian, in gzip, Zstandard and zip: no more than is claimed is unpacked."""
    zeros = bytes(100_000_000)
    body = encode.spz_body(np.zeros((1, 3), int), bytes(1), bytes(3), bytes(3), bytes(4), b"")
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(packer.compress(head + body + zeros) + packer.flush())
    refused(tmp_path / "a.spz", "must end where its header says, unpacks to more")
    data = bytearray(encode.spz_file_4(0, [bytes(9), zeros, bytes(3), bytes(3), bytes(4)], 1))
    struct.pack_into("<Q", data, 32 + 16 + 8, 1)
    (tmp_path / "b.spz").write_bytes(data)
    refused(tmp_path / "b.spz", "a stream must unpack to 1 bytes, got more")
    (tmp_path / "c.sog").write_bytes(encode.zipped({"meta.json": zeros}, method=zipfile.ZIP_DEFLATED))
    refused(tmp_path / "c.sog", "meta.json must be at most 4194304 bytes", most=2e7)


def test_claims_of_ksplat_and_glb_are_compared_with_the_file(tmp_path, rng):
    """Sections, buckets and accessors of billions."""
    write_sample(tmp_path / "a.ksplat", "1.ksplat", rng)
    good = (tmp_path / "a.ksplat").read_bytes()
    cases = {4: "claims 4294967295 sections", 16: "claims 4294967295 Gaussians", 4096: "section 0 claims 4294967295"}
    cases |= {4096 + 12: "in 4294967295 buckets", 4096 + 36: "section 0 claims"}
    for at, match in cases.items():
        bad = bytearray(good)
        struct.pack_into("<I", bad, at, 2**32 - 1)
        (tmp_path / "a.ksplat").write_bytes(bad)
        refused(tmp_path / "a.ksplat", match)
    for at, value in ((4096 + 32, 2**31), (8 + 4096, 1)):  # full buckets, their capacity: fewer places than Gaussians
        bad = bytearray(good)
        struct.pack_into("<I", bad, at, value)
        (tmp_path / "a.ksplat").write_bytes(bad)
        refused(tmp_path / "a.ksplat", "must have buckets|buckets must hold all")
    document, buffer, _ = glb_document(rng)
    for field, value in (("count", 10**12), ("count", -1), ("bufferView", 99), ("type", "MAT4"), ("byteOffset", -4)):
        changed = json.loads(json.dumps(document))
        changed["accessors"] = [x | {field: value} for x in changed["accessors"]]
        (tmp_path / "a.glb").write_bytes(encode.glb_file(changed, buffer))
        refused(tmp_path / "a.glb", "accessor|must be memory for|values")


def test_what_changes_the_gaussians_of_a_glb_is_refused(tmp_path, rng):
    """Compression, sparse accessors, moved nodes, partial SH, none or two primitives, and .gltf with other files."""
    document, buffer, _ = glb_document(rng)

    def attempt(change, match):
        changed = json.loads(json.dumps(document))
        change(changed, changed["meshes"][0]["primitives"][0])
        (tmp_path / "a.glb").write_bytes(encode.glb_file(changed, buffer))
        refused(tmp_path / "a.glb", match)

    name = "KHR_gaussian_splatting"
    packed = {f"{name}_compression_spz_2": {"bufferView": 0}}
    attempt(
        lambda d, p: p["extensions"][name].update(extensions=packed), f"packed by {name}_compression_spz_2; export it"
    )
    attempt(lambda d, p: p["extensions"].update(KHR_draco_mesh_compression={}), "packed by KHR_draco_mesh_compression")
    attempt(lambda d, p: d["accessors"][2].update(sparse={}), "not sparse")
    attempt(lambda d, p: d["nodes"][0].update(scale=[2, 2, 2]), "must not be moved or turned")
    attempt(lambda d, p: p["attributes"].pop(f"{name}:SH_DEGREE_1_COEF_1"), "SH must be whole")
    attempt(lambda d, p: p["attributes"].pop(f"{name}:SCALE"), f"must have the attribute {name}:SCALE")
    attempt(lambda d, p: p.pop("extensions"), f"must have one primitive of {name}, has 0")
    attempt(lambda d, p: d["meshes"].append(d["meshes"][0]), f"must have one primitive of {name}, has 2")
    attempt(lambda d, p: d["accessors"][1].update(count=4), "ROTATION must have 5 values as POSITION has")
    attempt(lambda d, p: d.pop("accessors"), "accessors")
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    refused(tmp_path / "a.gltf", "is a glTF file; pack it into one .glb")


def test_sog_scenes_that_are_wrong(tmp_path, rng):
    """Names that lead elsewhere, images of another size, lossy ones, missing ones, codes without an entry."""
    meta, images, _ = sog_scene(rng)
    path = tmp_path / "a.sog"

    def attempt(match, change=lambda m: None, **more):
        changed = json.loads(json.dumps(meta))
        change(changed)
        path.write_bytes(encode.zipped(encode.sog_files(changed, images | more)))
        refused(path, match)

    for name in ("../../etc/passwd", "/etc/passwd", "a/b.webp", "..", "", "a\\b"):
        attempt("files must be named without a folder", lambda m, name=name: m["quats"].update(files=[name]))
    attempt("must hold gone.webp", lambda m: m["quats"].update(files=["gone.webp"]))
    attempt("means must name 2 files", lambda m: m["means"].update(files=["means_l.webp"]))
    attempt(r"must have 1000000 to .* pixels, has 8x9", lambda m: m.update(count=10**6))
    attempt(r"count must be in \[1, 2\^28\]", lambda m: m.update(count=10**12))
    attempt(r"count must be in \[1, 2\^28\]", lambda m: m.update(count=0))
    attempt("SOG must be of version 1 or 2, got 3", lambda m: m.update(version=3))
    attempt("the key 'quats'", lambda m: m.pop("quats"))
    attempt("sh0.codebook must have", lambda m: m["sh0"].update(codebook=[0.0] * 100))
    attempt("a finite number", lambda m: m["scales"].update(codebook=[float("nan")] * 256))
    attempt("means must be finite", lambda m: m["means"].update(maxs=[1e3, 1e3, 1e3]))
    attempt("1 to 3 bands", lambda m: m["shN"].update(bands=7))
    attempt("palette of shN must be|must have", lambda m: m["shN"].update(bands=1))
    attempt("labels of shN must be below 3, got", lambda m: m["shN"].update(count=3))
    huge = encode.webp(np.zeros((2000, 2000, 3), np.uint8))  # a few bytes, 16 MB unpacked
    attempt("must have 70 to 65816 pixels, has 2000x2000", **{"means_l.webp": huge})
    lossy = encode.webp(np.zeros((9, 8, 3), np.uint8), lossless=False)
    attempt("must be a lossless WebP image, is a lossy one", **{"quats.webp": lossy})
    attempt("must be a WebP image", **{"quats.webp": b"\x89PNG\r\n\x1a\n" + bytes(40)})
    attempt("must be a Web|lossless WebP|readable WebP", **{"quats.webp": images["quats.webp"][:60]})
    wrong = encode.texture(np.zeros((70, 4), int))  # 0 names no component
    attempt(
        r"quats must name their largest component \(252 to 255\), got 0 at index 0 \(70 of 70\)",
        **{"quats.webp": wrong},
    )
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(FileNotFoundError, match="means_l.webp: must be beside meta.json"):
        load_gaussians(folder)
    (tmp_path / "secret").write_bytes(images["means_l.webp"])
    (folder / "means_l.webp").symlink_to(tmp_path / "secret")
    with pytest.raises(ValueError, match="must not lead out of its folder"):
        load_gaussians(folder)


def test_values_that_are_not_finite_are_refused_with_their_index(tmp_path):
    """As load_ply does: NaN and infinity of floats, negative scales, and quaternions of 0."""
    means, scales, rgba, quats = np.zeros((3, 3)), np.ones((3, 3)), np.full((3, 4), 100), np.full((3, 4), 200)

    def attempt(match, **changed):
        arrays = {"means": means, "scales": scales, "rgba": rgba, "quats": quats} | changed
        (tmp_path / "a.splat").write_bytes(encode.splat_file(**arrays))
        refused(tmp_path / "a.splat", match)

    attempt("means must be finite, got .* at index 1", means=np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, 0]]))
    attempt("scales must be finite and >= 0, got .* at index 2", scales=np.array([[1, 1, 1], [1, 1, 1], [1, 1, -1]]))
    attempt("scales must be finite and >= 0, got .*inf.* at index 0", scales=np.full((3, 3), np.inf))
    attempt("quats must not be 0, got .* at index 0", quats=np.array([[128] * 4, [200] * 4, [200] * 4]))


@pytest.mark.parametrize(
    ("name", "data", "match"),
    [
        ("a.spz", POINTER, "is a Git LFS pointer, .* `git lfs pull`"),
        ("a.sog", POINTER, "is a Git LFS pointer, .* `git lfs pull`"),
        ("a.splat", POINTER, "is a Git LFS pointer, .* `git lfs pull`"),
        ("a.glb", POINTER, "is a Git LFS pointer, .* `git lfs pull`"),
        (
            "a.spz",
            gzip.compress(struct.pack("<4sII4x", b"NGSP", 1, 0), mtime=0),
            "SPZ must be of version 2, 3 or 4, got 1",
        ),
        ("a.spz", b"\x1f\x8b" + bytes(20), "must be a gzip stream"),
        ("step-000029999.ckpt", b"PK\x03\x04" + bytes(40), "must be a whole file, got one without its index"),
        ("a.lcc", b"{}", r"convert it with `npx @playcanvas/splat-transform"),
        ("a.html", b"<!DOCTYPE html>", "is a web page"),
        ("a.bin", b"\0" * 100, r"is of no format that is known; what is read: \.ply, \.spz"),
        ("a.zip", encode.zipped({"a.txt": b"a"}), "is a zip archive; unpack it first"),
    ],
)
def test_other_files_are_named_with_the_way_round(tmp_path, name, data, match):
    """What people pass by mistake, or what is not read."""
    (tmp_path / name).write_bytes(data)
    refused(tmp_path / name, match)


def test_missing_files_and_empty_folders(tmp_path):
    """Neither is a traceback."""
    (tmp_path / "empty").mkdir()
    for name in ("gone.spz", "empty"):
        with pytest.raises(FileNotFoundError, match=f"{name}: must"):
            load_gaussians(tmp_path / name)
    (tmp_path / "empty" / "lod-meta.json").write_text("{}")
    refused(tmp_path / "empty", "must be one SOG scene, is a streamed one")
