"""A format of data sets: lines `name fx x y z tx ty tz` in views.txt, cameras at x, y, z that look at tx, ty, tz
(docs/extending.md)."""

from drgs.cameras import Camera, intrinsics, look_at
from drgs.data import Dataset, Format, View
from drgs.data.checks import file_inside, read_text
from drgs.data.images import image_size


def load_lines(path, background=(0.0, 0.0, 0.0)):
    """`views.txt` next to its images."""
    file = path / "views.txt"
    views = []
    for number, line in enumerate(read_text(file, "a list of views", 1 << 20).splitlines(), 1):
        name, *numbers = line.split()
        if len(numbers) != 7:
            raise ValueError(f"{file}: line {number} must have 7 numbers, got {len(numbers)}; correct it")
        fx, *place = map(float, numbers)
        image = file_inside(path, name, f"{file}: line {number}")
        width, height = image_size(image)
        K = intrinsics(fx, fx, width / 2, height / 2)
        pose = look_at(place[:3], place[3:], up=(0.0, -1.0, 0.0))
        camera = Camera(K, pose, width, height, name=image.stem)
        views.append(View(camera, image.stem, image, background=background))
    return Dataset(path, "lines", views)


LINES = Format(lambda path: (path / "views.txt").is_file(), load_lines, looks_for=("views.txt",))
