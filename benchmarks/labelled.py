"""Data sets with a teacher from photographs that people labelled: statue and street.

    python benchmarks/labelled.py statue|street -o FOLDER [--offset 0] [--seed 0] [--teacher-size WxH] [--mask-moving]

The captures are in $DRGS_DATA (../shared/data). FOLDER gets, for `drgs.data.load`:

- transforms.json: cameras, points where the capture has some, and the split: every third photograph by name, from
  `--offset` on, is for testing;
- images/ (copies), semantic_class/ (0 none, k class k of classes.json), of all photographs;
- rgb_feature_langseg/: a teacher's maps of the training photographs alone, made from their labels with the errors of
  `drgs.scenes.teacher`; nothing is known about space, so that none of its errors are tied to places. Text embeddings;
- labelled.json: what was counted; and with `--mask-moving`, masks/ without the classes that move by themselves, for
  `drgs fit --mask valid`: neither colors nor features of theirs are fitted then.

Statue: statue and background. Street: CamVid's 11 classes, unlabelled pixels have none; its photographs are distorted,
and so are labels and maps. Copies of photographs stay where they are made: no file of these folders is to be committed.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402

from drgs.cameras import c2w_to_opengl  # noqa: E402
from drgs.data import Dataset, View, load  # noqa: E402
from drgs.data.semantics import plain_labels  # noqa: E402
from drgs.display.progress import Bar  # noqa: E402
from drgs.features.segmentation import scores  # noqa: E402
from drgs.scenes import output, teacher  # noqa: E402

__all__ = ["CAPTURES", "Capture", "generate"]

DATA = Path(os.environ.get("DRGS_DATA", ROOT.parent / "shared" / "data"))
HOLD_OUT = 3
_VERSION = 1  # bump when a file changes: finished folders of another version are made again
_WHERE = "labelled"


@dataclasses.dataclass(frozen=True)
class Capture:
    """A capture with labels, and how its teacher errs.

    Attributes:
        folder: Folder that is loaded, below the data.
        classes: Names by label; None: as the capture names them.
        shift: Number that is added to a pixel of its label images; None: they are read by the capture's own names.
        confusions: What its teacher takes for what.
        moving: Classes that move by themselves.
    """

    folder: str
    classes: tuple[str, ...] | None
    shift: int | None
    confusions: teacher.Confusions
    moving: tuple[str, ...] = ()


CAPTURES = {
    "statue": Capture(
        "statue",
        ("background", "statue"),
        1,
        teacher.Confusions({"background": "statue", "statue": "background"}),
    ),
    "street": Capture(
        "street/sparse_dev/0",
        None,
        None,
        teacher.Confusions(
            {
                "Sky": "Building", "Building": "Tree", "Pole": "SignSymbol", "Road": "Pavement", "Pavement": "Road",
                "Tree": "Building", "SignSymbol": "Pole", "Fence": "Building", "Car": "Road",
                "Pedestrian": "Bicyclist", "Bicyclist": "Pedestrian",
            },
            (("Building", "Fence"), ("Road", "Pavement"), ("Pole", "SignSymbol"), ("Pedestrian", "Bicyclist")),
        ),
        ("Car", "Pedestrian", "Bicyclist"),
    ),
}  # fmt: skip


def generate(
    name: str,
    out_dir: str | os.PathLike,
    offset: int = 0,
    seed: int = 0,
    teacher_size: tuple[int, int] | None = None,
    mask_moving: bool = False,
    data: Path = DATA,
) -> Path:
    """Make a data set, unless `out_dir` already holds it; an interrupted call is continued.

    Args:
        name: Name of the capture in `CAPTURES`.
        out_dir: Folder to make; what was made otherwise is refused.
        offset: Index of the first test photograph, 0 to 2.
        seed: Seed of the teacher's errors.
        teacher_size: (w, h) of its maps; a quarter of the photographs if left out.
        mask_moving: Whether the classes that move by themselves are masked.
        data: Folder of the captures.
    Returns:
        `out_dir` as a Path.
    Raises:
        FileNotFoundError: If the capture is not there.
        ValueError: If a number is out of range, or `out_dir` holds something else.
    """
    capture = CAPTURES[name]
    if not 0 <= offset < HOLD_OUT:
        raise ValueError(f"labelled: offset must be 0 to {HOLD_OUT - 1}, got {offset}; choose one of them")
    if mask_moving and not capture.moving:
        raise ValueError(f"labelled: {name} has no class that moves by itself; leave --mask-moving out")
    source = load(data / capture.folder)
    width, height = source.views[0].camera.width, source.views[0].camera.height
    w, h = teacher_size or (round(width / 4), round(height / 4))
    output.check_numbers({"seed": seed, "teacher_width": w, "teacher_height": h}, _WHERE)
    parameters = {"capture": name, "version": _VERSION, "hold_out": HOLD_OUT, "offset": offset, "seed": seed}
    parameters |= {"teacher_size": [min(w, width), min(h, height)], "mask_moving": mask_moving}
    return output.publish(Path(out_dir), parameters, lambda folder: _fill(folder, source, capture, parameters), _WHERE)


def _fill(folder: Path, source: Dataset, capture: Capture, parameters: dict) -> None:
    """Write everything into an empty or half-filled folder."""
    names = capture.classes or source.semantics.classes.names
    moving = [names.index(name) + 1 for name in capture.moving]
    for part in ("images", "semantic_class", "rgb_feature_langseg"):
        (folder / part).mkdir(exist_ok=True)
    vectors = teacher.embeddings(names, parameters["seed"], capture.confusions)
    views = sorted(source.views, key=lambda view: view.name)
    frames = []
    tested = []
    found = []
    counts = np.zeros(len(names) + 1, np.int64)
    with Bar("labels to features", len(views)) as bar:
        for k, view in enumerate(views):
            labels = _labels(view, source, capture)
            counts += np.bincount(labels.ravel(), minlength=len(counts))
            stem = Path(view.name).name
            image = Path(view.image_path)
            shutil.copyfile(image, folder / "images" / image.name)
            output.write_png(folder / "semantic_class" / f"{stem}.png", labels.astype(np.uint8))
            frame = {"file_path": f"images/{image.name}", **_camera(view)}
            if parameters["mask_moving"]:
                (folder / "masks").mkdir(exist_ok=True)
                output.write_png(
                    folder / "masks" / f"{stem}.png", np.where(np.isin(labels, moving), 0, 255).astype(np.uint8)
                )
                frame["mask_path"] = f"masks/{stem}.png"
            frames.append(frame)
            path = folder / "rgb_feature_langseg" / f"{stem}_fmap_CxHxW.pt"
            if k % HOLD_OUT == parameters["offset"]:
                tested.append(frame["file_path"])
            else:
                if not path.exists():
                    feature = teacher.feature_map(
                        labels, None, names, parameters["teacher_size"], parameters["seed"], k, capture.confusions
                    )
                    output.write_file(path, teacher.tensor_bytes(feature))
                feature = teacher.load(path)
                found.append((teacher.read_labels(feature, vectors, labels.shape[::-1]), labels))
            bar.advance()
        right = scores(found, len(names))
    trained = [frame["file_path"] for frame in frames if frame["file_path"] not in tested]
    content = {"train_filenames": trained, "test_filenames": tested}
    if source.points is not None:
        _write_points(folder / "points.ply", source)
        content["ply_file_path"] = "points.ply"
    _write_json(folder / "transforms.json", {**content, "frames": frames})
    rows = [{"id": k, "name": name} for k, name in enumerate(names, 1)]
    _write_json(folder / "classes.json", {"unlabelled": 0, "classes": rows})
    np.save(folder / "text_embeddings.npy", vectors)
    counted = {
        "views": len(views), "test_views": len(tested),
        "points": 0 if source.points is None else len(source.points),
        "teacher": right,  # on the training photographs, whole ones, lens and all
        "unlabelled": float(counts[0] / counts.sum()),
        "pixels": {name: float(n / counts[1:].sum()) for name, n in zip(names, counts[1:], strict=True)},
        "moving": float(counts[moving].sum() / counts[1:].sum()),
    }  # fmt: skip
    _write_json(folder / "labelled.json", counted)


def _labels(view: View, source: Dataset, capture: Capture) -> np.ndarray:
    """(H, W) labels of a photograph as it is, lens and all: 0 none, k class k."""
    raw = plain_labels(view.label_path)
    if capture.shift is not None:
        return raw.astype(np.int64) + capture.shift
    return source.semantics.numbered(raw, view.label_path)


def _camera(view: View) -> dict:
    """The keys of a frame in transforms.json."""
    camera = view.camera
    keys = {"fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
    keys |= {"w": camera.width, "h": camera.height}
    if camera.is_distorted:
        if camera.model != "opencv":
            raise ValueError(f"labelled: view {view.name!r} must have an opencv lens or none, got {camera.model}")
        keys |= dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False))
    return {"transform_matrix": c2w_to_opengl(camera.c2w).tolist(), **{k: float(v) for k, v in keys.items()}}


def _write_points(path: Path, source: Dataset) -> None:
    """The capture's points as a PLY point cloud."""
    import io

    import plyfile

    kinds = [(axis, "f8") for axis in "xyz"] + [(channel, "u1") for channel in ("red", "green", "blue")]
    rows = np.empty(len(source.points), kinds)
    for k, axis in enumerate("xyz"):
        rows[axis] = source.points[:, k]
    for k, channel in enumerate(("red", "green", "blue")):
        rows[channel] = np.rint(source.colors[:, k] * 255)
    file = io.BytesIO()
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(file)
    output.write_file(path, file.getvalue())


def _write_json(path: Path, value: dict) -> None:
    output.write_file(path, (json.dumps(value, indent=1) + "\n").encode())


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=CAPTURES)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--offset", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--teacher-size", help="WIDTHxHEIGHT of the maps; default a quarter of the photographs")
    parser.add_argument("--mask-moving", action="store_true")
    args = parser.parse_args()
    size = None if args.teacher_size is None else tuple(int(n) for n in args.teacher_size.split("x"))
    with Bar("making the data set", show=True):
        folder = generate(args.name, args.output, args.offset, args.seed, size, args.mask_moving)
    counted = json.loads((folder / "labelled.json").read_text())
    right = counted["teacher"]
    moving = 100 * counted["moving"]
    print(f"{counted['views']} photographs, {counted['test_views']} of them for testing, {counted['points']} points")
    print(f"teacher: {100 * right['pixel_accuracy']:.1f} % of the labelled pixels, mean IoU {right['miou']:.3f}")
    print(f"{moving:.1f} % of the labelled pixels are of classes that move")
    print(f"next: drgs fit {folder} -o RUN" + (" --mask valid" if args.mask_moving else ""))


if __name__ == "__main__":
    main()
