"""A region of a scene: who belongs to it, what of a pixel shows it, and views that are chosen for it."""

from __future__ import annotations

import json
import math

import dense_jacobian
import numpy as np
import pytest
import torch
from scenes_random import gaussians
from test_active import SIZE, config, lazily, plan, write_image, write_still
from test_active import opened as opened  # a fixture

import drgs
from drgs import cli, reference
from drgs.cameras import Camera, look_at, orbit
from drgs.data import load
from drgs.ellipsoids import Gaussians
from drgs.features.segmentation import Classes
from drgs.gain import CRITERIA, Prior, information_gain, variances
from drgs.information.region import NothingOfRegion, Region, RegionText
from drgs.select import select
from drgs.settings import RenderSettings
from drgs.train import fit

FAST = RenderSettings.preset("fast")
EXACT = RenderSettings.preset("exact")
EVERYTHING = Region.box((-99,) * 3, (99,) * 3)


def spheres(places, sizes, opacity=0.97, colors=None) -> Gaussians:
    """Round Gaussians at some places."""
    count = len(places)
    rgb = torch.rand(count, 3, generator=torch.Generator().manual_seed(3)) if colors is None else torch.tensor(colors)
    return Gaussians(
        means=torch.tensor(places, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4).clone(),
        log_scales=torch.tensor(sizes, dtype=torch.float32).log()[:, None].expand(count, 3).clone(),
        logit_opacities=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=((rgb - 0.5) / 0.2820948)[:, None],
    )


def camera_at(center, towards=(0.0, 0, 0), name="", side=24) -> Camera:
    K = np.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1]], dtype=np.float64)
    return Camera(K=K, w2c=look_at(center, towards, (0, -1, 0)), width=side, height=side, name=name)


def two_things():
    """A small thing at x = -1.5 and one at x = 1.5, and cameras: 2 known ones and 6 candidates around both."""
    rng = np.random.default_rng(2)
    places = np.concatenate([rng.normal(0, 0.2, (20, 3)) + [x, 0, 0] for x in (-1.5, 1.5)])
    g = spheres(places.tolist(), [0.1] * 40)
    ring = orbit((0, 0, 0), 5.0, 8, width=24, height=24)
    return g, ring[:2], ring[2:]


@pytest.fixture(scope="module")
def world():
    """12 Gaussians, 2 known views and 4 candidates, and the oracle's Jacobian and rendering of each."""
    rng = np.random.default_rng(5)
    g = gaussians(rng, 12, 1, scale=0.25)
    cameras = orbit(g.means.mean(0).tolist(), 3.0, 6, width=14, height=12)
    J = [dense_jacobian.jacobian(g, reference.render(g, camera, EXACT)) for camera in cameras]
    return g.detach(), cameras[:2], cameras[2:], J


def oracle_share(g, camera, members):
    """s_p by the float64 oracle's compositing of the memberships."""
    seen = g.replace(features=members[:, None].to(g.means.dtype))
    return reference.render(seen, camera, EXACT).features[..., 0].double()


def part_of(g):
    """A region of about half of the Gaussians that has no volume: nothing but compositing weights counts."""
    members = (g.means[:, 0] > g.means[:, 0].median()).float()
    return Region("half", lambda scene: lambda time: members), members


# -------------------------------------------------- who belongs to it, and what shows it


def test_box_and_sphere_are_in_world_coordinates():
    """Means in them, far from 0 by the origin of the Gaussians; and at the time of a view where they move."""
    g = spheres([[0, 0, 0], [2, 0, 0]], [0.1, 0.1])
    far = g.replace(origin=np.array([4e6, 5e5, 0]))
    assert Region.box((-1, -1, -1), (1, 1, 1)).members(g).tolist() == [1, 0]
    assert Region.box((4e6 - 1, 5e5 - 1, -1), (4e6 + 1, 5e5 + 1, 1)).members(far).tolist() == [1, 0]
    assert Region.sphere((4e6 + 2, 5e5, 0), 0.5).members(far).tolist() == [0, 1]
    assert Region.sphere((2, 0, 0), 0.5).members(far).tolist() == [0, 0]


def test_rays_that_cross_a_volume():
    """Those of a point in it do, those beside it do not, what is behind the camera is not crossed."""
    camera = camera_at((0, 0, -4))
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3))
    for region, inside in (
        (Region.box((-0.3, -0.4, -0.5), (0.6, 0.5, 0.4)), ((points > [-0.3, -0.4, -0.5]) & (points < [0.6, 0.5, 0.4]))),
        (Region.sphere((0.2, -0.1, 0.3), 0.5), np.linalg.norm(points - [0.2, -0.1, 0.3], axis=1, keepdims=True) < 0.45),
    ):
        crossed = region.crossed(camera)
        columns, rows = camera.project(points[inside.all(1)])[0].astype(int).T
        near = np.pad(crossed, 1)  # the ray of a pixel is through its center
        hit = [near[r : r + 3, c : c + 3].any() for r, c in zip(rows, columns, strict=True)]
        assert all(hit)
        assert 0.01 < crossed.mean() < 0.3
        away = camera_at((0, 0, -4), (0, 0, -8))
        assert not region.crossed(away).any()
    assert Region.box((-9,) * 3, (9,) * 3).crossed(camera).all()
    assert Region.sphere((0, 0, -4), 0.1).crossed(camera).all()


def test_shares_are_the_oracles(world):
    """sum_i w_ip m_i of the float64 oracle, and with a volume (1 - alpha_p) v_p on top."""
    g, known, candidates, _ = world
    region, members = part_of(g)
    shares = region.shares(g, [*known, *candidates], EXACT).shares
    for camera, share in zip([*known, *candidates], shares, strict=True):
        torch.testing.assert_close(share.double(), oracle_share(g, camera, members), rtol=1e-4, atol=1e-5)
    low, high = g.means.amin(0).tolist(), g.means.amax(0).tolist()
    box = Region.box([x - 0.01 for x in low], [x + 0.01 for x in high])
    for camera, share in zip(known, box.shares(g, known, EXACT).shares, strict=True):
        alpha = reference.render(g, camera, EXACT).alpha.double()
        truth = alpha + (1 - alpha) * torch.from_numpy(box.crossed(camera))
        torch.testing.assert_close(share.double(), truth, rtol=1e-4, atol=1e-5)


def test_masks_tell_what_they_show():
    """The share of each Gaussian's compositing weight in the masks, by the oracle's weights; none shown: outside."""
    g = spheres([[-1, 0, 0], [1, 0, 0], [0, 0, -30]], [0.3, 0.3, 0.3])
    cameras = [camera_at((0, 0, -4)), camera_at((0.5, 0.3, -5))]
    masks = [torch.rand(24, 24, generator=torch.Generator().manual_seed(i)) for i in range(2)]
    wanted = []
    for i in range(3):
        one = torch.zeros(3, 1)
        one[i] = 1
        weights = [reference.render(g.replace(features=one), camera, EXACT).features[..., 0] for camera in cameras]
        total = sum(float(w.sum()) for w in weights)
        within = sum(float((w * mask).sum()) for w, mask in zip(weights, masks, strict=True))
        wanted.append(within / total if total else 0.0)
    assert wanted[2] == 0
    assert Region.masks(masks, cameras, EXACT).members(g).tolist() == pytest.approx(wanted, abs=1e-5)
    left = torch.zeros(24, 24)
    left[:, :12] = 1
    sides = Region.masks([left], cameras[:1]).members(g)
    assert sides[0] > 0.99
    assert sides[1] < 0.01


def test_a_class_is_what_query_selects():
    """Gaussians whose features are nearest to its embedding."""
    classes = Classes(("chair", "wall"), torch.eye(2))
    g = spheres([[0, 0, 0], [1, 0, 0]], [0.1, 0.1]).replace(features=torch.tensor([[0.9, 0.1], [0.2, 0.8]]))
    assert Region.of_class("chair", classes).members(g).tolist() == [1, 0]
    assert Region.of_class("WALL", classes).members(g).tolist() == [0, 1]
    with pytest.raises(ValueError, match="must be one of chair, wall"):
        Region.of_class("sofa", classes)
    with pytest.raises(ValueError, match="must have semantic features"):
        Region.of_class("chair", classes).members(g.replace(features=None))


def test_nothing_of_it_in_sight():
    """An empty volume counts by the rays across it; one that no ray crosses, and Gaussians that no view shows, are
    said."""
    g = spheres([[0, 0, 0]], [0.3])
    cameras = [camera_at((0, 0, -4)), camera_at((0, 0, -4), (0, 0, -8))]
    empty = Region.box((0.5, 0.5, -0.2), (0.8, 0.8, 0.2))
    shares, note = empty.shares(g, cameras)
    assert "no Gaussian of it is in sight yet" in note
    assert torch.equal(shares[0].bool(), torch.from_numpy(empty.crossed(cameras[0])))
    assert float(shares[0].sum()) > 0
    assert float(shares[1].sum()) == 0
    with pytest.raises(NothingOfRegion, match="none of 1 shows any of it; give world coordinates, in which the cam"):
        empty.shares(g, cameras[1:])
    behind = Region("class:rug", lambda scene: lambda time: torch.zeros(1))
    with pytest.raises(NothingOfRegion, match="none of 2 shows any of it"):
        behind.shares(g, cameras)
    assert Region.box((-1,) * 3, (1,) * 3).shares(g, cameras[:1]).note == ""


# -------------------------------------------------- scores


def test_scores_are_the_oracles(world):
    """P of `v_opt` is the sum over views and pixels of s_p J_pk^2; of every other criterion each parameter's term is
    multiplied by the share of its information that lies in these pixels."""
    g, known, candidates, J = world
    region, members = part_of(g)
    cameras = [*known, *candidates]
    squares = [dense_jacobian.squares(x) for x in J]
    shares = [oracle_share(g, camera, members).reshape(-1).repeat_interleave(3) for camera in cameras]
    weighed = [
        {name: (x.square() * s.reshape(-1, *[1] * (x.dim() - 1))).sum(0) for name, x in rows.items()}
        for rows, s in zip(J, shares, strict=True)
    ]
    add = lambda parts: {name: sum(x[name] for x in parts) for name in squares[0]}  # noqa: E731
    H, everything, wanted = add(squares[:2]), add(squares), add(weighed)
    for criterion in CRITERIA:
        if criterion == "block_logdet":
            continue
        found = select(
            g, candidates, known, criterion=criterion, prior=Prior(1e-2), blocks=("geometry",), region=region
        )
        variance = variances(H, found.prior)
        for i, new in enumerate(squares[2:]):
            if criterion == "v_opt":
                truth = information_gain(new, H, criterion, found.prior, pool=wanted).total
            else:
                terms = {
                    "eig": lambda ratio, variance: ratio,
                    "logdet": lambda ratio, variance: ratio.log1p(),
                    "trace_cov": lambda ratio, variance: ratio / (1 + ratio) * variance,
                }[criterion]
                truth = sum(
                    float(
                        (terms(new[name] * variance[name], variance[name]) * wanted[name] / everything[name])
                        .nan_to_num(0)
                        .sum()
                    )
                    for name in H
                )
            assert found.scores[i] == pytest.approx(truth, rel=2e-3)


def test_blocks_count_by_their_gaussians(world):
    """`block_logdet`: each Gaussian's gain times its share; all of them with everything, less with a part."""
    g, known, candidates, _ = world
    options = {"criterion": "block_logdet", "prior": Prior(1e-2)}
    plain = select(g, candidates, known, **options)
    whole = select(g, candidates, known, region=EVERYTHING, **options)
    half = select(g, candidates, known, region=part_of(g)[0], **options)
    assert whole.scores == pytest.approx(plain.scores, rel=1e-6)
    assert all(0 < a < b for a, b in zip(half.scores, plain.scores, strict=True))


@pytest.mark.parametrize("policy", ["fisher", "fisherrf", "coverage"])
@pytest.mark.parametrize("criterion", ["v_opt", "eig"])
def test_everything_is_as_no_region(policy, criterion):
    """Picks, scores and margins, also where several are picked."""
    g, known, candidates = two_things()
    options = {"k": 3, "policy": policy, "criterion": criterion}
    plain, whole = (select(g, candidates, known, region=x, **options) for x in (None, EVERYTHING))
    assert [x.index for x in whole.picks] == [x.index for x in plain.picks]
    assert whole.scores == pytest.approx(plain.scores, rel=1e-6)
    assert [x.margin for x in whole.picks] == pytest.approx([x.margin for x in plain.picks], rel=1e-4)


@pytest.mark.parametrize("options", [{}, {"criterion": "eig"}, {"policy": "fisherrf"}, {"policy": "coverage"}])
def test_picks_look_at_it(options):
    """Of a camera close to the one thing and one close to the other, the pick is the one that sees the region's."""
    g, known, _ = two_things()
    candidates = [camera_at((x, 0.5, -2.0), (x, 0, 0), str(x)) for x in (-1.5, 1.5)]
    for index, x in enumerate((-1.5, 1.5)):
        for region in (Region.sphere((x, 0, 0), 1.0), Region.box((x - 1, -1, -1), (x + 1, 1, 1))):
            assert select(g, candidates, known, region=region, **options).picks[0].index == index
            # What is behind everything may be seen past the region by both.
            alone = select(g, candidates, known, region=region, blocks=("geometry",), **options)
            assert alone.scores[1 - index] < 0.05 * alone.scores[index]


def test_batch_is_single_picks():
    """Two at once are two calls, the pool being the same: P and shares are of all views."""
    g, known, candidates = two_things()
    region = Region.sphere((1.5, 0, 0), 1.0)
    batch = select(g, candidates, known, 2, region=region)
    first = select(g, candidates, known, 1, region=region).picks[0]
    left = [x for i, x in enumerate(candidates) if i != first.index]
    second = select(g, left, [*known, candidates[first.index]], 1, region=region).picks[0]
    assert [x.name for x in batch.picks] == [first.name, second.name]
    assert batch.picks[1].score == pytest.approx(second.score, rel=1e-4)


def test_an_empty_region_still_ranks():
    """A volume that no Gaussian is in: the view that looks across it wins, and a note says so."""
    g, known, _ = two_things()
    candidates = [camera_at((x, 0.5, -2.0), (x, 0, 0), str(x)) for x in (-1.5, 1.5)]
    found = select(g, candidates, known, region=Region.sphere((1.5, 0.0, -0.9), 0.15))
    assert found.picks[0].index == 1
    assert found.scores[1] > 0
    assert any("no Gaussian of it is in sight yet" in note for note in found.notes)


def test_a_cache_knows_the_part():
    """What is computed of a region's pixels is kept beside what is of all: the second call computes nothing."""
    g, known, candidates = two_things()
    cache = drgs.select.Cache()
    region = Region.sphere((1.5, 0, 0), 1.0)
    first, second = (select(g, candidates, known, region=region, cache=cache) for _ in range(2))
    assert first.scores == second.scores
    assert second.computed == 0
    assert first.computed > len(known) + len(candidates)


def test_known_to_be_empty_outside_of_masks():
    """What a known view's mask leaves out is no pixel that shows the region, whatever is known of it."""
    g, known, candidates = two_things()
    masks = [torch.ones(24, 24) for _ in known]
    for mask in masks:
        mask[:, :12] = 0
    found = select(g, candidates, known, masks=masks, empty_outside=True, region=Region.sphere((1.5, 0, 0), 1.0))
    assert all(math.isfinite(x) and x >= 0 for x in found.scores)


# -------------------------------------------------- text, and what is refused


def test_texts():
    """Each form is read, and written as it was."""
    for text in ("box:0,-1,0.5,1,2,3", "sphere:1,2,3,0.25", "masks:data/masks of it", "class:arm chair"):
        assert str(RegionText.of(text)) == text
    assert Region.box((0, -1, 0.5), (1, 2, 3)).text == "box:0,-1,0.5,1,2,3"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cube:1", "must be box:X0,Y0,Z0,X1,Y1,Z1, sphere:X,Y,Z,R, masks:FOLDER or class:NAME, got 'cube:1'"),
        ("class:", "got 'class:'"),
        ("box:1,2,3", "with 6 numbers, got 'box:1,2,3'"),
        ("box:0,0,0,1,x,1", "with 6 numbers"),
        ("box:0,0,0,1,nan,1", "with 6 numbers"),
        ("box:0,2,0,1,1,1", "got y from 2 to 1; swap them"),
        ("sphere:0,0,0,0", "radius > 0, got 0"),
        (7, "got 7"),
    ],
)
def test_texts_that_are_none(text, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")) as error:
        RegionText.of(text, "--region")
    assert str(error.value).startswith("--region: ")


def test_what_is_refused():
    """Policies that look at no pixels, information of one's own, masks of another size, and no region."""
    g, known, candidates = two_things()
    region = Region.sphere((1.5, 0, 0), 1.0)
    for policy in ("farthest", "uniform", "random", "moments"):
        with pytest.raises(ValueError, match=f"region must be none with policy {policy}"):
            select(g, candidates, known, policy=policy, region=region)
    with pytest.raises(ValueError, match="region must be None with information"):
        select(g, candidates, known, information=lambda camera: {"a": torch.ones(1)}, region=region)
    with pytest.raises(ValueError, match="region must be a Region"):
        select(g, candidates, known, region="box:0,0,0,1,1,1")
    with pytest.raises(ValueError, match=r"masks\[0\] must have its camera's shape \(24, 24\)"):
        Region.masks([torch.ones(3, 3)], known[:1])
    with pytest.raises(ValueError, match="a mask for each of one camera or more, got 0"):
        Region.masks([], [])
    with pytest.raises(ValueError, match="swap them"):
        Region.box((1, 0, 0), (0, 1, 1))
    with pytest.raises(ValueError, match="three finite numbers"):
        Region.sphere((1, 0), 1)
    with pytest.raises(NothingOfRegion, match="in sight of a view, none of 8 shows any of it"):
        select(g, candidates, known, region=Region.sphere((0, 400, 0), 1.0))


# -------------------------------------------------- commands and active fits


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`data`, a run `run` on it, masks of its photographs' left halves in `left`."""
    folder = tmp_path_factory.mktemp("region")
    write_still(folder / "data")
    fit(lazily(folder / "data"), folder / "run", config(max_steps=12, selection=plan()), progress=False)
    half = np.zeros((SIZE, SIZE), np.uint8)
    half[:, : SIZE // 2] = 255
    for i in range(9):
        write_image(folder / f"left/{i}.png", half)
    write_image(folder / "others/x.png", half)
    write_image(folder / "odd/1.png", half[:5])
    return folder


def drgs_select(folder, capsys, *options):
    line = ["select", str(folder / "run"), "--candidates", str(folder / "data"), "-o", str(folder / "out.json")]
    assert cli.main([*line, *options]) == 0, capsys.readouterr().err
    return json.loads((folder / "out.json").read_text()), capsys.readouterr().out


def test_command(place, capsys):
    """The scores that Python gets, of a box and of masks of the known photographs, and the region in the file."""
    plain, _ = drgs_select(place, capsys)
    assert plain["region"] is None
    whole, _ = drgs_select(place, capsys, "--region=box:-9,-9,-9,9,9,9")
    assert whole["region"] == "box:-9,-9,-9,9,9,9"
    assert [x["score"] for x in whole["candidates"]] == pytest.approx([x["score"] for x in plain["candidates"]])
    left, _ = drgs_select(place, capsys, "--region", f"masks:{place / 'left'}")
    run, settings = drgs.load_run(place / "run"), RenderSettings.preset("fast")
    settings = settings.replace(background=run.record.config.settings.background)
    views = {view.name: view.camera for view in load(place / "data").views}
    known = [views[name] for name in left["known"]["names"]]
    half = torch.zeros(SIZE, SIZE)
    half[:, : SIZE // 2] = 1
    region = Region.masks([half] * len(known), known, settings)
    candidates = [views[x["name"]] for x in left["candidates"]]
    found = select(run.scene, candidates, known, region=region, settings=settings)
    assert [x["score"] for x in left["candidates"]] == pytest.approx(found.scores, rel=1e-4)
    _, text = drgs_select(place, capsys, "--region", "sphere:0.8,0.8,-0.3,0.1")
    assert "note: region sphere:0.8,0.8,-0.3,0.1: no Gaussian of it is in sight yet" in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--region", "box:1,0,0,0,1,1"], "region must have the lowest corner of its box before the highest"),
        (["--region", "ball:1"], "region must be box:X0"),
        (["--region", "sphere:0,90,0,1"], "must be in sight of a view, none of 9 shows any of it"),
        (["--region", "class:chair"], "must be of a scene with classes, this one has none"),
        (["--region", "masks:{}/nowhere"], "must be a folder, is none"),
        (["--region", "masks:{}/others"], "must have a mask named as one of 4 training photographs, e.g. 1.png"),
        (["--region", "masks:{}/odd"], "must have the shape of its image"),
        (["--region", "sphere:0,0,0,1", "--policy", "uniform"], "region must be none with policy uniform"),
    ],
)
def test_bad_options(place, capsys, options, message):
    """One line each, and no file."""
    (place / "out.json").unlink(missing_ok=True)
    line = ["select", str(place / "run"), "--candidates", str(place / "data"), "-o", str(place / "out.json")]
    assert cli.main([*line, *(x.format(place) for x in options)]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in error
    assert not (place / "out.json").exists()


def fitted(folder, run, **fields):
    """selection.json of an active fit that picks two views by `fisher`."""
    chosen = config(max_steps=12, selection=plan(policy="fisher", info_pixels=200, **fields))
    fit(lazily(folder / "data"), run, chosen, progress=False)
    return json.loads((run / "selection.json").read_text())


def test_active_fit_of_everything(place, tmp_path):
    """A box around all that there is picks as no region does; the region is in selection.json and config.json."""
    plain, whole = (
        fitted(place, tmp_path / name, region=x) for name, x in {"plain": None, "whole": "box:-9,-9,-9,9,9,9"}.items()
    )
    for a, b in zip(plain["picks"], whole["picks"], strict=True):
        assert a["name"] == b["name"]
        assert a["score"] == pytest.approx(b["score"], rel=1e-5)
    assert plain["region"] is None
    assert whole["region"] == "box:-9,-9,-9,9,9,9"
    record = json.loads((tmp_path / "whole" / "config.json").read_text())
    assert record["fit"]["selection"]["region"] == "box:-9,-9,-9,9,9,9"


def test_active_fit_reads_masks_of_picked_views_only(place, tmp_path, opened):
    """Of the folder of masks, too, nothing of a view is read before it is picked."""
    result = fitted(place, tmp_path / "run", region=f"masks:{place / 'left'}")
    start = [x["name"] for x in result["start"]]
    first = {}
    for at, text in enumerate(opened):
        if str(place / "left") in text:
            first.setdefault(text.rpartition("/")[2].split(".")[0], at)
    assert {*first} <= {*start, result["picks"][0]["name"]}
    assert {*start} <= {*first}
    name = result["picks"][0]["name"]
    assert first[name] > opened.index(f"picked {name}")
    assert not any("nothing of it is known" in note for pick in result["picks"] for note in pick["notes"])


def test_active_fit_without_a_mask_yet(place, tmp_path):
    """Masks of photographs that are not picked: the whole scene counts, and the pick says so; nothing is lost."""
    result = fitted(place, tmp_path / "run")
    later = min(set(result["pool"]) - {x["name"] for x in [*result["start"], *result["picks"]]})
    (tmp_path / "masks").mkdir()
    (tmp_path / f"masks/{later}.png").write_bytes((place / "left/1.png").read_bytes())
    region = fitted(place, tmp_path / "region", region=f"masks:{tmp_path / 'masks'}")
    assert [x["name"] for x in region["picks"]] == [x["name"] for x in result["picks"]]
    assert all("nothing of it is known yet" in pick["notes"][-1] for pick in region["picks"])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"region": "sphere:0,90,0,1"}, "must be in sight of a photograph, no camera of 6 looks at it"),
        ({"region": "class:chair"}, "must be of a scene with classes"),
        ({"region": "masks:{}/others"}, "must have a mask named as one of 6 training photographs"),
        ({"region": "masks:{}/odd"}, "must have the shape of its image"),
        ({"region": "sphere:0,0,0,1", "policy": "farthest"}, "region must be none with policy farthest"),
    ],
)
def test_active_fit_refuses_before_the_first_step(place, tmp_path, fields, message):
    """Nothing is written."""
    fields = {"policy": "fisher", **fields, "region": fields["region"].format(place)}
    with pytest.raises((ValueError, OSError), match=message):
        fit(lazily(place / "data"), tmp_path / "run", config(selection=plan(**fields)), progress=False)
    assert not (tmp_path / "run/state.safetensors").exists()


def test_configuration_of_a_region():
    """A text that is none is refused where the configuration is made."""
    with pytest.raises(ValueError, match="active: region must be box"):
        drgs.SelectionConfig(region="cube")


def test_fisher_tells_its_pixels(place, capsys):
    """Pixels, mean variance and expected error of what shows it, in each view; of everything, those of the view."""
    line = ["fisher", str(place / "run"), "--limit", "2", "--preset", "fast", "-o", str(place / "fisher")]
    assert cli.main([*line, "--region", "box:-9,-9,-9,9,9,9"]) == 0, capsys.readouterr().err
    text = capsys.readouterr().out
    report = json.loads((place / "fisher/fisher.json").read_text())
    assert report["region"] == "box:-9,-9,-9,9,9,9"
    for view in report["views"]:
        assert view["region"]["pixels"] == pytest.approx(SIZE**2, rel=1e-4)
        assert view["region"]["variance"] == pytest.approx(view["variance"]["mean"], rel=1e-4)
        assert view["region"]["rmse"] == pytest.approx(view["error"]["rmse"], rel=1e-4)
        assert (place / "fisher" / view["files"][-1]).is_file()
    assert "region box:-9,-9,-9,9,9,9" in text
    assert cli.main([*line, "--region", f"masks:{place / 'left'}"]) == 0, capsys.readouterr().err
    for view in json.loads((place / "fisher/fisher.json").read_text())["views"]:
        assert 0 < view["region"]["pixels"] < SIZE**2
        assert view["region"]["rmse"] > 0
    assert cli.main([*line, "--region", "sphere:0,90,0,1"]) == 2
    assert "fisher: region sphere:0,90,0,1 must be in sight of a view" in capsys.readouterr().err


# -------------------------------------------------- pruning


def test_pruning_for_a_region_removes_the_rest():
    """Of two things, each half of the Gaussians: the one outside goes, its least needed Gaussians first."""
    g, known, candidates = two_things()
    cameras = [*known, *candidates]
    region = Region.masks(*zip(*[(x, c) for c, x in zip(cameras, sides(g, cameras), strict=True)], strict=True))
    half = drgs.prune(g, cameras, keep=0.5, region=region)
    assert int(half.kept[:20].sum()) <= 2  # what a pixel of the other thing's edge shows, too
    assert int(half.kept.sum()) == 20
    fifth = drgs.prune(g, cameras, keep=0.9, rounds=1, region=region)
    assert bool(fifth.kept[20:].all())
    plain = drgs.prune(g, cameras, keep=0.5)
    assert int(plain.kept[:20].sum()) > 4
    assert half.unseen == plain.unseen == 0


def sides(g, cameras):
    """Masks of the thing at x = 1.5, as it is rendered alone."""
    alone = g.take(torch.arange(20, 40))
    return [(drgs.render(alone, camera, outputs=()).alpha > 0.5).float() for camera in cameras]


def test_pruning_of_everything_is_pruning():
    """With all pixels the same Gaussians go; the PSNR by which a loss is told is that of the region's pixels."""
    g, known, candidates = two_things()
    plain, whole = (drgs.prune(g, [*known, *candidates], keep=0.4, region=x) for x in (None, EVERYTHING))
    assert torch.equal(plain.kept, whole.kept)
    images = [drgs.render(g, camera, RenderSettings.preset("fast"), outputs=()).rgb.clamp(0, 1) for camera in known]
    images[0][:, :] = 0  # a photograph that differs where the region is, and elsewhere
    region = Region.sphere((1.5, 0, 0), 0.8)
    found = drgs.prune(g, known, keep=0.5, images=images, region=region)
    share = region.shares(g, known).shares[0]
    seen = drgs.render(g, known[0], RenderSettings.preset("fast"), outputs=()).rgb.clamp(0, 1)
    mse = float((share * seen.square().mean(2)).sum() / share.sum())
    assert found.psnr == pytest.approx((-10 * math.log10(mse) + 100) / 2, rel=1e-3)


def test_prune_command(place, tmp_path, capsys):
    """--region, in prune.json and in the table; a region out of sight leaves no file."""
    line = ["prune", str(place / "run"), "--keep", "0.5", "-o", str(tmp_path / "small.ply")]
    assert cli.main([*line, "--region", "sphere:0,90,0,1"]) == 2
    assert "prune: region sphere:0,90,0,1 must be in sight" in capsys.readouterr().err
    assert not [*tmp_path.glob("small*")]
    assert cli.main([*line, "--region", f"masks:{place / 'left'}", "--refit", "2"]) == 0, capsys.readouterr().err
    report = json.loads((tmp_path / "small.json").read_text())
    assert report["region"].endswith("left")
    assert "of the pixels that show masks:" in capsys.readouterr().out


# -------------------------------------------------- planner


def test_planner_looks_at_it(tmp_path):
    """Of two candidates each sees one thing: the region's is next, also after a save; out of sight all count."""
    g, known, _ = two_things()
    candidates = [camera_at((x, 0.5, -2.0), (x, 0, 0), str(x)) for x in (-1.5, 1.5)]
    for index, x in enumerate((-1.5, 1.5)):
        planner = drgs.Planner(scene=g, region=Region.sphere((x, 0, 0), 1.0))
        for camera in known:
            planner.observe(None, camera)
        planner.scores(candidates)
        found = planner.next(1)
        assert found.picks[0].index == index
        assert found.note == ""
        want = select(g, candidates, known, region=Region.sphere((x, 0, 0), 1.0), settings=FAST)
        assert found.scores == pytest.approx(want.scores, rel=1e-4)
        planner.save(tmp_path / f"{index}.planner")
        again = drgs.Planner.load(tmp_path / f"{index}.planner")
        assert again.next(1).scores == pytest.approx(found.scores, rel=1e-6)
        with pytest.raises(ValueError, match="region must be that of the planner that was saved, sphere:"):
            drgs.Planner.load(tmp_path / f"{index}.planner", region=EVERYTHING)
    planner = drgs.Planner(scene=g, region=Region("class:rug", lambda scene: lambda time: torch.zeros(40)))
    for camera in known:
        planner.observe(None, camera)
    planner.scores(candidates)
    assert "no view shows any of it yet" in planner.next(1).note
