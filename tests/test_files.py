"""Claims of drgs.files: bit-exact PLY, headers that lie are refused before reading, atomic files, run folders."""

import json
import logging
import os
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
import torch

from drgs import files
from drgs.data.point_ply import read_point_ply
from drgs.ellipsoids import Gaussians
from drgs.files import Run, load_ply, load_state, save_ply, save_state

pytestmark = pytest.mark.core

INRIA_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n"
    + "".join(
        f"property float {c}\n"
        for c in (
            *"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)),
            "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)),
        )
    )
    + "end_header\n"
)  # fmt: skip


def inria_bytes(rng, n=7):
    """A file as INRIA's trainer writes it, from random bit patterns that are finite."""
    data = rng.standard_normal((n, 62)).astype("<f4")
    data[:, 3:6] = 0
    return INRIA_HEADER.format(n=n).encode() + data.tobytes(), data


def gaussians(n=5, degree=3, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return Gaussians(normal(n, 3), normal(n, 4), normal(n, 3), normal(n), normal(n, (degree + 1) ** 2, 3))


def write(path, header, body=b""):
    path.write_bytes(header.encode() + body)
    return path


def header(columns, n=1, kind="float", form="binary_little_endian", element="vertex"):
    lines = [f"property {kind} {c}\n" for c in columns]
    return f"ply\nformat {form} 1.0\nelement {element} {n}\n{''.join(lines)}end_header\n"


BASE = [*"xyz", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3))]
BASE += [f"rot_{i}" for i in range(4)]


def test_inria_file_round_trips_byte_for_byte(tmp_path, rng):
    """Load and save give back INRIA's file, header included, and f_rest is read channel by channel."""
    data, table = inria_bytes(rng)
    (tmp_path / "a.ply").write_bytes(data)
    g = load_ply(tmp_path / "a.ply")
    save_ply(g, tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_bytes() == data
    assert g.sh_degree == 3
    assert np.array_equal(g.sh[:, 1, :].numpy(), table[:, [9, 24, 39]])
    assert np.array_equal(g.quats.numpy(), table[:, 58:62])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_degree_round_trips_bit_for_bit(tmp_path, degree):
    """float32 bits survive, denormals and negative zero included."""
    g = gaussians(degree=degree)
    g.means[0] = torch.tensor([-0.0, 1e-42, 3e38])
    save_ply(g, tmp_path / "a.ply")
    back = load_ply(tmp_path / "a.ply")
    for name, value in g.parameters().items():
        assert torch.equal(value.view(torch.int32), back.parameters()[name].view(torch.int32)), name


def test_columns_in_any_order_without_normals_and_with_extras(tmp_path, rng, caplog):
    """gsplat's layout has no normals; columns of others are reported and left out; doubles are rounded."""
    columns = [*BASE[::-1], "semantic_label", "7"]
    table = rng.standard_normal((4, len(columns)))
    write(tmp_path / "a.ply", header(columns, 4, "double"), table.astype("<f8").tobytes())
    with caplog.at_level(logging.WARNING):
        g = load_ply(tmp_path / "a.ply")
    assert "left out 2 columns that are not 3DGS: semantic_label, 7" in caplog.text
    assert np.array_equal(g.means.numpy(), table[:, [columns.index(c) for c in "xyz"]].astype(np.float32))
    assert g.sh.shape == (4, 1, 3)


@pytest.mark.parametrize("width", [1, 5, 512])
def test_features_round_trip_bit_for_bit(tmp_path, width):
    """Features follow the 3DGS columns as semantic_0, ..., in their order, and come back with the same bits; without
    them the file is as it was.
    """
    g = gaussians(degree=1)
    save_ply(g, tmp_path / "plain.ply")
    features = torch.randn(len(g), width, generator=torch.Generator().manual_seed(1))
    features[0, 0], features[1, 0] = -0.0, 1e-42
    save_ply(g.replace(features=features), tmp_path / "a.ply")
    back = load_ply(tmp_path / "a.ply")
    assert torch.equal(back.features.view(torch.int32), features.view(torch.int32))
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    plain, rows = (tmp_path / "plain.ply").read_bytes().split(b"end_header\n", 1)
    names = "".join(f"property float semantic_{i}\n" for i in range(width))
    assert head.decode() == plain.decode() + names
    table = np.frombuffer(body, "<f4").reshape(len(g), -1)
    assert table[:, :-width].tobytes() == rows
    assert load_ply(tmp_path / "plain.ply").features is None


def test_features_of_doubtful_files(tmp_path):
    """Columns of features with a gap, or for which the file has no bytes, are refused; any order is not."""
    columns = [*BASE, "semantic_2", "semantic_0", "semantic_1"]
    values = np.arange(len(columns), dtype="<f4")
    write(tmp_path / "a.ply", header(columns), values.tobytes())
    assert load_ply(tmp_path / "a.ply").features.tolist() == [[15, 16, 14]]
    write(tmp_path / "a.ply", header([*BASE, "semantic_0", "semantic_2"]), values[:-1].tobytes())
    with pytest.raises(ValueError, match=r"without a gap, got 2 without semantic_1"):
        load_ply(tmp_path / "a.ply")
    many = [*BASE, *(f"semantic_{i}" for i in range(512))]
    write(tmp_path / "a.ply", header(many), values.tobytes())
    with pytest.raises(ValueError, match=r"claims 1 vertex \(2104 bytes\), the file holds 68 bytes; it is truncated"):
        load_ply(tmp_path / "a.ply")
    write(tmp_path / "a.ply", header(columns), np.where(values == 15, np.nan, values).astype("<f4").tobytes())
    with pytest.raises(ValueError, match="features must be finite"):
        load_ply(tmp_path / "a.ply")


def test_ascii_and_big_endian_files_load(tmp_path):
    """PLY is PLY: text and big-endian files carry the same Gaussians."""
    values = np.arange(1, 15, dtype=np.float32)
    write(tmp_path / "a.ply", header(BASE, form="ascii"), " ".join(map(str, values)).encode() + b"\n")
    write(tmp_path / "b.ply", header(BASE, form="binary_big_endian"), values.astype(">f4").tobytes())
    a, b = load_ply(tmp_path / "a.ply"), load_ply(tmp_path / "b.ply")
    assert torch.equal(a.quats, b.quats)
    assert a.quats[0].tolist() == [11, 12, 13, 14]


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_comments_are_not_decoded(tmp_path, form, encoding):
    """Nor is anything else of a header that nobody needs, of Gaussians and of points."""
    names = [*BASE, "größe"]
    text = header(names, 1, form=form).replace("element", "comment café\nelement", 1).encode(encoding)
    values = np.ones(len(names), "<f4")
    body = b"1 " * len(names) if form == "ascii" else values.tobytes()
    path = write(tmp_path / "x.ply", "", text + body + b"\n" * (form == "ascii"))
    assert load_ply(path).means.tolist() == [[1, 1, 1]]
    assert read_point_ply(path)[0].tolist() == [[1, 1, 1]]


def test_harmonics_of_degree_4_are_cut(tmp_path, caplog):
    """Channel by channel: 24 a channel, of which the first 15 are kept."""
    names = [*BASE, *(f"f_rest_{i}" for i in range(72))]
    values = np.r_[np.ones(len(BASE)), np.arange(72)].astype("<f4")
    g = load_ply(write(tmp_path / "x.ply", header(names), values.tobytes()))
    assert g.sh_degree == 3
    np.testing.assert_array_equal(g.sh[0, 1:].T, np.arange(72).reshape(3, 24)[:, :15])
    assert "left out the SH coefficients of degree 4" in caplog.text


def test_origin_is_kept_in_the_header(tmp_path):
    """Means are stored relative to the origin, which a comment states, and come back so."""
    g = gaussians(2).replace(origin=np.array([500000.1, 5400000, -0.005]))
    save_ply(g, tmp_path / "a.ply")
    assert b"\ncomment offset 500000.1 5400000 -0.005\n" in (tmp_path / "a.ply").read_bytes()
    back = load_ply(tmp_path / "a.ply")
    assert torch.equal(back.means, g.means)
    np.testing.assert_array_equal(back.origin, g.origin)


def test_zero_gaussians_round_trip(tmp_path):
    """An empty scene is a scene."""
    save_ply(gaussians(0), tmp_path / "a.ply")
    assert len(load_ply(tmp_path / "a.ply")) == 0


@pytest.mark.parametrize("n", [10**12, 10**30])
def test_claimed_vertices_allocate_nothing(tmp_path, n):
    """A header that claims 10^12 vertices is refused from the file's size alone."""
    write(tmp_path / "a.ply", header(BASE, n), b"\0" * 560)
    load = pytest.raises(ValueError, match=rf"claims {n} vertex .* the file holds 560 bytes; it is truncated")
    tracemalloc.start()
    with load:
        load_ply(tmp_path / "a.ply")
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


def test_bad_files_are_refused_in_one_line(tmp_path, rng):
    """Each bad input names the file, what must hold, what was got and what to do."""
    good, _ = inria_bytes(rng)
    point_cloud = header([*"xyz", "red", "green", "blue"], 1), b"\0" * 24
    packed = header(["packed_position", "packed_rotation"], 1, "uint"), b"\0" * 8
    nan = np.ones(14, "<f4")
    nan[7] = np.nan
    cases = {
        "not a PLY": (good[10:], r"must be a PLY file, got b'"),
        "empty": (b"", r"must be a PLY file, got b''"),
        "no end": (good[:40], r"header of a PLY must end with end_header within 262144 bytes"),
        "truncated": (good[:-1], r"claims 7 vertex \(1736 bytes\), the file holds 1735 bytes"),
        "text truncated": (header(BASE, 3, form="ascii").encode() + b"1 2 3\n", r"claims 3 vertex \(84 bytes\)"),
        "text of words": (header(BASE, form="ascii").encode() + b"a " * 14, r"must be a readable PLY, got"),
        "missing": (header(BASE[:-2]).encode() + b"\0" * 48, r"vertex columns .*rot_2, rot_3 missing; export"),
        "points": (point_cloud[0].encode() + point_cloud[1], r"plain point cloud, fit Gaussians with `drgs fit`"),
        "packed": (packed[0].encode() + packed[1], r"PlayCanvas' compressed layout"),
        "no vertex": (header(BASE, element="face").encode() + b"\0" * 56, r"must have an element `vertex`"),
        "f_rest": (header([*BASE, "f_rest_0"]).encode() + b"\0" * 60, r"0, 9, 24, 45 or 72 columns .*, got 1;"),
        "header": (b"ply\nformat binary_little_endian 1.0\nelement vertex -3\nend_header\n", r"well-formed, got 'ele"),
        "NaN": (header(BASE).encode() + nan.tobytes(), r"log_scales must be finite, got .* at index 0"),
        "quaternion": (header(BASE).encode() + b"\0" * 56, r"quats must not be 0"),
    }  # fmt: skip
    for name, (data, message) in cases.items():
        path = tmp_path / "bad.ply"
        path.write_bytes(data)
        with pytest.raises(ValueError, match=message) as caught:
            load_ply(path)
        assert str(caught.value).startswith(str(path)), name
        assert "\n" not in str(caught.value), name
    with pytest.raises(FileNotFoundError, match=r"none\.ply: must be a PLY file, found none"):
        load_ply(tmp_path / "none.ply")


def test_lists_and_empty_rows_claim_nothing(tmp_path):
    """A list says how long it is where no header does, rows without a column take no byte: neither is believed."""
    from drgs.codecs.ply_headers import ply_source

    write(tmp_path / "a.ply", header(["x"]).replace("property float x", "property list uint float x"), b"\xff" * 8)
    with pytest.raises(ValueError, match="a 3DGS PLY must have the vertex columns"):
        load_ply(tmp_path / "a.ply")
    # plyfile would ask a file for 16 GiB; of memory it gets what is there.
    assert ply_source(tmp_path / "a.ply").read(1 << 34) == (tmp_path / "a.ply").read_bytes()
    path = tmp_path / "whole.ply"
    save_ply(gaussians(), path)
    assert ply_source(path) == str(path)
    for change in (b"element face 4000000000\n", b"element face 4000000000\nelement other 0\nproperty float x\n"):
        (tmp_path / "b.ply").write_bytes(path.read_bytes().replace(b"end_header", change + b"end_header"))
        with pytest.raises(ValueError, match="element 'face' of a PLY must have a property, has none"):
            load_ply(tmp_path / "b.ply")


@pytest.mark.parametrize("kind", [b"uchar", b"list uchar float"])
def test_numbers_that_are_none_of_their_type(tmp_path, kind):
    """Text that says -1 or a fraction where a byte is meant, and a list where a number is: one line."""
    import plyfile

    save_ply(gaussians(), tmp_path / "a.ply")
    ply = plyfile.PlyData.read(str(tmp_path / "a.ply"), mmap=False)
    plyfile.PlyData(ply.elements, text=True).write(str(tmp_path / "b.ply"))
    data = (tmp_path / "b.ply").read_bytes().replace(b"property float x", b"property " + kind + b" x")
    (tmp_path / "b.ply").write_bytes(data.replace(b"end_header\n", b"end_header\n-1 ", 1))
    with pytest.raises(ValueError, match="b.ply: must be a readable PLY, got") as error:
        load_ply(tmp_path / "b.ply")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["float", "double"])
def test_infinite_logits_are_opacities_of_0_and_1(tmp_path, caplog, kind):
    """As splat-transform writes them: read as finite logits that float32 rounds to these, and counted."""
    values = np.ones((5, len(BASE)), "<f4" if kind == "float" else "<f8")
    logits = [np.inf, -3.25, -np.inf, np.inf, 90.0]
    values[:, BASE.index("opacity")] = logits
    path = write(tmp_path / "a.ply", header(BASE, 5, kind), values.tobytes())
    g = load_ply(path)
    assert caplog.messages == [
        f"{path}: 3 of 5 opacities are 0 or 1 (infinite logits), read as logits of -104.7 and 18.0"
    ]
    torch.testing.assert_close(g.logit_opacities, torch.tensor([18.0218, -3.25, -104.6652, 18.0218, 90.0]))
    assert g.opacities[[0, 2, 3]].tolist() == [1, 0, 1]
    assert g.logit_opacities[[1, 4]].tolist() == [-3.25, 90.0]  # a large one is a number
    save_ply(g, tmp_path / "b.ply")
    caplog.clear()
    assert torch.equal(load_ply(tmp_path / "b.ply").logit_opacities, g.logit_opacities)
    assert not caplog.messages


def test_a_logit_that_is_no_number_is_refused(tmp_path, caplog):
    """Beside infinite ones, too; so is whatever else is infinite."""
    for column, value in (("opacity", np.nan), ("scale_1", np.inf), ("x", -np.inf)):
        values = np.ones((3, len(BASE)), "<f4")
        values[0, BASE.index("opacity")] = np.inf
        values[2, BASE.index(column)] = value
        path = write(tmp_path / "a.ply", header(BASE, 3), values.tobytes())
        with pytest.raises(ValueError, match="must be finite, got .* at index 2 "):
            load_ply(path)


def test_saving_refuses_what_is_not_finite_and_keeps_the_old_file(tmp_path):
    """A bad save leaves the file that was there."""
    g = gaussians()
    save_ply(g, tmp_path / "a.ply")
    before = (tmp_path / "a.ply").read_bytes()
    bad = g.replace(means=g.means.clone())
    bad.means[3, 1] = torch.inf
    with pytest.raises(ValueError, match="save_ply: means must be finite, got .* at index 3"):
        save_ply(bad, tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_bytes() == before
    assert os.listdir(tmp_path) == ["a.ply"]


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("wolf/wolf.ply", 90_586),
        ("train_1000/train-1000.ply", 1_000),
        ("pc_short/pc_short.ply", 100),
        ("three_points/test-splat.3-points-from-train.ply", 3),
    ],
)
def test_real_files_round_trip(data_dir, tmp_path, name, count):
    """Files that other programs wrote come back bit for bit, all columns of them."""
    path = data_dir / "splats" / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    g = load_ply(path)
    assert (len(g), g.sh_degree) == (count, 3)
    save_ply(g, tmp_path / "a.ply")
    body = path.read_bytes().split(b"end_header\n", 1)[1]
    table = np.frombuffer(body[: count * 248], "<f4").reshape(count, 62).copy()  # pc_short goes on
    table[:, 3:6] = 0  # normals, which mean nothing here; 0 in INRIA's own files
    assert (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)[1] == table.tobytes()


def test_state_round_trips(tmp_path):
    """Tensors come back bit for bit, generator states included, with their header."""
    state = {"means": torch.randn(3, 3), "rng": torch.get_rng_state()}
    save_state(tmp_path / "s.safetensors", state, {"step": 7})
    tensors, head = load_state(tmp_path / "s.safetensors")
    assert head == {"schema": files.SCHEMA, "step": 7}
    assert all(torch.equal(tensors[name], value) for name, value in state.items())


def test_a_state_is_no_view_of_its_file(tmp_path):
    """Who has loaded a checkpoint keeps its values, whatever is copied over the file afterwards: a viewer of a run goes
    on. Mapped memory would end the process.
    """
    x = torch.arange(1 << 20, dtype=torch.float32)
    save_state(tmp_path / "a.safetensors", {"x": x}, {})
    code = """if True:
        import os, sys
        from drgs.files import load_state
        tensors, _ = load_state(sys.argv[1])
        os.truncate(sys.argv[1], 0)
        print(float(tensors["x"][-1]))
    """
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.safetensors"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, f"{float(x[-1])}\n"), done.stderr[-300:]


def test_bad_states_are_refused(tmp_path):
    """Missing, damaged and foreign checkpoints each have their line."""
    path = tmp_path / "s.safetensors"
    with pytest.raises(FileNotFoundError, match="must be a checkpoint, found none"):
        load_state(path)
    save_state(path, {"x": torch.zeros(100)}, {})
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(ValueError, match="must be a checkpoint, got"):
        load_state(path)
    path.write_bytes((10**12).to_bytes(8, "little") + b"{}")
    with pytest.raises(ValueError, match="must be a checkpoint, got"):
        load_state(path)
    from safetensors.torch import save_file

    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(ValueError, match="checkpoint schema must be 1, got None"):
        load_state(path)


def test_killed_writer_leaves_the_old_file(tmp_path):
    """A process that dies in the middle of a write leaves the complete old file under its name."""
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    code = (
        "import os, sys; from drgs.files import atomic_write\n"
        "with atomic_write(sys.argv[1]) as f:\n"
        "    f.write(b'n' * 100000); f.flush(); os._exit(9)"
    )
    assert subprocess.run([sys.executable, "-c", code, path], check=False).returncode == 9
    assert path.read_bytes() == b"old"


def test_run_folder(tmp_path):
    """Config and environment are recorded, events appended, and a run is not overwritten by accident."""
    run = Run(tmp_path / "runs" / "a")
    run.start({"seed": 3})
    run.log("step", step=1, loss=0.5)
    with (run.path / "log.jsonl").open("ab") as file:
        file.write(b'{"schema": 1, "eve')  # killed while writing
    assert [e["event"] for e in run.events()] == ["step"]
    with pytest.raises(ValueError, match="must be a new run folder, holds a run already; add --resume"):
        run.start({"seed": 4})
    assert run.config() == {"schema": 1, "seed": 3}
    run.start({"seed": 3}, resume=True)
    run.log("resume", step=1)
    assert [e["event"] for e in run.events()] == ["step", "resume"]
    assert {"backend", "packages", "cpu", "commit"} <= set(json.loads((run.path / "env.json").read_text()))


def test_bad_run_folders_are_refused(tmp_path):
    """No run, a damaged config and a newer schema each have their line."""
    with pytest.raises(FileNotFoundError, match="must be a run folder, found no config.json"):
        Run(tmp_path).config()
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ValueError, match="must be valid JSON"):
        Run(tmp_path).config()
    (tmp_path / "config.json").write_text('{"schema": 99}')
    with pytest.raises(ValueError, match="schema must be 1 or 2, got 99"):
        Run(tmp_path).config()
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="must be a folder, is a file"):
        Run(tmp_path / "file").start({})


def test_json_refuses_nan(tmp_path):
    """A metric that is not a number must be null with a reason, never NaN in a file."""
    with pytest.raises(ValueError, match="Out of range float"):
        files.write_json(tmp_path / "a.json", {"psnr": float("nan")})
    assert not (tmp_path / "a.json").exists()
