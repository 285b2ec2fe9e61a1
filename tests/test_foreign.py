"""Claims of drgs.io.foreign: a file of another kind is named as what it is, with the way round."""

from __future__ import annotations

import gzip
import json
import struct
import zipfile

import pytest
from test_data import save, write_colmap, write_llff, write_transforms

from drgs import cli
from drgs.commands.scene_input import SceneInput
from drgs.data import load
from drgs.data.camera_lists import load_cameras_json
from drgs.data.images import read_image
from drgs.files import load_ply, load_state

pytestmark = pytest.mark.core

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 123456\n"
CONVERT = r"convert it with `drgs convert .*scene.* .*\.ply`, or read it with drgs.load_gaussians"
META = b'{"version":2,"count":3,"means":{"mins":[0,0,0],"files":["means_l.webp","means_u.webp"]}}'


def spz_header(version: int) -> bytes:
    """Magic, version, number of points and flags of an SPZ file."""
    return struct.pack("<4sIII", b"NGSP", version, 4, 0)


def archive(path, name: str, data: bytes) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(name, data)


SPLATS = {
    "scene.spz": (gzip.compress(spz_header(2)), "an SPZ file"),
    "scene_v4.spz": (spz_header(4), "an SPZ file"),
    "scene.bin": (gzip.compress(spz_header(3)), "an SPZ file"),  # by its bytes alone
    "scene.splat": (bytes(64), r"a \.splat file \(32 bytes a Gaussian, no SH\)"),
    "scene.ksplat": (bytes(4096), r"a \.ksplat file"),
    "scene.compressed.ply": (
        b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\n"
        b"property uint packed_position\nproperty uint packed_rotation\nend_header\n" + bytes(12),
        "a PLY in PlayCanvas' compressed layout",
    ),
    "scene.sog": (None, "a SOG file"),
    "scene.zip": (None, "a SOG file"),
}


@pytest.mark.parametrize("name", SPLATS)
def test_other_splats_are_named_with_the_way_round(tmp_path, name):
    """Every format of Gaussians that is no 3DGS PLY: one line, its name, a command that converts it."""
    data, kind = SPLATS[name]
    path = tmp_path / name
    path.write_bytes(data) if data is not None else archive(path, "meta.json", META)
    with pytest.raises(ValueError, match=f"must be a 3DGS PLY file, is {kind}.*; {CONVERT}") as error:
        load_ply(path)
    assert "\n" not in str(error.value)
    assert f" {path}`" not in str(error.value), "the conversion must not overwrite its own input"


def test_an_unbundled_sog_is_known_by_its_folder_and_by_its_index(tmp_path):
    """`meta.json` beside its textures, given as a folder or as a file."""
    (tmp_path / "meta.json").write_bytes(META)
    for path in (tmp_path, tmp_path / "meta.json"):
        with pytest.raises(ValueError, match=r"meta.json: means must have the key 'maxs'"):  # it is being read
            SceneInput.at(path)
    with pytest.raises(ValueError, match="is the index of an unbundled SOG scene.*; convert it with `drgs convert"):
        load_ply(tmp_path / "meta.json")


@pytest.mark.parametrize(
    ("name", "data", "told"),
    [
        ("a.glb", b"glTF\2\0\0\0", "is a glTF file"),
        ("a.ply", b"<!DOCTYPE html><html>", r"is a web page; .* the link named Raw"),
        ("a.ply.gz", gzip.compress(b"ply\n", mtime=0), "is a gzip file; unpack it first"),
        ("a.mp4", b"\0\0\0\x20ftypisom" + bytes(20), "is a video; find its cameras first"),
    ],
)
def test_other_files_given_as_a_scene(tmp_path, name, data, told):
    """What else people have in their folders."""
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=told):
        load_ply(tmp_path / name)


def test_a_git_lfs_pointer_is_one_wherever_a_file_is_read(tmp_path):
    """PLY, photographs, cameras, models, arrays and checkpoints that were never downloaded: `git lfs pull`."""
    told = "is a Git LFS pointer, .*; run `git lfs install` once and then `git lfs pull` in"

    def attempt(read, path):
        path.write_bytes(POINTER)
        with pytest.raises(ValueError, match=told) as error:
            read()
        assert "\n" not in str(error.value)

    attempt(lambda: load_ply(tmp_path / "a.ply"), tmp_path / "a.ply")
    attempt(lambda: read_image(tmp_path / "a.jpg"), tmp_path / "a.jpg")
    attempt(lambda: load_state(tmp_path / "s.safetensors"), tmp_path / "s.safetensors")
    attempt(lambda: load_cameras_json(tmp_path / "cameras.json"), tmp_path / "cameras.json")
    attempt(lambda: load(tmp_path / "a.mp4"), tmp_path / "a.mp4")
    data = write_transforms(tmp_path / "a", ply_file_path="points.ply")
    attempt(lambda: load(tmp_path / "a"), tmp_path / "a" / "points.ply")
    del data["w"], data["h"], data["ply_file_path"]
    save(tmp_path / "a", data)
    attempt(lambda: load(tmp_path / "a"), tmp_path / "a" / "images" / "0.png")
    attempt(lambda: load(tmp_path / "a"), tmp_path / "a" / "transforms.json")
    write_llff(tmp_path / "b")
    attempt(lambda: load(tmp_path / "b"), tmp_path / "b" / "poses_bounds.npy")
    attempt(lambda: load(tmp_path / "c"), write_colmap(tmp_path / "c") / "images.bin")


def test_a_video_is_told_apart_from_a_folder_of_photographs(tmp_path, capsys):
    """`drgs fit film.mp4` names `drgs sfm`, which says that this one is damaged."""
    film = tmp_path / "film.mp4"
    film.write_bytes(b"\0\0\0\x20ftypmp42" + bytes(20))
    for command, told in (
        ("sfm", "film.mp4: must be a video, could not be opened"),
        ("fit", "film.mp4 -o scene`"),
    ):
        assert cli.main([command, str(film), "-o", str(tmp_path / "out")]) == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1
        assert told in line


def test_ordinary_json_named_meta_is_no_sog(tmp_path):
    """A camera list is read whatever its name is."""
    entry = {
        "width": 4,
        "height": 4,
        "fx": 4,
        "fy": 4,
        "position": [0, 0, 0],
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    }
    (tmp_path / "meta.json").write_text(json.dumps([entry]))
    assert len(load_cameras_json(tmp_path / "meta.json")) == 1
