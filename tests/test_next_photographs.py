"""`drgs capture --more`: where to stand for the next photograph and where to look, by geometry and in words."""

from __future__ import annotations

import dataclasses
import json
import math

import json_page
import numpy as np
import pytest
import torch
from test_data import save, write_image
from test_view import viewers  # noqa: F401
from viewing_client import Client

import drgs
from drgs import cli
from drgs.cameras import Camera, c2w_to_opengl, intrinsics, look_at
from drgs.capturing import next_views
from drgs.capturing.next_views import rank_next
from drgs.capturing.places import Place, length_in_words, meters_of, places_around
from drgs.commands.options import View
from drgs.commands.scene_input import SceneInput
from drgs.commands.view import subject_of
from drgs.data import load
from drgs.data.camera_layout import level_frame, upright
from drgs.fitting.config import FitConfig
from drgs.train import fit
from drgs.viewing import panel
from drgs.viewing.placed_views import placed_views_of, read_ranking

UP = np.array([0.0, 0.0, 1.0])
SIZE = 48
GAP = (250.0, 360.0)  # degrees around the scene without a photograph


def camera_at(eye, target=(0, 0, 0), name="", up=UP) -> Camera:
    return Camera(intrinsics(60, 60, SIZE / 2, SIZE / 2), look_at(eye, target, up), SIZE, SIZE, name=name)


def on_ring(degrees: float, name: str = "", height: float = 0.6) -> Camera:
    angle = math.radians(degrees)
    level = math.sqrt(9 - height**2)
    return camera_at((level * math.cos(angle), level * math.sin(angle), height), name=name)


def degrees_of(eye) -> float:
    return math.degrees(math.atan2(eye[1], eye[0])) % 360


@pytest.fixture(scope="module")
def half_seen(tmp_path_factory):
    """A run on three rounds of photographs from around a ball, but for a third of the way."""
    folder = tmp_path_factory.mktemp("ball")
    generator = torch.Generator().manual_seed(3)
    n = 400
    normals = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)
    ball = drgs.Gaussians.from_arrays(
        0.8 * normals,
        torch.randn(n, 4, generator=generator),
        torch.full((n, 3), 0.08),
        torch.full((n,), 0.95),
        torch.rand(n, 1, 3, generator=generator) * 3 - 1.5,
    )
    rows = []
    rounds = [(degrees, height) for height in (-1.6, 0.0, 1.6) for degrees in np.linspace(0, GAP[0], 9)]
    for index, (degrees, height) in enumerate(rounds):
        camera = on_ring(degrees, f"IMG_{index:02d}", height)
        rgb = drgs.render(ball, camera).rgb
        write_image(folder / f"data/images/{camera.name}.png", (rgb.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
        pose = c2w_to_opengl(camera.c2w).tolist()
        rows.append({"file_path": f"images/{camera.name}.png", "transform_matrix": pose})
    lens = {"w": SIZE, "h": SIZE, "fl_x": 60, "fl_y": 60, "cx": SIZE / 2, "cy": SIZE / 2}
    save(folder / "data", {**lens, "frames": rows})
    dataset = load(folder / "data", test_every=0)
    # Where no photograph looks, nothing is known.
    centers = np.stack([view.camera.center for view in dataset.views])
    means = ball.means.numpy().astype(np.float64)
    faces = ((centers[:, None] - means) * normals.numpy()).sum(axis=2) / np.linalg.norm(
        centers[:, None] - means, axis=2
    )
    dataset.points = means[faces.max(axis=0) > 0.2]
    dataset.colors = np.full((len(dataset.points), 3), 0.5)
    config = FitConfig().replace(max_steps=60, max_gaussians=n, test_every=0, renderers=("fast",), skybox="off")
    fit(dataset, folder / "run", config, progress=False)
    return folder / "run"


@pytest.mark.slow
def test_the_first_place_looks_at_the_hole(half_seen, capsys):
    """It stands where no photograph was taken from and looks at the ball; the words say the way there."""
    assert cli.main(["capture", "--more", "-k", "4", "-o", str(half_seen)]) == 0
    out = capsys.readouterr().out
    assert out.endswith(f"; in the browser: drgs view {half_seen}\n")
    found = json.loads((half_seen / "next.json").read_text())
    first = found["picks"][0]
    c2w = np.array(first["camera"]["c2w"])
    eye, axis = c2w[:3, 3], c2w[:3, 2]
    assert GAP[0] + 10 < degrees_of(eye) < GAP[1] - 10
    assert np.linalg.norm(eye + axis * (-eye @ axis)) < 0.5  # how far the middle of the ball is from the axis
    # From a photograph at the edge of the gap, towards its inside.
    assert first["base"] in ("IMG_00", "IMG_08", "IMG_09", "IMG_17", "IMG_18", "IMG_26")
    side = "left" if first["base"] in ("IMG_00", "IMG_09", "IMG_18") else "right"
    assert f"go where {first['base']} was taken, then" in first["text"]
    assert f"to the {side}" in first["text"]
    assert first["gain"] > 2
    assert f"1. {first['text']}" in out
    scores = [row["score"] for row in found["candidates"]]
    assert first["score"] == max(scores)
    assert len({pick["name"] for pick in found["picks"]}) == 4
    json_page.check("next.json", found, maps=("parts",), absent=("capture", "select", "--length", "--region"))
    assert read_ranking(half_seen / "next.json").picked[0] == first["name"]


def test_what_a_place_adds_does_not_depend_on_how_many_are_compared(half_seen, monkeypatch):
    """Places and photographs have one unit: a copy of a photograph adds as much, be there one of each or two."""

    def gain(times):
        def copies(gaussians, cameras, train, settings):
            named = [dataclasses.replace(x, name=f"{x.name}-{i}") for x in train for i in range(times)]
            return [Place(camera, "IMG_00", np.zeros(3), (0, 0, 0), 1.0, 0.0) for camera in named]

        monkeypatch.setattr(next_views, "reachable_places", copies)
        return rank_next(half_seen, 1, None, show=False)[0]["gain"]

    assert 0 < gain(1) < 1
    assert gain(2) == pytest.approx(gain(1), rel=1e-3)


def test_the_report_and_the_viewer_lead_there(half_seen):
    """An arrow for each place on the map of the cameras, with its words; in the viewer with the score, too."""
    picks = rank_next(half_seen, 3, None, show=False)
    assert cli.main(["report", str(half_seen), "--quiet"]) == 0
    page = (half_seen / "report.html").read_text()
    assert "to be taken next (3)" in page
    assert all(f"<li>{pick['text']}</li>" in page for pick in picks)
    ranking = read_ranking(half_seen / "next.json")
    views = placed_views_of(load(half_seen.parent / "data").views, [], ranking)
    sights = {placed.best.camera.name: placed for placed in views}
    for number, pick in enumerate(picks, 1):
        placed = sights[pick["name"]]
        assert placed.kind == "candidate"
        assert placed.best.pick == number
        assert placed.best.way.origin == pytest.approx(pick["origin"])
        assert pick["text"] in panel.photograph(placed, placed.best)
    damaged = json.loads((half_seen / "next.json").read_text())
    damaged["picks"][0]["origin"] = damaged["candidates"][0]["origin"] = [1.0]
    (half_seen / "next.json").write_text(json.dumps(damaged))
    with pytest.raises(ValueError, match="origin must be 3 numbers"):
        read_ranking(half_seen / "next.json")
    assert cli.main(["report", str(half_seen), "--quiet"]) == 2


def test_arrows_in_the_viewer(half_seen, viewers):  # noqa: F811
    """One to each place, from where the photograph was taken that it is told from."""
    picks = rank_next(half_seen, 2, None, show=False)
    args = View(scene=half_seen, preset="fast")
    looked = subject_of(args, SceneInput.of(args))
    viewer = viewers(looked)
    with Client(viewer.port) as client:
        client.look(looked.first.pose.wxyz, looked.first.pose.position)
        drawn = client.wait(lambda m: m.get("name") == "/ways" and "props" in m)["props"]["points"]
    points = np.frombuffer(drawn, np.float32).reshape(-1, 2, 3) if isinstance(drawn, bytes) else np.asarray(drawn)
    wanted = {(*pick["origin"], *np.array(pick["camera"]["c2w"])[:3, 3]) for pick in picks}
    for row in points.reshape(-1, 6):
        assert min(np.abs(np.array(other) - row).max() for other in wanted) < 1e-4
    assert len(points) == 2


def test_places_that_look_at_a_region(half_seen, capsys):
    """For the side of the ball that is on the one or the other end of the hole, places are on that end."""
    found = {}
    for degrees in (GAP[0], GAP[1]):
        x, y = (0.7 * f(math.radians(degrees)) for f in (math.cos, math.sin))
        region = f"sphere:{x:.3f},{y:.3f},0,0.4"
        assert cli.main(["capture", "--more", "-k", "1", "-o", str(half_seen), "--region", region]) == 0
        written = json.loads((half_seen / "next.json").read_text())
        assert written["region"] == region
        eye = np.array(written["picks"][0]["camera"]["c2w"])[:3, 3]
        found[degrees] = abs((degrees_of(eye) - degrees + 180) % 360 - 180)
    assert all(apart < 90 for apart in found.values())
    capsys.readouterr()
    assert cli.main(["capture", "--more", "-o", str(half_seen), "--region", "ball"]) == 2
    assert "region must be box:" in capsys.readouterr().err
    assert cli.main(["capture", str(half_seen), "-o", str(half_seen / "x"), "--region", "sphere:0,0,0,1"]) == 2
    assert "--region must have --more" in capsys.readouterr().err


def test_lengths_in_meters(half_seen):
    """A distance between two photographs makes meters of all of them."""
    base = math.dist(on_ring(0).center, on_ring(25).center)
    found = rank_next(half_seen, 1, f"IMG_00 IMG_01 {base / 2:.6f} m", show=False)[0]
    way = found["text"].partition("then ")[2].partition(" to the")[0]
    moved = np.array(found["camera"]["c2w"])[:3, 3] - found["origin"]
    length = float(way.removesuffix(" cm")) / 100 if way.endswith(" cm") else float(way.removesuffix(" m"))
    assert length == pytest.approx(np.linalg.norm(moved) / 2, abs=0.06)


def test_bad_options(half_seen, tmp_path, capsys):
    for line, words in (
        (["--length", "IMG_00 1 m"], "--length must be two photographs and a length"),
        (["--length", "IMG_00 IMG_99 1 m"], "--length must name photographs with a pose, got 'IMG_99'"),
        (["--length", "IMG_00 IMG_00 1 m"], "must be between two places"),
        (["-k", "0"], "-k must be in [1, 1000000000], got 0"),
        (["photos"], "--more must have no photographs"),
    ):
        assert cli.main(["capture", *line[:1], *line[1:], "--more", "-o", str(half_seen)]) == 2
        assert words in capsys.readouterr().err
    assert cli.main(["capture", "--more", "-o", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err


def place_from(camera: Camera, move: tuple[float, float, float]) -> Place:
    """A place in a world without things that is so far from a photograph."""
    found = places_around([camera], UP, lambda camera: 2.0, np.zeros((0, 3)), most=10_000)
    return next(place for place in found if place.move == move)


@pytest.mark.parametrize("degrees", [0, 90, 217])
@pytest.mark.parametrize(
    ("move", "words"),
    [
        ((1 / 3, 0.0, 0.0), "a third of the way to the right"),
        ((-2 / 3, 0.0, 0.0), "two thirds of the way to the left"),
        ((0.0, 1 / 3, 0.0), "a third of the way higher"),
        ((0.0, -1 / 4, 0.0), "a quarter of the way lower"),
        ((0.0, 0.0, 1 / 3), "a third of the way closer"),
        ((0.0, 0.0, -1 / 3), "a third of the way farther back"),
        ((-1 / 3, 1 / 3, 0.0), "a third of the way to the left and a third of the way higher"),
    ],
)
def test_words_go_by_the_axes_of_the_photograph(degrees, move, words):
    """Right of a photograph is where its columns grow, up is against its rows, closer is along its axis, of one that is
    held level; the place looks at what was in the middle.
    """
    angle = math.radians(degrees)
    base = camera_at((3 * math.cos(angle), 3 * math.sin(angle), 0.0), name="IMG_7")
    place = place_from(base, move)
    local = base.c2w[:3, :3].T @ (place.camera.center - base.center)
    np.testing.assert_allclose(local, (2 * move[0], -2 * move[1], 2 * move[2]), atol=1e-9)
    assert place.words().startswith(f"go where IMG_7 was taken, then {words}; look ")
    target = base.center + 2 * base.c2w[:3, 2]
    pixel, depth = place.camera.project(target[None])
    assert depth[0] > 0
    np.testing.assert_allclose(pixel[0], (SIZE / 2, SIZE / 2), atol=1e-6)
    looks = place.camera.c2w[2, 2]  # upwards
    assert ("down" in place.words().partition("look")[2]) == (looks < -0.09)
    assert ("degrees up" in place.words()) == (looks > 0.09)
    # What is left in the photograph's picture is left in that of the place.
    assert place.camera.c2w[:3, 0] @ base.c2w[:3, 0] > 0.5


def test_places_look_down_by_as_much_as_they_say():
    """From above, by the angle of the axis below the horizon."""
    place = place_from(camera_at((3, 0, 0), name="a"), (0.0, 1 / 3, 0.0))
    below = math.degrees(math.asin(-place.camera.c2w[2, 2]))
    assert f"look {below:.0f} degrees down" in place.words()
    assert below == pytest.approx(math.degrees(math.atan2(1 / 3, 1)))


def test_a_camera_that_looks_straight_down():
    """Ahead is where the upper edge of its picture points; right is right in the picture."""
    camera = camera_at((0, 0, 3), name="a", up=(0, 1, 0))
    right, up, ahead = level_frame(camera, UP)
    np.testing.assert_allclose(ahead, (0, 1, 0), atol=1e-9)
    np.testing.assert_allclose(right, camera.c2w[:3, 0], atol=1e-9)
    np.testing.assert_allclose(up, UP)


def test_places_keep_clear_of_things():
    """Of a wall behind the photograph, and of the way through one at its side; others stay."""
    camera = camera_at((3, 0, 0), name="a")
    grid = np.linspace(-2, 2, 41)
    behind = np.array([(3.3, y, z) for y in grid for z in grid])
    free = {place.move for place in places_around([camera], UP, lambda camera: 2.0, np.zeros((0, 3)))}
    walled = {place.move for place in places_around([camera], UP, lambda camera: 2.0, behind)}
    assert (0.0, 0.0, -1 / 3) in free - walled
    assert (0.0, 0.0, 1 / 3) in walled
    right = camera.c2w[:3, 0]
    side = np.array([camera.center + 0.5 * right + (x, 0, z) for x in grid / 4 for z in grid])
    walled = {place.move for place in places_around([camera], UP, lambda camera: 2.0, side)}
    assert {(1 / 3, 0.0, 0.0), (2 / 3, 0.0, 0.0)} & walled == set()
    assert (-1 / 3, 0.0, 0.0) in walled


def test_places_are_new_and_within_reach():
    """None near a photograph or another place, none far above or below all photographs, none of what sees nothing."""
    cameras = [on_ring(degrees, str(degrees)) for degrees in range(0, 120, 10)]
    found = places_around(cameras, UP, lambda camera: 3.0, np.zeros((0, 3)), most=1000)
    eyes = np.stack([place.camera.center for place in found])
    taken = np.concatenate([np.stack([camera.center for camera in cameras]), eyes])
    apart = np.linalg.norm(taken[:, None] - eyes[None], axis=2)
    apart[apart == 0] = np.inf
    assert apart.min() >= 0.15 * 3.0 - 1e-9
    assert eyes[:, 2].min() >= 0.6 - 0.25 * 3 - 1e-9
    assert eyes[:, 2].max() <= 0.6 + 0.5 * 3 + 1e-9
    assert places_around(cameras, UP, lambda camera: None, np.zeros((0, 3))) == []
    assert len(places_around(cameras, UP, lambda camera: 3.0, np.zeros((0, 3)), most=7)) == 7


def test_up_of_level_photographs():
    """Words of height go by it."""
    np.testing.assert_allclose(upright([on_ring(degrees) for degrees in range(0, 200, 20)]), UP, atol=0.02)


@pytest.mark.parametrize(
    ("share", "meters", "words"),
    [
        (1 / 3, None, "a third of the way"),
        (0.52, None, "half of the way"),
        (1.0, None, "the whole way"),
        (1.4, None, "1.4 times the way"),
        (0.5, 1.0, "50 cm"),
        (0.5, 3.0, "1.5 m"),
        (0.97, 1.0, "1.0 m"),
    ],
)
def test_lengths_in_words(share, meters, words):
    assert length_in_words(share, meters) == words


def test_known_lengths():
    """Between photographs whose names hold spaces, with or without their suffix, in meters or centimeters."""
    centers = {"my photo 1": np.zeros(3), "IMG_2": np.array([0, 4.0, 3.0])}
    assert meters_of("my photo 1 IMG_2 2.5 m", centers) == pytest.approx(0.5)
    assert meters_of("my photo 1 IMG_2.JPG 50cm", centers) == pytest.approx(0.1)
