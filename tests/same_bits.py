"""What the commands make of a small scene, as hashes and a few numbers: for test_same_bits.py, in a process of its own.

    python tests/same_bits.py FOLDER [--write]     prints JSON; --write makes same_bits.json of it anew

A reshaping of the code that is to change nothing leaves every hash as it is. Where results are meant to change, the
file is made anew, and the commit says what changed and why. It has a record for each make of machine, told apart by
`control`: --write replaces that of this machine. The others lose their hashes of what has changed here, and keep its
numbers, unless they changed, too: then the record goes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Sums in float32 depend in their last bits on the width of vectors: these are what most machines of today have.
ENVIRONMENT = {
    "DRGS_LLVM_TARGET": "haswell/8",
    "DRGS_VARIANT": "llvm_ad_rgb",
    "DRGS_THREADS": "1",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "OPENBLAS_CORETYPE": "Haswell",
    "OMP_NUM_THREADS": "1",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR",
}
RECORD = Path(__file__).with_name("same_bits.json")
WIDTH, HEIGHT, VIEWS, CHANNELS = 32, 24, 9, 5
EVERYTHING = ["--exposure", "learned", "--poses", "refined", "--skybox", "on", "--transients", "mask"]
EVERYTHING += ["--filter-3d", "on", "--num-downscales", "1", "--save-every", "50"]
_CLOCK = ("seconds", "minutes", "date", "when", "version", "machine", "commit", "command", "path", "file", "memory")


def main() -> None:
    """Make everything in a folder; print or write what it is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    found = made(args.folder)
    if args.write:
        records = json.loads(RECORD.read_text())
        before = next((x for x in records if x["control"] == found["control"]), found)
        changed = [name for name in found if found[name] != before.get(name)]
        others = [x for x in records if x["control"] != found["control"]]
        if any(name not in before or found[name]["numbers"] != before[name]["numbers"] for name in changed):
            others = []
        for record in others:
            for name in changed:
                record[name]["hash"] = None
        RECORD.write_text("[\n" + ",\n".join(map(lines, [*others, found])) + "\n]\n")
    print(lines(found))


def lines(record: dict) -> str:
    """A record as JSON, a result a line."""
    return "{\n" + ",\n".join(f"{json.dumps(name)}: {json.dumps(record[name])}" for name in record) + "\n}"


def made(folder: Path) -> dict:
    """Name of a result -> its hash and numbers; `control` is of what drgs has no part in."""
    from drgs import cli
    from drgs.cameras import orbit
    from drgs.data.camera_lists import save_cameras_json

    os.chdir(folder)
    write_photographs(Path("still"))
    write_photographs(Path("moving"), times=3)
    save_cameras_json(Path("around.json"), orbit((0, 0, 0), 3.0, 4, width=WIDTH, height=HEIGHT, elevation=35.0))
    quick = ["--deterministic", "--max-steps", "24", "--max-gaussians", "80", "--test-every", "4", "--quiet"]
    quick += ["--no-report", "--sh-degree", "1"]

    def run(*arguments: str, code: int = 0) -> None:
        if (ended := cli.main([*arguments])) != code:
            raise SystemExit(f"{' '.join(arguments)}: {ended}")

    run("fit", "still", "-o", "run", *quick, "--feature-width", "4", "--for", "fast")
    run("fit", "moving", "-o", "moved", *quick, "--static-share", "0.4", "--for", "fast")
    active = ["--views", "active", "--initial", "3", "--add", "2", "--every", "6"]
    run("fit", "still", "-o", "picked", *quick, *active, "--preset", "exact", "--feature-width", "4")
    # All that a fit can have besides photographs and Gaussians, 200 steps long, in one go and in two.
    every = [*EVERYTHING, *quick]
    every[every.index("--max-steps") + 1] = "200"
    run("fit", "still", "-o", "everything", *every)
    stop_at(130, run, "fit", "still", "-o", "stopped", *every)
    run("fit", "still", "-o", "stopped", *every, "--resume")
    run("fit", "still", "-o", "joined", *quick, *active, "--exposure", "learned", "--poses", "refined", "--for", "fast")
    stop_at(15, run, "fit", "moving", "-o", "moved again", *quick, "--static-share", "0.4", "--for", "fast")
    run("fit", "moving", "-o", "moved again", *quick, "--static-share", "0.4", "--for", "fast", "--resume")
    ask = ["run", "--candidates", "around.json", "-k", "2", "--quiet"]
    run("select", *ask, "-o", "default.json")
    run("select", *ask, "--criterion", "eig", "--blocks", "geometry,backdrop", "-o", "eig.json")
    run("select", *ask, "--policy", "fisherrf", "-o", "fisherrf.json")
    run("select", "moved", "--candidates", "around.json", "--time", "0.5", "--quiet", "-o", "moved.json")
    run("fisher", "run", "--limit", "1", "--pose", "--quiet", "-o", "fisher")
    run("crossval", "run", "--rasterizer", "drgs:gsplat", "--limit", "1", "--quiet", "-o", "crossval")
    sys.path.insert(0, str(Path(__file__).parent))
    broken = "same_bits:broken_rasterizer"
    run("crossval", "run", "--rasterizer", broken, "--limit", "1", "--quiet", "-o", "broken", code=1)
    run(
        "render",
        "run",
        "--cameras",
        "around.json",
        "--preset",
        "exact",
        "--format",
        "png,exr",
        "--quiet",
        "-o",
        "drawn",
    )
    found = {"control": control()}
    for name in ("run", "moved", "picked", "everything", "stopped", "joined", "moved again"):
        found[f"{name}: Gaussians"] = of_arrays(safetensors(Path(name) / "state.safetensors"))
        found[f"{name}: metrics"] = of_json(Path(name) / "metrics.json")
    for name in ("default", "eig", "fisherrf", "moved"):
        found[f"{name}: picks"] = of_json(Path(f"{name}.json"))
    found["fisher"] = of_arrays(safetensors(Path("fisher/information.safetensors")))
    found["fisher.json"] = of_json(Path("fisher/fisher.json"))
    found["crossval"] = of_json(Path("crossval/crossval.json"))
    found["broken"] = of_json(Path("broken/crossval.json"))
    found["gradients"] = gradients(Path("run/point_cloud.ply"), Path("around.json"))
    found["render"] = of_arrays({path.name: picture(path) for path in sorted(Path("drawn").glob("*.*[gr]"))})
    return found


def stop_at(step: int, run: Callable[..., None], *arguments: str) -> None:
    """Run a fit that is interrupted before a step."""
    from drgs.train import Trainer

    whole = Trainer.step

    def until(self: Trainer) -> Any:
        if self.step_index == step:
            raise KeyboardInterrupt
        return whole(self)

    Trainer.step = until
    try:
        run(*arguments, code=130)
    finally:
        Trainer.step = whole


def broken_rasterizer(means: Any, quats: Any, scales: Any, *rest: Any, **options: Any) -> Any:
    """gsplat's `rasterization` as drgs has it, whose gradient of the quaternions has the wrong sign."""
    from drgs.rasterize import rasterization

    return rasterization(means, 2 * quats.detach() - quats, scales, *rest, **options)


def gradients(scene: Path, around: Path) -> dict:
    """Of each parameter and of the camera's pose, in three presets and two traversals."""
    import torch

    from drgs.data.camera_lists import load_cameras_json
    from drgs.ellipsoids import Gaussians
    from drgs.files import load_ply
    from drgs.integrator import render
    from drgs.settings import RenderSettings

    camera = load_cameras_json(around)[0]
    arrays = {}
    for preset, change in (("exact", {}), ("exact", {"traversal": "bvh"}), ("fast", {}), ("mitsuba", {})):
        parameters = {name: x.requires_grad_() for name, x in load_ply(scene).parameters().items()}
        out = render(Gaussians(**parameters), camera, RenderSettings.preset(preset, **change))
        ((out.rgb * torch.linspace(-1, 1, out.rgb.numel()).reshape(out.rgb.shape)).sum() + out.alpha.sum()).backward()
        arrays |= {f"{preset}{change}{name}": x.grad.numpy() for name, x in parameters.items()}
    return of_arrays(arrays)


def write_photographs(folder: Path, times: int = 1) -> None:
    """A transforms.json data set of disks on a noise-free background, with maps of a teacher where it stands still.

    Drawn with NumPy in float64 and rounded to 8 bits, so that every machine has the same files.
    """
    import cv2
    import numpy as np
    import torch

    from drgs.cameras import orbit

    rng = np.random.default_rng(7)
    places, colors, radii = rng.normal(0, 0.5, (12, 3)), rng.uniform(0.2, 1, (12, 3)), rng.uniform(0.1, 0.3, 12)
    folder.mkdir()
    (folder / "images").mkdir()
    if times == 1:
        (folder / "rgb_feature_langseg").mkdir()
    frames = []
    for k, camera in enumerate(orbit((0, 0, 0), 3.0, VIEWS, width=WIDTH, height=HEIGHT)):
        time = (k % times) / max(times - 1, 1)
        moved = places + [0.3 * time, 0, 0]
        at = moved @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
        v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        image, labels = np.full((HEIGHT, WIDTH, 3), 0.1), np.zeros((HEIGHT, WIDTH), int)
        for i in np.argsort(-at[:, 2]):
            x, y = camera.K[0, 0] * at[i, 0] / at[i, 2], camera.K[1, 1] * at[i, 1] / at[i, 2]
            inside = np.hypot(u - camera.K[0, 2] - x, v - camera.K[1, 2] - y) < camera.K[0, 0] * radii[i] / at[i, 2]
            image[inside], labels[inside] = colors[i], 1 + i % (CHANNELS - 1)
        cv2.imwrite(str(folder / f"images/{k}.png"), (image[..., ::-1] * 255).round().astype(np.uint8))
        if times == 1:
            maps = np.eye(CHANNELS, dtype=np.float32)[labels[::2, ::2]].transpose(2, 0, 1)
            torch.save(torch.from_numpy(maps), folder / f"rgb_feature_langseg/{k}_fmap_CxHxW.pt")
        c2w = np.linalg.inv(camera.w2c) @ np.diag([1.0, -1, -1, 1])  # transforms.json has OpenGL's axes
        frame = {"file_path": f"images/{k}.png", "transform_matrix": c2w.round(12).tolist()}
        frames.append({**frame, "time": time} if times > 1 else frame)
    K = camera.K
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def control() -> str:
    """A hash of what the libraries compute alone: where it differs, so do last bits of everything, rightly."""
    import drjit as dr
    import numpy as np
    import torch
    from drjit.llvm import Float

    x = np.random.default_rng(0).normal(size=(64, 64))
    t = torch.from_numpy(x).float()
    image = torch.nn.functional.conv2d(t[None, None], t[None, None, :11, :11])
    own = dr.exp(dr.sin(Float(t.numpy().ravel()) * 3)).numpy()
    values = [t @ t, image, t.exp().sum(0), torch.from_numpy(np.linalg.svd(x)[1]), torch.from_numpy(x @ x)]
    digest = hashlib.sha256(own.tobytes())
    for value in values:
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def safetensors(path: Path) -> dict[str, Any]:
    """The arrays of a file."""
    from safetensors.numpy import load_file

    return load_file(path)


def picture(path: Path) -> Any:
    """A PNG or EXR."""
    import cv2
    import mitsuba as mi
    import numpy as np

    from drgs import runtime

    if path.suffix == ".exr":
        runtime.setup(threads=2)  # Mitsuba reads OpenEXR in a task, and waits for it on the thread that it needs
        return np.array(mi.Bitmap(str(path)))
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def of_arrays(arrays: dict[str, Any]) -> dict:
    """One hash of all arrays, and mean and standard deviation of each."""
    import numpy as np

    digest, numbers = hashlib.sha256(), []
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}{value.dtype}{value.shape}".encode() + value.tobytes())
        if value.dtype.kind == "f" and value.size:
            numbers += [float(value.astype(np.float64).mean()), float(value.astype(np.float64).std())]
    return {"hash": digest.hexdigest()[:16], "numbers": [float(f"{x:.5g}") for x in numbers]}


def of_json(path: Path) -> dict:
    """A hash of a file without what the clock and the machine say, and its numbers."""
    numbers: list[float] = []

    def kept(value: Any) -> Any:
        if isinstance(value, dict):
            told = {k: x for k, x in sorted(value.items()) if k != "env" and not any(word in k for word in _CLOCK)}
            return {k: kept(x) for k, x in told.items()}
        if isinstance(value, list):
            return [kept(x) for x in value]
        if isinstance(value, float) and abs(value) < 1e30:
            numbers.append(float(f"{value:.5g}"))
        return value

    text = json.dumps(kept(json.loads(path.read_text())))
    return {"hash": hashlib.sha256(text.encode()).hexdigest()[:16], "numbers": numbers[:60]}


if __name__ == "__main__":
    os.environ.update(ENVIRONMENT)
    sys.path.insert(0, str(Path(__file__).parents[1]))
    main()
