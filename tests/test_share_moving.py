"""What moves in the page of `drgs share`."""

from __future__ import annotations

import dataclasses
import importlib.resources
import json
import shutil
import subprocess

import numpy as np
import pytest
import torch
from test_dynamic_fit import _small_field, dataset, run  # noqa: F401 (fixtures)
from test_share_browser import BACKGROUND, CAMERAS, decibels, ours, picture, shown  # noqa: F401 (a fixture)
from test_view_browser import browsers, once_more  # noqa: F401 (a fixture)

from drgs.codecs.clustering import morton_order
from drgs.commands.options import Share
from drgs.commands.share import shared_of
from drgs.deform import DynamicGaussians
from drgs.dynamics.lifespans import Lifespans
from drgs.pages.sharing.layers import motion_layer
from drgs.pages.sharing.write import write_page


def shared_of_run(run):  # noqa: F811
    """What its page shows, with a field that moves what may move: six steps have taught it next to nothing."""
    shared = shared_of(Share(scene=run.path, uncertainty=False, moments=5))
    torch.manual_seed(0)
    with torch.no_grad():
        for name, weights in shared.moving.field.named_parameters():
            weights += (3.0 if name == "mlp.means.3.weight" else 0.2) * torch.randn_like(weights)
        shared.moving.gaussians.logit_opacities.add_(4.0)
    moving = shared.moving.without_lifespans()
    return dataclasses.replace(shared, moving=moving, gaussians=moving.at(shared.times[0]).detach())


def test_moments(run):  # noqa: F811
    """Numbers of 16 bits say where what moves is at each moment, to their step; what stands still is left out."""
    shared = shared_of_run(run)
    order = morton_order(shared.gaussians.means.numpy())
    known, places, codes, lives = motion_layer(shared.moving, shared.times, shared.gaussians, order)
    places = np.frombuffer(places, "<u4")
    codes = np.frombuffer(codes, "<u2").reshape(len(shared.times), 10, len(places))
    low, high = np.array(known["low"]), np.array(known["high"])
    values = low[:, None] + (high - low)[:, None] * codes / 65535
    assert 0 < len(places) < len(shared.gaussians)  # the gates of five are open
    assert not np.frombuffer(lives, "<f4").any()  # all are always there
    for time, value in zip(shared.times, values, strict=True):
        with torch.no_grad():
            truth = shared.moving.at(time).means.numpy()[order][places].T
        step = ((high - low)[:3, None] / 65535).clip(1e-6)
        assert (np.abs(value[:3] - truth) < step).all()


@once_more
def test_a_moment_in_a_browser(shown, run, tmp_path):  # noqa: F811
    """At a moment that the page has, and at one between two, it draws what our `gsplat` draws of the Gaussians then."""
    times = tuple(np.linspace(*(float(x) for x in shared_of_run(run).moving.field.grid.span), 5))
    looked = shared_of_run(run)
    cameras = [("fitted", dataclasses.replace(at, time=times[0])) for at in CAMERAS[:1]]
    looked = dataclasses.replace(looked, cameras=cameras, times=times, background=BACKGROUND)
    write_page(looked, tmp_path / "x.html")
    pictures = []
    for time in (times[0], times[3], 0.5 * (times[3] + times[4])):
        page = shown(tmp_path / "x.html", f"bare&time={time}")
        pictures.append(picture(page))
        with torch.no_grad():
            truth = ours(looked.moving.at(time), CAMERAS[0])
        assert decibels(pictures[-1], truth) > 40
    assert decibels(pictures[0], truth) < decibels(pictures[-1], truth) - 6  # it has moved meanwhile


def with_lives(shared):
    """The same, half of it there for a time, and away from where it is at its birth."""
    scene = shared.moving
    n = len(scene)
    first, last = (float(x) for x in scene.field.grid.span)
    widths = torch.full((n,), 0.2 * (last - first)).log()
    widths[::2] = 5.0  # of spans of 1: always
    velocities = torch.tensor([0.6, 0.1, 0.0]).expand(n, 3) / (last - first)
    bent = torch.tensor([0.0, 0.4, 0.0]).expand(n, 3) / (last - first) ** 2
    lives = Lifespans(torch.linspace(first, last, n), widths, velocities, bent, torch.full((n,), first))
    return dataclasses.replace(shared, moving=DynamicGaussians(scene.gaussians, scene.field, scene.motion, lives))


def test_lives_of_a_page(run):  # noqa: F811
    """What is there for a time is told by numbers of its own; moments say where it would be all the time."""
    shared = with_lives(shared_of_run(run))
    order = morton_order(shared.gaussians.means.numpy())
    _, places, _, lives = motion_layer(shared.moving, shared.times, shared.gaussians, order)
    places, lives = np.frombuffer(places, "<u4"), np.frombuffer(lives, "<f4").reshape(9, -1)
    living = shared.moving.has_lifespan.numpy()[order]
    assert set(np.flatnonzero(living)) <= set(places.tolist())
    assert (lives[1] > 0).tolist() == living[places].tolist()
    held = shared.moving.lifespans
    held_rows = (held.centers, held.log_widths.exp(), *held.velocities.T, *held.accelerations.T, held.reference_times)
    for row, x in enumerate(held_rows):
        np.testing.assert_allclose(lives[row][living[places]], x.numpy()[order][places][living[places]], rtol=1e-6)


@once_more
def test_lives_in_a_browser(shown, run, tmp_path):  # noqa: F811
    """At two moments it draws what our `gsplat` draws of those that are there then, where they are."""
    shared = with_lives(shared_of_run(run))
    times = tuple(np.linspace(*(float(x) for x in shared.moving.field.grid.span), 5))
    cameras = [("fitted", dataclasses.replace(at, time=times[0])) for at in CAMERAS[:1]]
    looked = dataclasses.replace(shared, cameras=cameras, times=times, background=BACKGROUND)
    write_page(looked, tmp_path / "x.html")
    pictures = []
    for time in (times[3], times[1]):
        pictures.append(picture(shown(tmp_path / "x.html", f"bare&time={time}")))
        with torch.no_grad():
            assert decibels(pictures[-1], ours(looked.moving.at(time), CAMERAS[0])) > 38
    with torch.no_grad():
        assert decibels(pictures[0], ours(looked.moving.at(times[1]), CAMERAS[0])) < 32


# What the page's own code asks of Spark: words whose lower half is an opacity, here in thousandths.
SPARK = """
export class RgbaArray { constructor({ array }) { this.array = array; } dispose() {} }
export const [ExtSplats, SparkRenderer, SplatFileType, SplatMesh] = [];
export const mesh = { updateGenerator() {}, updateVersion() {} };
export function splatsOf(opacities) {
  const words = new Uint32Array(4 * opacities.length);
  const setSplat = (i, center, scales, quaternion, opacity) => {
    words[4 * i + 3] = 0xabcd0000 + Math.round(1000 * opacity);
  };
  const getSplat = (i) => ({ opacity: (words[4 * i + 3] & 0xffff) / 1000 });
  opacities.forEach((opacity, i) => setSplat(i, null, null, null, opacity));
  return { numSplats: opacities.length, extArrays: [words], textures: [], getSplat, setSplat };
}
"""

HIDDEN = """
import { Gaussians } from "./gaussians.mjs";
import { mesh, splatsOf } from "./spark.mjs";
const gaussians = new Gaussians(splatsOf([0.8, 0.4, 0.2]), mesh);
const found = [];
const look = () => found.push([0, 1, 2].flatMap((i) => [
  gaussians.splats.getSplat(i).opacity, mesh.splatRgba.array[4 * i + 3] / 255,
]));
gaussians.tint(new Uint8Array(9));
gaussians.move([1, 2], () => 0.5);
look();
gaussians.hide((i) => i === 1);
look();
gaussians.move([1, 2], () => 0.25);
look();
gaussians.hide(() => false);
look();
console.log(JSON.stringify(found));
"""

OPENED = """
class Element {
  style = {};
  append() {} addEventListener() {} setAttribute() {} replaceChildren() {}
}
const made = [];
globalThis.innerWidth = 1000;
globalThis.document = {
  getElementById: () => new Element(),
  createElement: () => (made.push(new Element()), made.at(-1)),
};
const { buildPanel } = await import("./panel.mjs");
const parts = { moving: new Uint32Array(1), moments: new Uint16Array(30), lives: new Float32Array(9) };
parts.moments[10] = parts.moments[20] = 65535; // the first coordinate of the center, after the first moment
const point = () => ({ set(...x) { [this.x] = x; return this; }, normalize() {} });
const centers = [];
const gaussians = {
  move: (_, poseOf) => { const center = point(); poseOf(0, center, point(), point()); centers.push(center.x); },
};
const first = { name: "all of it", kind: "other", time: null };
const moments = { times: [1, 2, 4], count: 1, low: Array(10).fill(0), high: Array(10).fill(1) };
await buildPanel({
  scene: { moments, photos: [first] }, gaussians, first, frusta: {}, steering: {}, goTo() {}, changed() {},
  bytesOfPart: async (name) => new Uint8Array(parts[name].buffer), asked: new URLSearchParams(""),
});
console.log(JSON.stringify([made.find((x) => x.type === "range").value, centers]));
"""


def answer_of(program: str, folder):
    """What a program that takes the page's own code prints, in Node.js."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("no Node.js: apt-get install nodejs")
    (folder / "spark.mjs").write_text(SPARK)
    for name in ("gaussians", "panel"):
        code = (importlib.resources.files("drgs.pages.sharing") / f"{name}.js").read_text()
        code = code.replace('"three"', '"./spark.mjs"').replace('"@sparkjsdev/spark"', '"./spark.mjs"')
        (folder / f"{name}.mjs").write_text(code)
    (folder / "program.mjs").write_text(program)
    done = subprocess.run([node, folder / "program.mjs"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_hidden_ones_stay_hidden(tmp_path):
    """As time goes on, opacities and those of a layer are those of the time, and 0 of what is hidden; what is shown
    again has the opacity of the time.
    """
    found = np.array(answer_of(HIDDEN, tmp_path)).reshape(-1, 3, 2)
    wanted = [[0.8, 0.2, 0.1], [0.8, 0.0, 0.1], [0.8, 0.0, 0.05], [0.8, 0.1, 0.05]]
    np.testing.assert_allclose(found, np.repeat(np.array(wanted)[..., None], 2, axis=2), atol=0.003)


def test_a_page_opens_at_its_first_time(tmp_path):
    """Where the first photograph has no time, the slider says what the picture shows: the first moment."""
    assert answer_of(OPENED, tmp_path) == [1, [0]]
