"""Times of views: cameras and files carry them, and a scene that moves is rendered as it is at the camera's time."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from scenes_random import assert_same_sums
from test_data import gradient, write_image, write_transforms

from drgs.cameras import Camera, orbit
from drgs.checks.arguments import ArgumentError
from drgs.data import load
from drgs.data.camera_lists import load_cameras_json, save_cameras_json
from drgs.data.view_checks import check_cameras, check_parallax
from drgs.data.views import View
from drgs.ellipsoids import Gaussians, Scene
from drgs.fitting.frames import load_frames
from drgs.integrator import render, render_jvp
from drgs.select import select

pytestmark = pytest.mark.core


class Drift:
    """Gaussians that move with constant velocities: the smallest scene with a time."""

    def __init__(self, start: Gaussians, velocities: torch.Tensor):
        self.start, self.velocities = start, velocities

    def at(self, time: float | None) -> Gaussians:
        if time is None:
            raise ValueError("Drift.at: the view must have a time, got None; set Camera.time")
        return self.start.replace(means=self.start.means + time * self.velocities)

    def parameters(self) -> dict[str, torch.Tensor]:
        return {**self.start.parameters(), "velocities": self.velocities}


VIEW = orbit((0, 0, 0), 4.0, 1, width=24, height=16)[0]


def make(**changes) -> Camera:
    """A camera with a lens; fields may be changed."""
    K = np.array([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]])
    fields = {"K": K, "w2c": np.eye(4), "width": 24, "height": 16, "model": "opencv", "distortion": (0.1, 0, 0, 0)}
    return Camera(**{**fields, **changes})


def gaussians(rng, features: int = 0) -> Gaussians:
    """A few Gaussians in front of `VIEW`."""
    n = 8
    arrays = rng.normal(size=(n, 3)), rng.normal(size=(n, 4)), rng.uniform(0.1, 0.3, (n, 3)), rng.uniform(0.3, 0.9, n)
    f = rng.normal(size=(n, features)) if features else None
    return Gaussians.from_arrays(*(x.astype(np.float32) for x in arrays), rng.normal(size=(n, 3)) * 0.4, f)


def drift(rng) -> Drift:
    """The same, and velocities of some of their widths in a unit of time."""
    return Drift(gaussians(rng), torch.from_numpy(rng.normal(size=(8, 3)).astype(np.float32)))


def test_a_camera_keeps_its_time():
    """Whatever is made of a camera has its time; a camera has none unless it is given one."""
    timed = make(time=0.25)
    assert make().time is None
    for same in (timed.resized(12, 8), timed.undistorted(), dataclasses.replace(timed, name="b")):
        assert same.time == 0.25
    assert [make(time=value).time for value in (3, np.float32(0.5), -1e300)] == [3.0, 0.5, -1e300]
    assert type(make(time=np.int64(3)).time) is float


@pytest.mark.parametrize(
    "time",
    ["0.5", math.nan, -math.inf, -(10**400), True, np.zeros(1), torch.tensor(0.5)],
    ids=lambda x: type(x).__name__,
)
def test_a_time_must_be_a_number(time):
    """Anything but a finite number is refused in one line; a tensor, too, whose gradient would be lost."""
    with pytest.raises(ArgumentError, match=r"^Camera 'a': time must be a finite number, or None, got .*; correct it$"):
        make(name="a", time=time)


def test_cameras_json_holds_times(tmp_path):
    """A time comes back to the bit; the file of cameras without one has no such key; a bad one names its camera."""
    path = tmp_path / "cameras.json"
    save_cameras_json(path, [make(model="pinhole", distortion=(), time=time) for time in (None, 1 / 3)])
    entries = json.loads(path.read_text())
    assert "time" not in entries[0]
    assert [camera.time for camera in load_cameras_json(path)] == [None, 1 / 3]
    entries[0]["time"] = None
    path.write_text(json.dumps(entries))
    assert load_cameras_json(path)[0].time is None
    entries[1]["time"] = "late"
    path.write_text(json.dumps(entries))
    with pytest.raises(ValueError, match=r"cameras\.json: camera 1: .*time must be a finite number, or None, got") as e:
        load_cameras_json(path)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("lazy", [False, True])
def test_transforms_hold_times_of_frames(tmp_path, lazy):
    """The time of a frame reaches its view and its photograph; one at the top of the file is no frame's."""
    data = write_transforms(tmp_path, time="noon")
    for index, frame in enumerate(data["frames"][:2]):
        frame["time"] = index / 2
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    views = load(tmp_path, lazy=lazy).views
    assert [view.camera.time for view in views] == [0.0, 0.5, None]
    assert [frame.camera.time for frame in load_frames(views, 100)] == [0.0, 0.5, None]
    data["frames"][1]["time"] = [0.5]
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(
        ValueError, match=r"transforms\.json: frame 1: .*time must be a finite number, or None"
    ) as error:
        load(tmp_path, lazy=lazy)
    assert "\n" not in str(error.value)


def test_views_of_one_pose_at_several_times_are_not_duplicates(tmp_path, caplog):
    """Two photographs from one place at two times are two views; without times they are told of."""
    data = write_transforms(tmp_path)
    data["frames"][1]["transform_matrix"] = data["frames"][0]["transform_matrix"]
    write_image(tmp_path / data["frames"][1]["file_path"], gradient() // 2)
    for times, told in (((0.0, 1.0, 0.0), False), ((None, None, None), True)):
        for frame, time in zip(data["frames"], times, strict=True):
            frame["time"] = time
        (tmp_path / "transforms.json").write_text(json.dumps(data))
        caplog.clear()
        check_parallax(load(tmp_path).views)
        assert ("have the pose of another one" in caplog.text) == told


@pytest.mark.parametrize(("count", "told"), [(1, False), (2, True), (3, True), (4, False), (8, False)])
@pytest.mark.parametrize("is_moving", [True, False])
def test_few_cameras_before_what_moves_are_told_of(caplog, count, told, is_moving):
    """What stands still is another matter, and a fit says nothing of one place twice."""
    around = orbit((0, 0, 0), 3.0, count, width=8, height=6)
    views = [
        View(dataclasses.replace(camera, time=time if is_moving else None), f"cam{index}/{time}")
        for index, camera in enumerate(around)
        for time in (0.0, 0.5, 1.0)
    ]
    for view in views if count > 1 else ():  # stands whose cameras are calibrated anew for every time
        view.camera = dataclasses.replace(
            view.camera, w2c=view.camera.w2c + 1e-5 * (view.camera.time or 0) * np.eye(4, k=3)
        )
    check_cameras(views)
    assert (f"the {3 * count} training views of 3 times are from {count} places only" in caplog.text) == (
        told and is_moving
    )
    assert ("film with 6 cameras or more" in caplog.text) == (told and is_moving)


def test_a_camera_that_stands_still_has_views_at_several_times(caplog):
    """It is warned that they tell no depth; of one time they are refused, as a camera file that is wrong."""
    views = [View(dataclasses.replace(VIEW, time=time), str(time)) for time in (0.0, 0.5, 1.0)]
    check_parallax(views)
    assert "all 3 training views stand in one place: the photographs determine no depths" in caplog.text
    for time in (None, 0.5):
        with pytest.raises(ValueError, match=r"^the 3 training views must have poses of their own, all have the same"):
            check_parallax([View(dataclasses.replace(VIEW, time=time), view.name) for view in views])


def test_a_scene_is_rendered_at_the_time_of_the_camera(rng):
    """The image is that of the Gaussians at that time, to the bit, and gradients reach what moves them."""
    scene, view = drift(rng), dataclasses.replace(VIEW, time=0.3)
    assert isinstance(scene, Scene)
    assert isinstance(scene.start, Scene)
    scene.velocities.requires_grad_()
    image = render(scene, view).rgb
    assert torch.equal(image, render(scene.at(0.3), view).rgb)
    assert not torch.equal(image, render(scene, dataclasses.replace(view, time=0.4)).rgb)
    image.square().sum().backward()
    means = scene.at(0.3).means.detach().requires_grad_()
    render(scene.start.replace(means=means), view).rgb.square().sum().backward()
    assert means.grad.abs().max() > 0
    assert_same_sums(scene.velocities.grad, 0.3 * means.grad)
    tangents = {"means": torch.ones_like(means)}
    assert torch.equal(render_jvp(scene, view, tangents).rgb, render_jvp(scene.at(0.3), view, tangents).rgb)
    with pytest.raises(ValueError, match="the view must have a time"):
        render(scene, VIEW)


def test_gaussians_are_their_own_scene(rng):
    """Without a time they are what they are, at any time; what has no Gaussians at a time is refused by name."""
    g = gaussians(rng)
    assert g.at(0.7) is g
    assert g.at() is g
    assert torch.equal(render(g, VIEW).rgb, render(g, dataclasses.replace(VIEW, time=3.0)).rgb)

    class Wrong(Drift):
        def at(self, time):
            return self.start.means

    with pytest.raises(ArgumentError, match=r"render: scene\.at\(time\) must be a Gaussians, got a Tensor of shape"):
        render(Wrong(g, g.means), VIEW)

    class Field(torch.nn.Module):
        def at(self, time):
            return g

    told = (
        r"scene\.parameters\(\) must be a Mapping, got a value of type generator; .*dict\(self\.named_parameters\(\)\)"
    )
    for refused in (lambda: render(Field(), VIEW), lambda: select(Field(), [VIEW], [VIEW], 1)):
        with pytest.raises(ArgumentError, match=told):
            refused()


def test_gaussians_go_to_a_device(rng):
    """Only the device changes, features and origin included; where they are already nothing is copied."""
    g = gaussians(rng, 3).replace(origin=np.array([1.0, 2, 3]))
    there = g.to("meta")
    for name, x in there.parameters().items():
        assert x.device.type == "meta"
        assert (x.dtype, x.shape) == (g.parameters()[name].dtype, g.parameters()[name].shape)
    assert np.array_equal(there.origin, g.origin)
    here = g.to(g.means.device)
    assert all(x is here.parameters()[name] for name, x in g.parameters().items())
