"""A planner that is killed goes on from its file with the same answers; no other file is read or replaced."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes_random import gaussians
from test_planner import config, photograph, planner_of

import drgs
from drgs.cameras import orbit
from drgs.files import load_state, save_state
from drgs.planner import Planner
from drgs.planner.file import digest_of
from drgs.select import Scoring
from drgs.selection.cache import named_by

HERE = Path(__file__).resolve().parent
ROUNDS = 6


@pytest.fixture(scope="module")
def world():
    """30 Gaussians, three known cameras and five candidates around them."""
    g = gaussians(np.random.default_rng(0), 30, 4, scale=0.25).detach()
    views = [dataclasses.replace(c, name=f"c{i}") for i, c in enumerate(orbit((0, 0, 0), 4.0, 8, width=24, height=18))]
    return g, views[:3], views[3:]


def loop(planner: Planner, begin: int, end: int, depth: bool = True):
    """Answers of photographs of a random scene, some of which are let go of, and what the model is in between."""
    g = gaussians(np.random.default_rng(0), 30, 4, scale=0.25).detach()
    around = orbit((0, 0, 0), 4.0, 12, width=24, height=18)
    for number in range(begin, end):
        image, distances = photograph(g, around[number])
        planner.observe(image, around[number], distances if depth else None)
        planner.fit(steps=7)
        if planner.scene is None:
            yield [planner.views]
            continue
        plan = planner.scores(around[8:], cost=[1.0, 2.0, 0.5, 0.1])
        picks = [(pick.index, pick.score, pick.cost) for pick in planner.next(2).picks]
        # A turn of the last photograph's draw is in the next: positions say what steps and draws there were.
        where = [float(x.double().sum()) for x in planner.scene.parameters().values()]
        yield [planner.views, plan.scores, plan.changed, plan.computed, plan.left_out, picks, where]


def small(**options) -> Planner:
    return Planner(config(deterministic=True, **options), max_views=4, info_pixels=432)


# ------------------------------------------------------------------------------------------------------- the same bits


@pytest.mark.every(3)
@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("at", [1, 3, 5])
@pytest.mark.same_bits
def test_same_bits(tmp_path, depth, at):
    """Whether there is a model already, or more photographs than are kept; what views told is not asked again."""
    right = list(loop(small(), 0, ROUNDS, depth))
    planner = small()
    assert list(loop(planner, 0, at, depth)) == right[:at]
    planner.save(tmp_path / "p.safetensors", notes={"at": at})
    again = Planner.load(tmp_path / "p.safetensors")
    assert again.notes == {"at": at}
    assert again.views == planner.views
    if at > 1 or depth:
        assert [again.next().picks[0].score, again.next().computed] == [planner.next().picks[0].score, 0]
    assert list(loop(again, at, ROUNDS, depth)) == right[at:]


@pytest.mark.same_bits
def test_schedules_that_were_made_longer(tmp_path):
    """A fit that has outlasted its steps goes on at the same place of the schedules."""
    planner = small(max_steps=10)
    list(loop(planner, 0, 3))
    planner.save(tmp_path / "p.safetensors")
    again = Planner.load(tmp_path / "p.safetensors")
    assert planner._fit.trainer.config.max_steps > 10
    assert list(loop(again, 3, 5)) == list(loop(planner, 3, 5))


def test_a_callers_own_model(world, tmp_path):
    """With its origin; what has changed since counts as before."""
    g, _, candidates = world
    g = g.replace(means=g.means - 1, origin=np.ones(3))
    planner = planner_of(world, bound=0.15, look=2.0)
    planner.scene = g
    planner.scores(candidates)
    planner.scene = near = g.replace(log_scales=g.log_scales + 0.1)
    planner.save(tmp_path / "p.safetensors")
    again = Planner.load(tmp_path / "p.safetensors")
    assert all(torch.equal(x, near.parameters()[name]) for name, x in again.scene.parameters().items())
    assert again.scene.origin.tolist() == [1, 1, 1]
    plans = [one.next(3) for one in (planner, again)]
    assert plans[0].changed == plans[1].changed == pytest.approx(0.1, rel=1e-3)
    assert plans[0].scores == plans[1].scores
    assert plans[0].computed == plans[1].computed == 0


def test_files_of_before(world, tmp_path):
    """What answers take of the time of their views had another name in the file: it is read under either."""
    planner = planner_of(world)
    planner.scores(world[2])
    planner._answer_share.note(0.25)
    planner.save(tmp_path / "p.safetensors")
    tensors, header = load_state(tmp_path / "p.safetensors")
    header["answered_in"] = header.pop("answer_shares")
    header["digest"] = digest_of(tensors, header := {x: y for x, y in header.items() if x not in ("kind", "schema")})
    save_state(tmp_path / "p.safetensors", tensors, {"kind": "planner", **header})
    latest = planner._answer_share.latest
    assert 0.25 in latest
    assert list(Planner.load(tmp_path / "p.safetensors")._answer_share.latest) == list(latest)


def test_what_is_asked_has_to_be_the_same(world, tmp_path):
    """Another scoring is refused; quantities that a file names otherwise, as one of 0.2.0 does, are computed
    anew for the first answer.
    """
    _, _, candidates = world
    other = Scoring(criterion="eig", settings=drgs.RenderSettings.preset("fast"))
    planner = planner_of(world, scoring=other)
    right = planner.scores(candidates).scores
    planner.save(tmp_path / "p.safetensors")
    with pytest.raises(ValueError, match="scoring must be that of the planner that was saved, is another one; give it"):
        Planner.load(tmp_path / "p.safetensors")
    assert Planner.load(tmp_path / "p.safetensors", scoring=other).next().scores == pytest.approx(right, rel=1e-6)
    tensors, header = load_state(tmp_path / "p.safetensors")
    for row in header["cache"]["answers"]:
        row["question"] = "what an older version asked"
    again = Planner.load(tmp_path / "p.safetensors", scoring=other)
    again._cache.restore(tensors, header["cache"], [*again._known, *again._pool], "here")
    plan = again.next()
    assert plan.scores == pytest.approx(right, rel=1e-6)
    assert plan.computed == len(again._known) + len(candidates)
    assert plan.left_out == 0


def test_costs_that_are_a_function_are_given_again(world, tmp_path):
    """No file holds one: an answer without them would be another one."""
    _, _, candidates = world
    planner = planner_of(world)
    distance = lambda here, there: float(np.linalg.norm(there.center - here.center))  # noqa: E731
    planner.scores(candidates, cost=distance)
    planner.save(tmp_path / "p.safetensors")
    again = Planner.load(tmp_path / "p.safetensors")
    with pytest.raises(ValueError, match=r"costs were a function, which no file holds; give it to Planner.scores"):
        again.next()
    again.save(tmp_path / "p.safetensors")
    again = Planner.load(tmp_path / "p.safetensors")
    assert again.scores(candidates, cost=distance).computed == 0
    assert again.next(2).picks[1].index == planner.next(2).picks[1].index


def test_names_of_questions():
    """Equal values have one name, which differs where a bit of a tensor does; a lambda has none."""
    fast = Scoring(settings=drgs.RenderSettings.preset("fast"))
    assert named_by(fast) == named_by(Scoring(settings=drgs.RenderSettings.preset("fast")))
    assert named_by(fast) != named_by(Scoring())
    a, b = torch.zeros(1000), torch.zeros(1000)
    b[500] = 1e-9
    assert named_by((a, {"x": 1})) == named_by((a.clone(), {"x": 1})) != named_by((b, {"x": 1}))
    assert named_by((lambda: 1,)) is None


# ------------------------------------------------------------------------------------------------------------- killed


def main(path: Path, kill_at_save: int) -> None:
    """A loop that goes on from a file; killed in the middle of writing one, if it is to."""
    import drgs.io.outputs as outputs

    planner = Planner.load(path) if path.exists() else small()
    saves = 0
    replace = os.replace

    def killed(source, target):
        if saves == kill_at_save and Path(target) == path:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)

    outputs.os.replace = killed
    said = [] if planner.notes is None else planner.notes
    for answer in loop(planner, len(said), ROUNDS):
        said.append(answer)
        saves += 1
        planner.save(path, said)
        print("saved", flush=True)


def started(path: Path, kill_at_save: int = 0) -> subprocess.Popen:
    command = [sys.executable, __file__, str(path), str(kill_at_save)]
    environment = {**os.environ, "DRGS_THREADS": "1", "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs POSIX")
@pytest.mark.same_bits
def test_killed(tmp_path):
    """While it writes, and in between: the file is the last good one, and all answers are as without."""
    path = tmp_path / "p.safetensors"
    right = json.loads(json.dumps(list(loop(small(), 0, ROUNDS))))
    with started(path, kill_at_save=3) as process:
        process.wait()
    assert process.returncode == -signal.SIGKILL
    assert len(Planner.load(path).notes) == 2
    assert len(list(tmp_path.glob(".drgs.p.safetensors.*"))) == 1
    with started(path) as process:
        assert process.stdout.readline() == "saved\n"
        time.sleep(0.05)  # in the middle of whatever comes next
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert process.returncode == -signal.SIGKILL
    assert 3 <= len(Planner.load(path).notes) < ROUNDS
    with started(path) as process:
        process.wait()
    assert process.returncode == 0
    assert Planner.load(path).notes == right
    assert [x.name for x in tmp_path.iterdir()] == [path.name], "what was left half written is gone"


# ---------------------------------------------------------------------------------------------------------- other files


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "p.safetensors"
    planner = small()
    list(loop(planner, 0, 2))
    planner.save(path)
    return path


def refused(path: Path, match: str) -> None:
    with pytest.raises(ValueError, match=match) as error:
        Planner.load(path)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(path))


def is_same_state(path: Path, other: Path) -> bool:
    """Whether two files hold the same numbers: 1E-05 is 1e-05, and the 17th digit of a number may change nothing."""
    try:
        (tensors, header), (others, its) = load_state(path), load_state(other)
    except ValueError:
        return False
    same = tensors.keys() == others.keys() and all(
        x.dtype == others[name].dtype and x.numpy().tobytes() == others[name].numpy().tobytes()
        for name, x in tensors.items()
    )
    return same and header == its


def test_damaged_files(saved, tmp_path):
    """Cut short, or with a bit that differs, wherever: one line, and nothing is allocated that the file claims."""
    data = saved.read_bytes()
    path = tmp_path / "p.safetensors"
    rng = np.random.default_rng(0)
    for size in (0, 5, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        refused(path, "must be")
    for at in [*rng.integers(0, len(data), 30), *rng.integers(8, 20_000, 60)]:
        changed = bytearray(data)
        changed[at] ^= 1 << int(rng.integers(0, 7))
        path.write_bytes(changed)
        if not is_same_state(path, saved):
            refused(path, str(path))


def test_values_that_cannot_be(saved, tmp_path):
    """Also where the digest fits: somebody who writes such a file gets one line, too."""
    path = tmp_path / "p.safetensors"
    tensors, header = load_state(saved)
    header.pop("schema")
    kind = header.pop("kind")

    def written(change):
        own, head = dict(tensors), json.loads(json.dumps(header))
        change(own, head)
        save_state(path, own, {"kind": kind, **head, "digest": digest_of(own, head)})

    written(lambda own, head: None)
    assert Planner.load(path).views == ["orbit_0000", "orbit_0001"]
    for change, match in (
        (lambda own, head: head.update(max_views=1), "max_views must be a whole number >= 2, got 1"),
        (lambda own, head: head["known"][0].update(width=10**6, height=10**6), "Camera 'orbit_0000'"),
        (lambda own, head: head["known"][0].update(width=10**4), "must have at most 432 pixels, has more"),
        (lambda own, head: head["photographs"][0].update(width=25), "photograph 0 must be 8 bits of shape"),
        (lambda own, head: own.pop("photograph.1"), "photograph 1 must be 8 bits of shape"),
        (lambda own, head: head["fit"]["rng"].update(state="-1"), "rng.state must be a hexadecimal number"),
        (lambda own, head: head["fit"]["fit"].update(step=-1), "step must be >= 0, got -1"),
        (lambda own, head: own.pop("fit.parameter.quats"), "parameter.quats must be torch.float32 of shape"),
        (lambda own, head: own.pop("shapes.0.quats"), "quats of shapes 0 must be torch.float32 of shape"),
        (lambda own, head: head["cache"]["answers"][0].update(view=99), "answer 0 must be of a view"),
        (lambda own, head: head["cache"]["answers"][0].update(shapes=99), "answers must refer to . saved scenes"),
        (
            lambda own, head: own.update({"answer.0.means": torch.zeros(2, 3)}),
            "answer 0: means must be of .* Gaussians",
        ),
        (lambda own, head: head.pop("pool"), "must have the key 'pool', found none"),
    ):
        written(change)
        refused(path, match)


def test_nothing_else_is_replaced(saved, tmp_path):
    """Not a checkpoint of a fit, not a text, no link, nor a planner's file that cannot be read."""
    planner = Planner.load(saved)
    other = tmp_path / "state.safetensors"
    save_state(other, {"x": torch.zeros(1)}, {})
    text, link, cut = tmp_path / "text", tmp_path / "link", tmp_path / "cut"
    text.write_text("mine")
    link.symlink_to(saved)
    cut.write_bytes(saved.read_bytes()[:-1])
    for path in (other, text, link, cut):
        before = path.read_bytes()
        with pytest.raises(ValueError, match="must not be replaced, is no planner's file that can be read; choose"):
            planner.save(path)
        assert path.read_bytes() == before
    refused(other, "must be what Planner.save has written, is a checkpoint of a fit")
    with pytest.raises(FileNotFoundError, match="found none"):
        Planner.load(tmp_path / "none")
    with pytest.raises(ValueError, match="notes must be JSON, got what is none") as error:
        planner.save(tmp_path / "new", notes={"x": object()})
    assert "\n" not in str(error.value)
    assert not (tmp_path / "new").exists()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
