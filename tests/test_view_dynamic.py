"""Claims of `drgs view` on a run that moves: watched from its static stage on, back again, and at times it has not."""

from __future__ import annotations

import pytest

pytest.importorskip("viser", reason="no viser: pip install 'drgs[view]'")

from test_dynamic_fit import Killed, _small_field, config, dataset  # noqa: F401 (photographs of what moves)
from test_view import html, viewers  # noqa: F401
from viewing_client import Client

from drgs.commands import view
from drgs.commands.options import View
from drgs.commands.scene_input import SceneInput
from drgs.commands.view import subject_of
from drgs.train import Trainer, fit

ADVICE = ("must have a time", "the span of the field", "Error", "None")


@pytest.fixture
def stages(dataset, tmp_path, monkeypatch):  # noqa: F811
    """A run and its two checkpoints: of the static stage, and of the dynamic one."""
    step = Trainer.step

    def killed(self):
        if self.step_index == 3:
            raise Killed
        return step(self)

    run = tmp_path / "run"
    monkeypatch.setattr(Trainer, "step", killed)
    with pytest.raises(Killed):
        fit(dataset, run, config(), progress=False)
    monkeypatch.setattr(Trainer, "step", step)
    still = (run / "state.safetensors").read_bytes()
    fit(dataset, run, config(), resume=True, progress=False)
    return run, still, (run / "state.safetensors").read_bytes()


def failures(client: Client, after: int = 0) -> list[str]:
    return [text for text in client.said()[after:] if any(word in text for word in ADVICE)]


def test_a_run_becomes_dynamic_and_goes_on(stages, viewers, capfd):  # noqa: F811
    """A browser that has been there since the static stage gets a slider when the run begins to move, one however often
    that happens, loses it where nothing moves, and has a picture of every layer each time."""
    run, still, moving = stages
    args = View(scene=run, preset="fast")

    def now(state: bytes) -> None:
        (run / "next").write_bytes(state)  # as a fit does: what reads the file before keeps its own
        (run / "next").replace(run / "state.safetensors")

    now(still)
    viewer = viewers(subject_of(args, SceneInput.of(args)))
    assert viewer.subject.times == ()
    pose = viewer.subject.first.pose
    with Client(viewer.port) as client:
        client.look(pose.wxyz, pose.position)
        client.picture()
        assert "time" not in client.labels()
        for round_, state in enumerate((moving, still, moving, still), 1):
            at = len(client.heard)
            now(state)
            viewer.worker.put("files", view._reload_job(args, viewer))
            html(client, f"step {12 if state is moving else 2} of 12", after=at)
            client.picture(after=at)
            (session,) = viewer.sessions.values()
            assert session.time == (0.0 if state is moving else None)
            if state is still:
                continue
            for layer in viewer.subject.layers[1:2] if round_ > 1 else viewer.subject.layers[1:]:
                at = len(client.heard)
                client.choose("show", layer.name)
                html(client, f"{layer.name}, fast: 1", after=at)
            slider = [m for m in client.heard if (m.get("props") or {}).get("label") == "time"][-1]
            for value, at_last in ((1.5, 1.0), (-3.0, 0.0), (0.5, 0.5), (1.0, 1.0), (float("nan"), 0.0)):
                at = len(client.heard)
                client.send(type="GuiUpdateMessage", uuid=slider["uuid"], updates={"value": value})
                client.wait(lambda m: "buffer" in str(m.get("updates", {}).keys()), after=at)
                client.picture(after=at)
                assert session.time == at_last
            client.choose("play", True)  # it plays when it becomes static again
        made = [m["uuid"] for m in client.heard if (m.get("props") or {}).get("label") == "time"]
        gone = [m["uuid"] for m in client.heard if m["type"] == "GuiRemoveMessage"]
        assert len(made) == 2
        assert set(made) <= set(gone)
        assert not failures(client)
    assert "Traceback" not in "".join(capfd.readouterr())
