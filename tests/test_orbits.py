"""Turntables of made captures: frames stand where the photographs were taken from and show what they show."""

from __future__ import annotations

import numpy as np
import pytest

import drgs
from drgs.cameras import Camera, intrinsics_from_fov, look_at
from drgs.commands.orbits import capture_orbit, scene_orbit
from drgs.commands.values import OrbitShape
from drgs.data.camera_layout import Focus, path, upright
from drgs.meshing.depths import seen_distance

CENTER = np.array([1.0, 2.0, 3.0])
SIZE = {"width": 40, "height": 30}


def photo(eye, target, up=(0, 0, 1), fov=50.0) -> Camera:
    """A level photograph, 80x60."""
    K = intrinsics_from_fov(fov, 80, 60)
    return Camera(K=K, w2c=look_at(eye, target, up), width=80, height=60)


def at(azimuth: float, elevation: float = 0.0, distance: float = 1.0) -> np.ndarray:
    """A point around `CENTER`; angles in degrees, up is +z."""
    a, e = np.radians([azimuth, elevation])
    return CENTER + distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def azimuths(cameras) -> np.ndarray:
    """Degrees of the cameras around `CENTER`."""
    outward = np.array([camera.center for camera in cameras]) - CENTER
    return np.degrees(np.arctan2(outward[:, 1], outward[:, 0]))


def ring(rng, first: float, last: float, count: int = 17, elevation: float = 35.0) -> list[Camera]:
    """Hand-held photographs of something at `CENTER`, level and not quite aimed, at 3.5 to 4.5 from it."""
    made = []
    for azimuth in np.linspace(first, last, count):
        eye = at(azimuth, elevation + rng.uniform(-3, 3), rng.uniform(3.5, 4.5))
        made.append(photo(eye, CENTER + rng.uniform(-0.1, 0.1, 3)))
    return made


def check_around(cameras, photos, center, low: float, high: float) -> None:
    """All look at the center from a distance and an elevation that photographs have."""
    distances = [np.linalg.norm(camera.center - center) for camera in photos]
    for camera in cameras:
        ahead = center - camera.center
        distance = np.linalg.norm(ahead)
        assert camera.c2w[:3, 2] @ ahead > 0.999 * distance
        assert min(distances) <= distance <= max(distances)
        assert low <= np.degrees(np.arcsin(-ahead[2] / distance)) <= high
        assert abs(camera.c2w[2, 0]) < 0.05  # level: the heights that up is found from differ by 3 degrees


def wall(depth: float) -> drgs.Gaussians:
    """An opaque wall in the plane y = depth."""
    x, z = np.meshgrid(np.linspace(-9, 9, 25), np.linspace(-9, 9, 25))
    means = np.stack([x.ravel(), np.full(x.size, depth), z.ravel()], axis=-1)
    count = len(means)
    return drgs.Gaussians.from_arrays(
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 0.5),
        np.full(count, 0.95),
        np.ones((count, 1, 3)),
    )


def test_full_ring(rng):
    """Cameras all around: a full circle about what they look at, at their height, through their lens; a few
    photographs of something else do not move it.
    """
    photos = [*ring(rng, 0, 340, 18), *(photo(at(a, 30, 4), at(a, 80, 9)) for a in (10, 20, 30))]
    made, text = capture_orbit(photos, 12, **SIZE)
    assert text.startswith("circle around")
    check_around(made, photos, CENTER, 31, 39)
    np.testing.assert_allclose(np.sort(np.diff(np.sort(azimuths(made)))), 30, atol=1)
    assert made[0].K[0, 0] == pytest.approx(photos[0].K[0, 0] / 2)


def test_half_ring_is_not_left(rng):
    """Frames go back and forth within the half circle; up is not bent towards what is looked down on."""
    photos = ring(rng, 20, 200)
    np.testing.assert_allclose(upright(photos), (0, 0, 1), atol=0.03)
    made, text = capture_orbit(photos, 16, **SIZE, returns=True)
    assert text.startswith("swing of 17")  # the center is known to 0.1 at a distance of 4: 3 degrees of 180
    check_around(made, photos, CENTER, 31, 39)
    turned = azimuths(made) % 360
    assert turned.min() >= 19
    assert turned.max() <= 201
    assert np.ptp(turned) > 150
    assert len(np.unique(turned.round(3))) == 16  # no still is made twice
    steps = np.diff(np.append(turned, turned[0]))
    assert (steps > 0).any()
    assert (steps < 0).any()
    assert np.abs(steps).max() < 40  # no jump where it repeats
    # Evenly from end to end where the frames are views to be compared, all around where they are candidates.
    evenly = azimuths(capture_orbit(photos, 16, **SIZE)[0]) % 360
    assert (np.diff(evenly) > 0).all()
    around = azimuths(capture_orbit(photos, 16, **SIZE, beyond=True)[0])
    np.testing.assert_allclose(np.diff(np.sort(around)), 22.5, atol=1.5)


def test_inward_dome(rng):
    """Cameras over half a sphere: a full circle at their middle height."""
    photos = [photo(at(a, e, 4), CENTER) for e in (5, 25, 45, 65) for a in np.arange(0, 360, 30)]
    made, text = capture_orbit(photos, 8, **SIZE)
    assert text.startswith("circle around")
    for camera in made:  # the center is where the axes meet, exactly
        assert np.linalg.norm(camera.center - CENTER) == pytest.approx(4)
    check_around(made, [photo(at(0, 0, r), CENTER) for r in (3.999, 4.001)], CENTER, 25, 45)


@pytest.mark.parametrize("fan", [-1.0, 0.0, 1.0])
def test_forward_facing_grid(fan):
    """Parallel or slightly spread axes meet nowhere: the swing is about what is in the middle of the pictures, from
    places between the photographs', never behind what they look at.
    """
    photos = [photo((x, 0, z), (x + fan * x, 9, z)) for x in np.linspace(-2, 2, 5) for z in (-0.5, 0.0, 0.5)]
    made, text = capture_orbit(photos, 10, **SIZE, distance_of=seen_distance(wall(6.0)), returns=True)
    assert text.startswith("swing")
    for camera in made:
        x, y, z = camera.center
        assert abs(x) < 2.2
        assert -0.1 <= y < 0.5
        assert abs(z) < 0.5
        assert camera.c2w[:3, 2] @ (np.array([0, 6, 0]) - camera.center) > 5.9
    assert np.ptp([camera.center[0] for camera in made]) > 2.5


def test_outward_room():
    """Cameras that look out of a circle: no point in common, so frames turn as they did, inside."""
    photos = [photo(CENTER + 0.5 * (at(a) - CENTER), at(a, 0, 5)) for a in range(0, 350, 20)]
    made, text = capture_orbit(photos, 30, **SIZE, distance_of=lambda camera: 5.0)
    assert text.startswith("along the path")
    check_follows(made, photos, 12)


def test_straight_drive():
    """Cameras that look where they go: frames drive along, from the first to the last, and do not turn around."""
    photos = [photo((0.2 * (-1) ** i, i, 1), (0, i + 9, 1)) for i in range(12)]
    made, text = capture_orbit(photos, 30, **SIZE, distance_of=lambda camera: 9.0)
    assert text.startswith("along the path")
    check_follows(made, photos, 5)
    along = [camera.center[1] for camera in made]
    assert along == sorted(along)
    assert along[0] < 1.5
    assert along[-1] > 9.5


def check_follows(cameras, photos, degrees: float) -> None:
    """Each camera stands in the photographs' box and looks as some photograph beside it does."""
    eyes, axes = (np.array([x[:3, k] for x in (p.c2w for p in photos)]) for k in (3, 2))
    step = np.linalg.norm(np.diff(eyes, axis=0), axis=1).max()
    for camera in cameras:
        assert (camera.center >= eyes.min(axis=0) - 1e-9).all()
        assert (camera.center <= eyes.max(axis=0) + 1e-9).all()
        beside = np.linalg.norm(eyes - camera.center, axis=1) <= 1.5 * step
        assert (axes[beside] @ camera.c2w[:3, 2]).max() > np.cos(np.radians(degrees))


def test_path_crosses_no_wall():
    """Two rooms photographed one after the other: the path stays in the one with more photographs."""
    rooms = [photo((0.1 * i, 0, 1), (0.1 * i, 5, 1)) for i in range(9)]
    rooms += [photo((20 + 0.1 * i, 0, 1), (20 + 0.1 * i, -5, 1)) for i in range(6)]
    eyes = [np.linalg.inv(w2c)[:3, 3] for w2c in path(rooms, 20)]
    assert max(eye[0] for eye in eyes) <= 0.8
    assert path(rooms[::8], 20) == []  # two photographs apart lead nowhere


def test_wishes(rng):
    """What a user fixes holds, the rest is the photographs'; without a common point a center must be given."""
    photos = ring(rng, 20, 200)
    made, _ = capture_orbit(
        photos, 9, **SIZE, fixed=OrbitShape(center=(0, 0, 0), distance=2.5, elevation=10, span=90, fov=70)
    )
    for camera in made:
        assert np.linalg.norm(camera.center) == pytest.approx(2.5)
        assert camera.center[2] == pytest.approx(2.5 * np.sin(np.radians(10)), abs=0.1)
        assert camera.c2w[:3, 2] @ -camera.center == pytest.approx(2.5)
    assert made[0].K[0, 0] == pytest.approx(intrinsics_from_fov(70, 40, 30)[0, 0])
    turned = azimuths(capture_orbit(photos, 9, **SIZE, fixed=OrbitShape(span=60))[0])
    assert np.all(np.abs(turned - 110) < 32)
    assert np.ptp(turned) > 50
    made, _ = capture_orbit(photos, 4, **SIZE, fixed=OrbitShape(up=(1, 0, 0)))
    assert all(-camera.c2w[0, 1] > 0.3 for camera in made)
    drive = [photo((0, i, 1), (0, i + 9, 1)) for i in range(12)]
    with pytest.raises(ValueError, match="must have center=X,Y,Z in --orbit here"):
        capture_orbit(drive, 5, **SIZE, fixed=OrbitShape(distance=2.0))
    made, _ = capture_orbit(drive, 5, **SIZE, fixed=OrbitShape(center=(0, 20, 1), distance=5.0))
    assert all(np.linalg.norm(camera.center - (0, 20, 1)) == pytest.approx(5) for camera in made)


def test_few_cameras_say_little():
    """One photograph has no point that others look at, two have."""
    assert Focus.of([]) is None
    assert capture_orbit([], 5, **SIZE) == ([], "")
    assert capture_orbit([photo(at(0, 20, 4), CENTER)], 5, **SIZE)[0] == []
    focus = Focus.of([photo(at(a, 20, 4), CENTER) for a in (0, 60)])
    np.testing.assert_allclose(focus.center, CENTER, atol=1e-6)


def test_floaters_do_not_move_the_camera_away(rng):
    """A bare PLY: one Gaussian in ten far away, large and faint or small and opaque, changes the distance little."""
    means, scales, opacities = rng.normal(size=(400, 3)), np.full((400, 3), 0.05), np.full(400, 0.8)

    def seen_from(fixed=None):
        quats = np.tile([1.0, 0, 0, 0], (400, 1))
        g = drgs.Gaussians.from_arrays(means, quats, scales, opacities, np.ones((400, 1, 3)))
        return np.array([camera.center for camera in scene_orbit(g, 6, **SIZE, fixed=fixed)])

    clean = seen_from()
    means[:20] *= 30
    means[20:40] += (40, 0, 0)
    scales[:20], opacities[:20] = 20.0, 0.06
    dirty = seen_from()
    assert np.linalg.norm(dirty[0] - dirty[3]) == pytest.approx(np.linalg.norm(clean[0] - clean[3]), rel=0.25)
    fixed = seen_from(OrbitShape(center=(1, 0, 0), distance=3.0, span=90))
    np.testing.assert_allclose(np.linalg.norm(fixed - (1, 0, 0), axis=1), 3)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"center": (0.0, np.nan, 0.0)}, "--orbit center must be three finite numbers"),
        ({"distance": 0.0}, "--orbit distance must be positive and finite, got 0.0"),
        ({"distance": np.inf}, "--orbit distance must be positive and finite, got inf"),
        ({"span": 361.0}, r"--orbit span must be in \[0, 360\] degrees, got 361.0"),
        ({"elevation": 90.0}, r"--orbit elevation must be in \[-89, 89\] degrees, got 90.0"),
        ({"fov": 0.5}, r"--orbit fov must be in \[1, 170\] degrees, got 0.5"),
    ],
)
def test_options_out_of_range(fields, message):
    """One sentence with the option's name."""
    with pytest.raises(ValueError, match=message):
        OrbitShape(**fields)
