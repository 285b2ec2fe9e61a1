"""Files that other programs wrote: the same asset in several formats agrees within the step of each."""

from __future__ import annotations

import gzip

import pytest
import torch

import drgs
from drgs.codecs import load_gaussians, save_gaussians

pytestmark = pytest.mark.real_data
MINIMAL = ("minimal.splat", "minimal.ksplat", "minimal-v3.spz", "minimal-v4.spz", "minimal-v2.spz", "minimal-raw.spz")


def splats(data_dir, name):
    path = data_dir / "splats" / name
    if not path.exists():
        pytest.skip(f"no {path}")
    return path


def off(a, b) -> dict[str, float]:
    """The largest difference of each field: opacities as such, quaternions by 1 - |cosine|."""
    unit = [torch.nn.functional.normalize(x.quats) for x in (a, b)]
    fields = {name: (getattr(a, name) - getattr(b, name)).abs().max() for name in ("means", "log_scales", "opacities")}
    fields |= {"quats": (1 - (unit[0] * unit[1]).sum(1).abs()).max(), "dc": (a.sh[:, 0] - b.sh[:, 0]).abs().max()}
    k = min(a.sh.shape[1], b.sh.shape[1])
    return {name: float(x) for name, x in fields.items()} | {"sh": float((a.sh[:, :k] - b.sh[:, :k]).abs().max())}


def test_wolf_spz_and_its_ply(data_dir):
    """All numbers agree to float32, but for opacities of byte 255, of which the PLY has the lower end.

    The PLY holds the file's own axes, right up back: whoever made it left out the turn.
    """
    spz, ply = splats(data_dir, "wolf/wolf.spz"), drgs.load_ply(splats(data_dir, "wolf/wolf.ply"))
    g = load_gaussians(spz, as_stored=True)
    found = off(g, ply)
    assert max(found[name] for name in ("means", "log_scales", "dc", "sh")) == 0
    assert found["quats"] < 1e-6
    assert found["opacities"] * 255 == pytest.approx(0.25, abs=1e-3)
    turned = load_gaussians(spz)
    assert torch.equal(turned.means, g.means * torch.tensor([1.0, -1, -1]))


def test_three_points(data_dir):
    """A trained PLY, its .splat and its .spz, which has other axes."""
    name = "three_points/test-splat.3-points-from-train"
    ply, splat, spz = (load_gaussians(splats(data_dir, f"{name}.{x}")) for x in ("ply", "splat", "spz"))
    found = off(ply, splat)
    assert found["means"] == found["log_scales"] == 0
    assert found["opacities"] * 255 < 1  # that writer cuts digits off
    assert found["dc"] * 0.2820948 * 255 < 1
    assert found["quats"] < 5e-5
    found = off(ply, spz)
    assert found["means"] * 4096 < 0.51
    assert found["log_scales"] * 16 < 0.51
    assert found["opacities"] * 255 < 0.51
    assert found["dc"] * 0.15 * 255 < 0.51
    assert found["quats"] < 1e-6
    assert found["sh"] * 128 < 8.5  # 4 bits: half of 16 steps, and rounding


def test_three_points_go_back_to_their_bits(data_dir, tmp_path):
    """Another program's version 3, loaded and saved: the same stream."""
    path = splats(data_dir, "three_points/test-splat.3-points-from-train.spz")
    save_gaussians(load_gaussians(path), tmp_path / "a.spz")
    assert gzip.decompress((tmp_path / "a.spz").read_bytes()) == gzip.decompress(path.read_bytes())


@pytest.mark.parametrize("name", MINIMAL)
def test_minimal(data_dir, name):
    """Four round Gaussians in six files; those of SPZ version 2 were made by hand, with other colors and axes."""
    g, one = (load_gaussians(splats(data_dir, f"minimal/{x}")) for x in (name, "minimal.splat"))
    found = off(g.replace(quats=one.quats), one)  # a rotation of something round says nothing, and they differ
    by_hand = name in ("minimal-v2.spz", "minimal-raw.spz")
    if by_hand:
        found = off(load_gaussians(splats(data_dir, f"minimal/{name}"), as_stored=True).replace(quats=one.quats), one)
    assert found["means"] == 0
    assert found["opacities"] * 255 < 1e-3
    assert found["log_scales"] * 16 < 0.51
    assert found["dc"] == pytest.approx(0.5203, abs=1e-3) if by_hand else found["dc"] * 0.15 * 255 < 0.51


@pytest.mark.parametrize(("level", "count"), [("3_0", 31000), ("4_0", 8406), ("5_0", 3000), ("6_0", 1873)])
def test_playbot(data_dir, level, count):
    """Unbundled SOG with SH: levels of one object, in one place."""
    g = load_gaussians(splats(data_dir, f"playcanvas_engine/playbot/{level}"))
    assert (len(g), g.sh_degree) == (count, 2)
    low, high = torch.tensor([-1.04, -1.09, -1.04]), torch.tensor([1.04, 0.05, 1.04])
    assert ((g.means > low) & (g.means < high)).all()
    assert float(g.sh[:, 1:].abs().max()) > 0.1


@pytest.mark.parametrize(("name", "count"), [("angel", 71359), ("angel-kneeling", 83547), ("massa", 58649)])
def test_statues(data_dir, name, count):
    """Bundled SOG, drawn upright: the head is narrower than the plinth, and something is seen."""
    g = load_gaussians(splats(data_dir, f"playcanvas_statues/statues/{name}.sog"))
    assert (len(g), g.sh_degree) == (count, 0)
    y, seen = g.means[:, 1], g.opacities > 0.5
    top, bottom = (g.means[seen & part] for part in (y < y.quantile(0.05), y > y.quantile(0.95)))
    assert top[:, 0].std() < bottom[:, 0].std()  # y is down, as in a PLY
    K = drgs.cameras.intrinsics_from_fov(40.0, width=96, height=96)
    camera = drgs.Camera(K=K, w2c=drgs.cameras.look_at((0, -0.5, -5), (0, -0.2, 0), (0, -1, 0)), width=96, height=96)
    out = drgs.render(g, camera, drgs.RenderSettings.preset("fast"))
    assert 0.03 < float((out.alpha > 0.9).float().mean()) < 0.6
    assert 0.1 < float(out.rgb[out.alpha > 0.9].mean()) < 0.9
