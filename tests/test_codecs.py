"""Claims of drgs.codecs: every format gives the Gaussians that its layout states, within the step of each field.

The files are made by tests/splat_samples.py from the layouts, with code of its own.
"""

from __future__ import annotations

import gzip
import logging
import struct

import numpy as np
import pytest
import splat_encoders as encode
import torch
from splat_samples import NAMES, N, glb_document, smallest_three, sog_scene, unit, write_sample

import drgs
from drgs.codecs import CODECS, Codec, load_gaussians, readable, save_gaussians
from drgs.codecs.bounded import pixels_of_webp
from drgs.codecs.values import flipped, logits_of_bytes, logits_of_opacities
from drgs.oracle import sh_basis

pytestmark = pytest.mark.core

# What a quaternion's components may be off by: half a step of the format, and what that does to the one that is left
# out.
_QUATS = {
    "v2.spz": 0.02, "v3.spz": 0.003, "v4.spz": 0.003, "raw.spz": 0.003, "a.splat": 0.012, "0.ksplat": 1e-6,
    "1.ksplat": 1e-3, "2.ksplat": 1e-3, "packed.ply": 0.003, "a.sog": 0.012, "a.glb": 1e-6,
}  # fmt: skip
_SH = {"1.ksplat": 5e-4, "2.ksplat": 3 / 255 / 2 + 1e-6}  # half floats, and half a step of 255 between -1.5 and 1.5


def numbers(g, name):
    return getattr(g, name).double().numpy()


@pytest.mark.parametrize("name", NAMES)
def test_every_format_gives_what_its_layout_states(tmp_path, rng, name):
    """Means, scales and opacities to float32; rotations and SH to half a step of what the file stores."""
    fields = write_sample(tmp_path / name, name, rng)
    g = load_gaussians(tmp_path / name)
    assert {x.dtype for x in g.parameters().values()} == {torch.float32}
    for key in ("means", "log_scales", "logit_opacities"):
        np.testing.assert_allclose(numbers(g, key), fields[key], rtol=2e-6, atol=2e-6, err_msg=key)
    np.testing.assert_allclose(numbers(g, "sh"), fields["sh"], rtol=1e-6, atol=_SH.get(name, 2e-6))
    found, wanted = numbers(g, "quats"), fields["quats"]
    signs = np.sign((found * wanted).sum(1, keepdims=True))
    np.testing.assert_allclose(found * signs, wanted, atol=_QUATS[name])


@pytest.mark.parametrize("name", NAMES)
def test_the_format_is_found_by_what_the_file_holds(tmp_path, rng, name):
    """Another suffix changes nothing, but for the two formats that have no mark."""
    write_sample(tmp_path / name, name, rng)
    (tmp_path / name).rename(tmp_path / "scene.bin")
    if name.endswith("splat"):
        with pytest.raises(ValueError, match=r"is of no format that is known; what is read: \.ply, \.spz, \.splat, .*"):
            load_gaussians(tmp_path / "scene.bin")
    else:
        assert len(load_gaussians(tmp_path / "scene.bin")) >= N


def test_bytes_at_the_ends_stay_finite_and_go_back_to_themselves(tmp_path):
    """Opacity 0 and 255 become the middle of what rounds to them; every byte is written as it was read."""
    found = logits_of_bytes(np.arange(256))
    assert np.isfinite(found).all()
    assert np.array_equal(np.rint(255 / (1 + np.exp(-found))), np.arange(256))
    np.testing.assert_allclose(found[[0, 255]], [-6.926, 6.926], atol=1e-3)
    floats = logits_of_opacities(np.array([0.0, 0.25, 1.0, np.nan, -0.1, 1.1], np.float32))
    assert np.isfinite(floats[:3]).all()
    assert np.isnan(floats[3:]).all()
    assert (1 / (1 + np.exp(-floats[:3]))).astype(np.float32).tolist() == [0.0, 0.25, 1.0]


@pytest.mark.parametrize("signs", [(1, -1, -1), (-1, -1, 1), (1, 1, -1), (-1, 1, 1)])
def test_turning_axes_turns_everything(rng, signs):
    """Covariances are mirrored, and the color toward a mirrored direction is the color toward the direction."""
    quats = torch.from_numpy(unit(rng))
    tensors = [torch.from_numpy(rng.normal(size=shape)) for shape in ((N, 3), (N, 3), (N,), (N, 16, 3))]
    g = drgs.Gaussians(tensors[0], quats, *tensors[1:])
    t, S = flipped(g, signs), torch.tensor(signs, dtype=torch.float64).diag()
    axes, other = (drgs.ellipsoids.semi_axes(x.quats, x.scales) for x in (g, t))
    torch.testing.assert_close(S @ axes @ axes.mT @ S, other @ other.mT)
    torch.testing.assert_close(g.means @ S, t.means)
    d = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(40, 3))), dim=1)
    for degree in range(4):
        k = (degree + 1) ** 2
        toward = torch.einsum("dk,nkc->ndc", sh_basis(d, k), g.sh[:, :k])
        turned_sh = flipped(g.replace(sh=g.sh[:, :k]), signs).sh
        torch.testing.assert_close(toward, torch.einsum("dk,nkc->ndc", sh_basis(d @ S, k), turned_sh))


def test_spz_as_stored_keeps_the_axes_of_the_file(tmp_path, rng):
    """What a writer stored without the turn is had back; the turn is its own inverse."""
    write_sample(tmp_path / "a.spz", "v3.spz", rng)
    stored, turned_ = load_gaussians(tmp_path / "a.spz", as_stored=True), load_gaussians(tmp_path / "a.spz")
    assert torch.equal(stored.means, turned_.means * torch.tensor([1.0, -1, -1]))
    assert torch.equal(flipped(stored, (1, -1, -1)).sh, turned_.sh)


def test_spz_extensions_and_degree_4(tmp_path, rng, caplog):
    """An orbit's limits change no value; another extension may; coefficients of degree 4 are named and left out."""
    zeros = {k: np.zeros((2, k), np.uint8) for k in (1, 3, 72)}
    body = encode.spz_body(np.zeros((2, 3), int), zeros[1], zeros[3], zeros[3], np.zeros(2, "<u4"), zeros[72])
    (tmp_path / "a.spz").write_bytes(encode.spz_file(3, 4, body, 2))
    with caplog.at_level(logging.WARNING):
        assert load_gaussians(tmp_path / "a.spz").sh_degree == 3
    assert "left out the SH coefficients of degree 4" in caplog.text
    for kind, is_read in ((0xADBE0002, True), (0xADBE0003, False)):
        record = struct.pack("<IIfff", kind, 12, 0, 1, 2)
        (tmp_path / "b.spz").write_bytes(encode.spz_file(3, 4, body + record, 2, flags=2))
        parts = [
            encode.spz_body(np.zeros((2, 3), int), b"", b"", b"", b"", b""),
            bytes(2),
            bytes(6),
            bytes(6),
            bytes(8),
        ]
        (tmp_path / "c.spz").write_bytes(encode.spz_file_4(0, parts, 2, extensions=record))
        for name in ("b.spz", "c.spz"):
            if is_read:
                assert len(load_gaussians(tmp_path / name)) == 2
            else:
                with pytest.raises(ValueError, match="has the SPZ extension 0xadbe0003, which may change"):
                    load_gaussians(tmp_path / name)


@pytest.mark.parametrize(
    ("comments", "said"),
    [
        (("SplatRenderMode: mip",), True),
        (("splatrendermode: MIP ",), True),
        (("antialiased 1",), True),
        (("SplatRenderMode: mip", "SplatRenderMode: default"), False),
        (("antialiased 1", "antialiased 0"), False),
        (("SplatRenderMode: default",), False),
        (("no SplatRenderMode: mip", "antialiased 10"), False),
        ((), False),
    ],
)
def test_a_ply_for_antialiased_rasterization_is_named(tmp_path, caplog, comments, said):
    """By Brush's and gsplat's comment, and Postshot's; the last one counts."""
    g = drgs.Gaussians.from_arrays(np.zeros((1, 3)), [[1.0, 0, 0, 0]], np.ones((1, 3)), [0.5], np.zeros((1, 3)))
    drgs.save_ply(g, tmp_path / "a.ply", comments=comments)
    load_gaussians(tmp_path / "a.ply")
    assert ("was fitted by antialiased rasterization" in caplog.text) == said


def test_an_spz_for_antialiased_rasterization_is_named(tmp_path, caplog):
    """By its flag, in versions 3 and 4; what is written has none."""
    parts = [bytes(2 * x) for x in (9, 1, 3, 3, 4)]
    for flags in (0, 1):
        caplog.clear()
        for name, data in (
            ("a.spz", encode.spz_file(3, 0, b"".join(parts), 2, flags=flags)),
            ("b.spz", encode.spz_file_4(0, parts, 2, flags=flags)),
        ):
            (tmp_path / name).write_bytes(data)
            g = load_gaussians(tmp_path / name)
        assert len(caplog.messages) == 2 * flags
    caplog.clear()
    save_gaussians(g, tmp_path / "c.spz")
    load_gaussians(tmp_path / "c.spz")
    assert not caplog.messages


def test_a_sog_for_antialiased_rasterization_is_named(tmp_path, rng, caplog):
    """By what its meta.json says; what is written says it is not."""
    meta, images, _ = sog_scene(rng, version=2, degree=1)
    for antialias in (False, True):
        caplog.clear()
        (tmp_path / "a.sog").write_bytes(encode.zipped(encode.sog_files(meta | {"antialias": antialias}, images)))
        g = load_gaussians(tmp_path / "a.sog")
        assert caplog.text.count("a.sog: was fitted by antialiased rasterization") == antialias
    caplog.clear()
    save_gaussians(g, tmp_path / "b.sog")
    load_gaussians(tmp_path / "b.sog")
    assert not caplog.messages


def test_what_is_said_of_files_for_antialiased_rasterization():
    """A Gaussian of a tenth of a pixel has over 10 times the alpha in gsplat that is meant, summed (measured: 33)."""
    camera = drgs.cameras.orbit((0, 0, 0), 2.0, 1, width=32, height=32)[0]
    size = 0.1 * 2.0 / camera.K[0, 0]
    g = drgs.Gaussians.from_arrays(np.zeros((1, 3)), [[1.0, 0, 0, 0]], np.full((1, 3), size), [0.5], np.zeros((1, 3)))
    splats = {name: getattr(g, name) for name in ("means", "quats", "scales", "opacities")} | {
        "colors": torch.ones(1, 3)
    }
    pose, K = (torch.tensor(x, dtype=torch.float32)[None] for x in (camera.w2c, camera.K))
    classic, meant = (
        drgs.rasterization(**splats, viewmats=pose, Ks=K, width=32, height=32, rasterize_mode=mode)[1].sum()
        for mode in ("classic", "antialiased")
    )
    assert float(classic / meant) > 10


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("degree", [1, 3])
def test_sog_in_a_folder_in_an_archive_and_of_version_1(tmp_path, rng, version, degree):
    """A folder, its meta.json, an archive with or without a folder inside: the same bits."""
    meta, images, fields = sog_scene(rng, version=version, degree=degree)
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, data in encode.sog_files(meta, images).items():
        (folder / name).write_bytes(data)
    (tmp_path / "a.sog").write_bytes(encode.zipped(encode.sog_files(meta, images)))
    (tmp_path / "b.zip").write_bytes(encode.zipped(encode.sog_files(meta, images), prefix="scene/"))
    paths = (folder, folder / "meta.json", tmp_path / "a.sog", tmp_path / "b.zip")
    first, *others = (load_gaussians(path) for path in paths)
    for key in ("means", "log_scales", "logit_opacities", "sh"):
        np.testing.assert_allclose(numbers(first, key), fields[key], rtol=2e-6, atol=2e-6, err_msg=key)
    for other in others:
        assert all(torch.equal(x, other.parameters()[name]) for name, x in first.parameters().items())


def test_lossless_webp_is_read_byte_for_byte(rng):
    """Also RGB where alpha is 0, which image libraries like to change."""
    pixels = rng.integers(0, 256, (19, 23, 4), dtype=np.uint8)
    pixels[:9, :, 3] = 0
    assert np.array_equal(pixels_of_webp("a", encode.webp(pixels), 1, 10**6), pixels)
    opaque = pixels_of_webp("a", encode.webp(pixels[..., :3].copy()), 1, 10**6)
    assert np.array_equal(opaque[..., :3], pixels[..., :3])
    assert (opaque[..., 3] == 255).all()


def test_compressed_ply_without_color_ranges(tmp_path, rng):
    """As older programs write it: colors are bytes between 0 and 1, and there is no SH."""
    chunk = np.array([[0, 0, 0, 1, 1, 1, -5, -5, -5, 0, 0, 0]])
    vertices = np.array([[0, 0, 0, 0xFF008040]], np.int64)
    (tmp_path / "a.ply").write_bytes(encode.packed_ply_file(chunk, vertices, colors=False))
    g = load_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(g.sh[0, 0].numpy() * 0.28209479 + 0.5, [1, 0, 128 / 255], atol=1e-6)
    assert torch.sigmoid(g.logit_opacities[0]).item() == pytest.approx(64 / 255)


def test_glb_of_other_number_types_and_of_the_draft(tmp_path, rng, caplog):
    """Normalized 16-bit rotations and opacities in bytes; log scales of the review draft are known by their sign."""
    document, buffer, fields = glb_document(rng)
    names = document["meshes"][0]["primitives"][0]["attributes"]
    quats = np.round(fields["quats"][:, [1, 2, 3, 0]] * [-1, -1, 1, 1] * 32767).astype("<i2")
    opacity = np.array([0, 51, 102, 153, 255], np.uint8)
    for key, x, kind in (("ROTATION", quats, 5122), ("OPACITY", opacity, 5121)):
        index = names[f"KHR_gaussian_splatting:{key}"]
        document["accessors"][index] |= {"componentType": kind, "normalized": True}
        document["bufferViews"][index] = {"buffer": 0, "byteOffset": len(buffer), "byteLength": x.nbytes}
        buffer += x.tobytes()
    (tmp_path / "a.glb").write_bytes(encode.glb_file(document, buffer))
    g = load_gaussians(tmp_path / "a.glb")
    found = np.sign((numbers(g, "quats") * fields["quats"]).sum(1, keepdims=True)) * numbers(g, "quats")
    np.testing.assert_allclose(found, fields["quats"], atol=2e-5)
    assert torch.isfinite(g.logit_opacities).all()
    np.testing.assert_allclose(g.opacities.numpy(), [0, 0.2, 0.4, 0.6, 1], atol=1e-6)
    log_scales = rng.uniform(-5, -1, (N, 3)).astype("<f4")
    at = document["bufferViews"][names["KHR_gaussian_splatting:SCALE"]]["byteOffset"]
    (tmp_path / "b.glb").write_bytes(encode.glb_file(document, buffer[:at] + log_scales.tobytes() + buffer[at + 60 :]))
    with caplog.at_level(logging.WARNING):
        assert np.array_equal(load_gaussians(tmp_path / "b.glb").log_scales.numpy(), log_scales)
    assert "taken for log scales" in caplog.text


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_comes_back(tmp_path, rng, name):
    """Any scene to .ply, bit for bit; to .glb to float32; to .spz to its steps, from where it no longer changes."""
    write_sample(tmp_path / name, name, rng)
    g = load_gaussians(tmp_path / name)
    in_range = g.log_scales.amin() >= -10  # of SPZ
    for suffix in ("ply", "glb", "spz"):
        save_gaussians(g, tmp_path / f"b.{suffix}")
    ply, glb, spz = (load_gaussians(tmp_path / f"b.{suffix}") for suffix in ("ply", "glb", "spz"))
    assert all(torch.equal(x, ply.parameters()[key]) for key, x in g.parameters().items())
    for key in ("means", "sh"):
        assert torch.equal(getattr(glb, key), getattr(g, key)), key
    torch.testing.assert_close(glb.log_scales, g.log_scales, rtol=1e-5, atol=2e-7)
    torch.testing.assert_close(glb.opacities, g.opacities, rtol=0, atol=1e-7)
    unit_quats = torch.nn.functional.normalize(g.quats)
    torch.testing.assert_close(glb.quats, unit_quats, rtol=0, atol=1e-6)
    torch.testing.assert_close(spz.means, g.means, rtol=0, atol=0.5 / 4096)
    if in_range:
        torch.testing.assert_close(spz.log_scales, g.log_scales, rtol=0, atol=1 / 32 + 1e-6)
    torch.testing.assert_close(spz.opacities, g.opacities, rtol=0, atol=0.5 / 255 + 1e-6)
    assert ((spz.quats * unit_quats).sum(1).abs() > 1 - 1e-5).all()
    save_gaussians(spz, tmp_path / "c.spz")
    assert (tmp_path / "c.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


@pytest.mark.parametrize("tied", [False, True])
def test_spz_goes_back_to_its_bits(tmp_path, rng, tied):
    """Version 3 with SH of 8 bits: load and save give the stream back. Where two components are as large as each other,
    a rotation has two codes, of which one is sometimes another's rounding; from then on nothing changes.
    """
    n = 4000
    arrays = [rng.integers(0, 256, (n, k), dtype=np.uint8) for k in (1, 3, 3)]
    quats = unit(rng, n)
    if tied:
        quats[:, 1] = quats[:, 0] * rng.choice([-1, 1], n)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    stored = np.array([smallest_three(q) for q in quats], "<u4")
    sh = rng.integers(0, 256, (n, 9), dtype=np.uint8)
    body = encode.spz_body(rng.integers(-(1 << 23) + 1, 1 << 23, (n, 3)), *arrays, stored, sh)
    (tmp_path / "a.spz").write_bytes(encode.spz_file(3, 1, body, n))
    for old, new in ("ab", "bc"):
        save_gaussians(load_gaussians(tmp_path / f"{old}.spz"), tmp_path / f"{new}.spz")
    first, second = (gzip.decompress((tmp_path / f"{name}.spz").read_bytes())[16:] for name in "bc")
    assert first == second
    other = np.frombuffer(first, np.uint8) != np.frombuffer(body, np.uint8)
    assert other.sum() <= (4 * 4 if tied else 0)  # bytes; four rotations of 4,000


def test_spz_says_what_it_cannot_hold(tmp_path, rng, caplog):
    """Scales and SH out of range go to its ends; far scenes get fewer bits behind the point; features are left out."""
    g = drgs.Gaussians(*(torch.full(shape, 3.0) for shape in ((3, 3), (3, 4), (3, 3), (3,), (3, 4, 3))))
    g = g.replace(means=g.means * 1e5, log_scales=torch.tensor([[12.0], [3.0], [3.0]]).repeat(1, 3))
    g = g.replace(features=torch.zeros(3, 7))
    with caplog.at_level(logging.WARNING):
        save_gaussians(g, tmp_path / "a.spz")
    for text in ("3 log scales were out", "27 SH coefficients were out", "left out the 7 semantic features"):
        assert text in caplog.text
    back = load_gaussians(tmp_path / "a.spz")
    assert (back.means - g.means).abs().max() <= 2.0**-5  # 4 bits behind the point are left of 24
    assert back.log_scales.max() == 255 / 16 - 10
    with pytest.raises(ValueError, match=r"holds means up to 2\^23 from 0, got 3e\+10"):
        save_gaussians(g.replace(means=g.means * 1e5), tmp_path / "b.spz")
    far = drgs.Gaussians(
        *(torch.ones(shape) for shape in ((1, 3), (1, 4), (1, 3), (1,), (1, 1, 3))), origin=np.full(3, 7.0)
    )
    save_gaussians(far, tmp_path / "c.glb")
    back = load_gaussians(tmp_path / "c.glb")
    assert back.means.tolist() == [[1.0, 1.0, 1.0]]
    assert back.origin.tolist() == [7.0, 7.0, 7.0]


def test_activations_beyond_what_a_format_holds(tmp_path):
    """Logits of +-1000 and tiny scales come back finite; a scale that no float32 holds is refused for .glb, and in .spz
    scales of which half are out of its range.
    """
    g = drgs.Gaussians(*(torch.ones(shape) for shape in ((3, 3), (3, 4), (3, 3), (3,), (3, 1, 3))))
    g = g.replace(logit_opacities=torch.tensor([-1000.0, 0, 1000]), log_scales=torch.full((3, 3), -200.0))
    for suffix in ("spz", "glb"):
        held = g if suffix == "glb" else g.replace(log_scales=torch.tensor([[-200.0, -200.0, -4.0]]).repeat(3, 1))
        save_gaussians(held, tmp_path / f"a.{suffix}")
        back = load_gaussians(tmp_path / f"a.{suffix}")
        np.testing.assert_allclose(back.opacities.numpy(), [0, 0.5, 1], atol=0.5 / 255)
        assert torch.isfinite(back.log_scales).all()
    with pytest.raises(
        ValueError, match=r"SPZ must have standard deviations of 4\.5e-05 to 3\.8e\+02 units, got 1\.4e-87"
    ):
        save_gaussians(g, tmp_path / "b.spz")
    with pytest.raises(ValueError, match="a log scale above 88 is none"):
        save_gaussians(g.replace(log_scales=torch.full((3, 3), 1000.0)), tmp_path / "b.glb")
    assert not (tmp_path / "b.glb").exists()


def test_scenes_of_no_gaussians(tmp_path):
    """What PLY can hold, most others can; those that cannot say so, and write nothing."""
    g = drgs.Gaussians(*(torch.zeros(shape) for shape in ((0, 3), (0, 4), (0, 3), (0,), (0, 4, 3))))
    for suffix in ("ply", "spz", "glb", "compressed.ply"):
        save_gaussians(g, tmp_path / f"a.{suffix}")
        assert len(load_gaussians(tmp_path / f"a.{suffix}")) == 0
    for suffix in ("sog", "splat"):
        with pytest.raises(ValueError, match=rf"\.{suffix} must hold .*1.* got (0|none); write a PLY|one Gaussian"):
            save_gaussians(g, tmp_path / f"a.{suffix}")
        assert not (tmp_path / f"a.{suffix}").exists()


def load_rows(path):
    """Gaussians of a file that begins with ROWS: 14 float32 each, SH of degree 0."""
    rows = torch.from_numpy(np.frombuffer(path.read_bytes()[4:], np.float32).reshape(-1, 14).copy())
    means, quats, log_scales, logits, dc = rows.split([3, 4, 3, 1, 3], dim=1)
    return drgs.Gaussians(means, quats, log_scales, logits[:, 0], dc[:, None])


def encode_rows(g):
    """What `load_rows` reads."""
    columns = [g.means, g.quats, g.log_scales, g.logit_opacities[:, None], g.sh[:, 0]]
    return b"ROWS" + torch.cat(columns, dim=1).numpy().tobytes()


def test_a_codec_of_a_script(tmp_path, rng, capsys):
    """A row of the table is enough: files are told by their mark, `drgs convert` reads and writes them."""
    write_sample(tmp_path / "a.splat", "a.splat", rng)
    rows, ply = tmp_path / "a.rows", tmp_path / "b.ply"
    assert drgs.cli.main(["convert", str(tmp_path / "a.splat"), str(rows), "--quiet"]) == 2
    assert "a.rows must end with .ply, .compressed.ply, .spz, .splat, .sog, .glb, got .rows" in capsys.readouterr().err
    CODECS["rows"] = Codec(".rows", load_rows, lambda path, head: head.startswith(b"ROWS"), encode=encode_rows)
    try:
        assert drgs.cli.main(["convert", str(tmp_path / "a.splat"), str(rows), "--quiet"]) == 0
        rows.rename(tmp_path / "a.bin")
        assert drgs.cli.main(["convert", str(tmp_path / "a.bin"), str(ply), "--quiet"]) == 0
        assert ".glb, .pt and .rows, a SOG folder" in readable()
    finally:
        del CODECS["rows"]
    found, wanted = drgs.load_ply(ply).parameters(), load_gaussians(tmp_path / "a.splat").parameters()
    assert all(torch.equal(x, found[name]) for name, x in wanted.items())
    with pytest.raises(ValueError, match="is of no format that is known"):
        load_gaussians(tmp_path / "a.bin")
