"""Picks that are moved to where their views tell more: within bounds, and never to where they tell less."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from scenes_random import gaussians

from drgs import cli, fisher
from drgs.cameras import Camera, orbit
from drgs.data.camera_lists import camera_to_json
from drgs.files import save_ply
from drgs.information.criteria import criterion_named
from drgs.select import Refine, Scoring, select
from drgs.selection.refining import _moved
from drgs.settings import RenderSettings

pytestmark = pytest.mark.core

FAST = RenderSettings.preset("fast")


def facing(x, y=0.0, z=-4.0, name="c"):
    """A camera that looks along +z."""
    w2c = np.eye(4)
    w2c[:3, 3] = (-x, -y, -z)
    return Camera(K=np.array([[20.0, 0, 16], [0, 20, 12], [0, 0, 1]]), w2c=w2c, width=32, height=24, name=name)


def scene(n=30):
    return gaussians(np.random.default_rng(0), n, 1).detach()


def peak(place, turned=0.0):
    """Information that is highest at a place, for a camera that is turned by so many degrees about y."""

    def information(camera):
        apart = camera.center - np.asarray(place)
        forward = camera.c2w[:3, 2]
        angle = math.degrees(math.atan2(forward[0], forward[2])) - turned
        value = math.exp(-float(apart @ apart)) * math.exp(-((angle / 20) ** 2))
        return {"a": torch.full((1,), value)}

    return information


def moved(information, candidates, refine, **options):
    known = [facing(-3.0, name="known")]
    return select(scene(), candidates, known, criterion="eig", information=information, refine=refine, **options)


def test_a_pick_goes_to_the_peak():
    """In three shifts and two turns, to a part of the first step; the candidate's own score stays known."""
    candidates = [facing(x, name=f"c{x}") for x in (-1.0, 0.0, 1.0)]
    found = moved(peak((0.3, 0.2, -4.3), 6.0), candidates, Refine(evaluations=300, box=(-2, -2, -5, 2, 2, -3)))
    (pick,) = found.picks
    assert pick.index == 1
    assert np.abs(pick.camera.center - (0.3, 0.2, -4.3)).max() < 0.05
    forward = pick.camera.c2w[:3, 2]
    assert math.degrees(math.atan2(forward[0], forward[2])) == pytest.approx(6.0, abs=1.5)
    assert pick.start == pytest.approx(found.scores[1])
    assert pick.score > 1.05 * pick.start
    assert pick.camera.name == "c0.0"


def test_one_candidate_goes_too():
    """By the distance to what is known: alone it has no next candidate."""
    (pick,) = moved(peak((0.3, 0.2, -4.3)), [facing(0.0)], Refine(evaluations=300, box=(-2, -2, -5, 2, 2, -3))).picks
    assert np.abs(pick.camera.center - (0.3, 0.2, -4.3)).max() < 0.1


def test_bounds_hold():
    """A box, an angle, and a number of views."""
    candidates = [facing(x, name=f"c{x}") for x in (-1.0, 0.0, 1.0)]
    found = moved(peak((5.0, 0.0, -4.0)), candidates, Refine(evaluations=300))  # the box of candidates and known views
    assert found.picks[0].camera.center[0] <= 1 + 1e-9
    found = moved(peak((1.0, 0.0, -4.0), 60.0), candidates, Refine(evaluations=300, turn=10.0))
    forward = found.picks[0].camera.c2w[:3, 2]
    assert math.degrees(math.acos(forward[2])) <= 10 + 1e-5
    asked = []

    def counted(camera):
        asked.append(camera)
        return peak((0.3, 0.0, -4.0))(camera)

    found = moved(counted, candidates, Refine(evaluations=5, box=(-2, -2, -5, 2, 2, -3)))
    assert len(asked) == 3 + 1 + 5  # candidates, the known view, and what the pick was tried at
    assert found.evaluations == 3 + 5


def test_what_is_solid_is_not_entered():
    """No nearer to Gaussians than the nearest of the cameras that there are."""
    g = scene(40)
    g = g.replace(logit_opacities=torch.full((40,), 3.0), means=0.1 * g.means)
    candidates = [facing(x, name=f"c{x}") for x in (-1.0, 0.0, 1.0)]
    near = lambda center: np.sort(np.linalg.norm(g.means.double().numpy() - center, axis=1))[9]  # noqa: E731
    found = select(
        g, candidates, [facing(-3.0)], criterion="eig", information=peak((0.0, 0.0, 0.0)),
        refine=Refine(evaluations=300, box=(-5, -5, -5, 5, 5, 5)),
    )  # fmt: skip
    least = min(near(x.center) for x in candidates)
    assert near(found.picks[0].camera.center) >= least - 1e-9


def test_where_nothing_is_better_it_stays():
    candidates = [facing(x, name=f"c{x}") for x in (-1.0, 0.0, 1.0)]
    found = moved(peak((0.0, 0.0, -4.0)), candidates, Refine(evaluations=300, box=(-2, -2, -5, 2, 2, -3)))
    (pick,) = found.picks
    assert pick.score == pick.start
    np.testing.assert_array_equal(pick.camera.w2c, candidates[1].w2c)


def test_the_next_pick_knows_where_the_last_one_went():
    """H has what the moved view says: of two picks the second is scored against it."""
    rng = np.random.default_rng(1)
    g = gaussians(rng, 20, 1).detach()
    cameras = orbit((0, 0, 0), 4.0, 6, width=24, height=18)
    scoring = Scoring(criterion="eig", settings=FAST, blocks=("geometry",))
    found = select(g, cameras[1:], cameras[:1], 2, scoring=scoring, refine=Refine(evaluations=15))
    first, second = found.picks
    assert first.score >= first.start
    assert second.score >= second.start
    known = fisher.diagonal(g, [cameras[0], first.camera], FAST)
    own = fisher.diagonal(g, [second.camera], FAST)
    prior = criterion_named("eig", "test").prior
    want = sum(float((own[name] / (known[name] + prior)).sum()) for name in own)
    assert second.score == pytest.approx(want, rel=1e-4)


def test_both_poses_of_a_rolling_shutter_move_alike():
    """In the world the camera moves as before while it is exposed."""
    start = facing(0.0)
    end = np.array(start.w2c)
    end[0, 3] -= 0.1
    rolling = dataclasses.replace(start, shutter="rolling_top_to_bottom", w2c_end=end)
    for kind, axis in (("go", 2), ("turn", 1)):
        one = _moved(rolling, kind, axis, 0.2)
        np.testing.assert_allclose(np.linalg.inv(one.w2c_end) @ one.w2c, np.linalg.inv(end) @ start.w2c, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": "farthest", "refine": Refine()}, "refine must be None with policy farthest"),
        ({"refine": 40}, "refine must be"),
        ({"refine": Refine(), "combine": "zscore", "blocks": ("geometry", "backdrop")}, "combine zscore"),
    ],
)
def test_refusals(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        select(scene(), [facing(0.0), facing(1.0)], [facing(-1.0)], **options)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"evaluations": 0}, "evaluations must be a whole number"),
        ({"turn": 100.0}, "turn must be in"),
        ({"box": (0, 0, 0, 1, 1)}, "box must be"),
        ({"box": (0, 0, 0, 1, -1, 1)}, "box must be"),
        ({"box": (0, 0, 0, 1, math.nan, 1)}, "box must be"),
    ],
)
def test_what_is_out_of_range_is_named(fields, message):
    with pytest.raises(ValueError, match=message):
        Refine(**fields)


def test_command(tmp_path, capsys):
    """The file has where the pick went, and what it was worth before."""
    path = tmp_path / "cloud.ply"
    save_ply(scene(40), path)
    cameras = tmp_path / "cameras.json"
    cameras.write_text(json.dumps([camera_to_json(facing(x, name=f"c{x}")) for x in (-1.0, 1.0)]))
    out = tmp_path / "select.json"
    common = [str(path), "--train", str(cameras), "--candidates", "orbit", "--count", "4", "-o", str(out)]
    assert cli.main(["select", *common, "--refine", "6", "--refine-box=-9,-9,-9,9,9,9"]) == 0
    (pick,) = json.loads(out.read_text())["picks"]
    assert pick["score"] >= pick["start"]
    assert "its score is" in capsys.readouterr().out
    for options, message in (
        (["--refine", "6", "--refine-box", "1,2"], "box must be"),
        (["--refine", "6", "--refine-box", "a,b"], "six numbers"),
        (["--refine-box", "0,0,0,1,1,1"], "must have --refine"),
        (["--refine", "-1"], "evaluations must be"),
    ):
        assert cli.main(["select", *common, *options]) == 2
        assert message in capsys.readouterr().err
