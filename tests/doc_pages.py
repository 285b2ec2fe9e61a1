"""Pages of the documentation as the tests read them: blocks, commands and figures, and a tiny scene to run them on."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import shutil
from pathlib import Path

__all__ = [
    "PAGES",
    "ROOT",
    "Block",
    "blocks",
    "commands",
    "elsewhere",
    "figures",
    "inline_commands",
    "lines_of",
    "make_folder",
    "smaller",
]

ROOT = Path(__file__).resolve().parent.parent
PAGES = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
)

# What makes a command of a page small. Later options win over earlier ones.
_SMALLER = {
    "fit": ["--max-steps", "6", "--max-gaussians", "200"],
    "render": ["--frames", "2", "--width", "24"],
    "select": ["--count", "6"],
    "fisher": ["--limit", "1"],
    "crossval": ["--limit", "1", "--max-pixels", "192", "--no-ladder"],
    "tradeoff": ["--limit", "1", "--max-pixels", "192", "--repeats", "1"],
    "stress": ["--match", "1 Gaussian"],
    "query": ["--limit", "1", "--threshold", "0"],  # six steps have taught nothing
    "demo": ["--quick"],
    "prune": ["--rounds", "2"],
}

# Why a command of a page is parsed and not run, and what runs it: by the command's name, or by one of its arguments.
_COMMANDS_ELSEWHERE = {
    "capture": "structure from motion needs real texture: tests/test_capture_command.py",
    "sfm": "structure from motion needs real texture: tests/test_sfm.py",
    "demo": "takes half a minute: tests/test_demo.py",
    "scene": "path tracing takes ten seconds: tests/test_room.py, tests/test_kitchen.py",
    "teach": "needs a model: tests/test_teach.py",
    "reproduce": "takes minutes: tests/test_reproduce.py, and `make smoke`",
    "share": "may fetch its viewer from npm: tests/test_share.py, tests/test_share_browser.py",
    "view": "ends by Ctrl-C alone: tests/test_view.py",
}
_ARGUMENTS_ELSEWHERE = {
    r"(.*/)?kitchen": "is of what moves: tests/test_dynamic_fit.py, and `make smoke`",
    r"\$DRGS_DATA/.*": "is of real data: `benchmarks/real.py`, and the tests marked real_data",
    r"runs/phone": "is of a capture: tests/test_capture_command.py",
    r"runs/td/.*": "is of a run of the demo: tests/test_tradeoff.py",
    r"scene\.sog": "is written by other programs: tests/test_codecs.py",
    r"examples\..*": "is an example: tests/test_examples.py",
    r"dump\.npz": "is written by another rasterizer: tests/test_crossval.py, tests/test_examples.py",
}


@dataclasses.dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes:
        line: Number of its first line of text, from 1.
        language: What stands behind the fence; empty if nothing does.
        text: Without the fences and the page's indentation.
    """

    line: int
    language: str
    text: str


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in its order; a fence that is not closed is an error."""
    found: list[Block] = []
    start, inside = None, []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        fence = re.match(r"( *)```(.*)$", line)
        if start is None and fence:
            start, inside = (number + 1, len(fence[1]), fence[2].strip()), []
        elif start is not None and fence:
            assert not fence[2].strip(), f"{page.name}:{number}: a block in a block"
            found.append(Block(start[0], start[2], "\n".join(inside) + "\n"))
            start = None
        elif start is not None:
            inside.append(line[min(start[1], len(line) - len(line.lstrip())) :])
    assert start is None, f"{page.name}:{start[0]}: the block is not closed"
    return found


def lines_of(block: Block) -> list[str]:
    """Its commands, continued lines joined, comments and empty lines left out."""
    lines = block.text.replace("\\\n", " ").splitlines()
    return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def commands(found: list[Block]) -> list[list[str]]:
    """What follows `drgs` on each line of the bash blocks that begins so."""
    lines = [line for block in found if block.language == "bash" for line in lines_of(block)]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("drgs ")]


def inline_commands(page: Path) -> list[str]:
    """`drgs ...`, `python ...` and `make ...` in the running text of a page, line breaks as spaces."""
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    found = re.findall(r"`((?:drgs|python|make) [^`]+)`", text)
    return [" ".join(command.split()) for command in found]


def elsewhere(command: list[str]) -> str | None:
    """Why a command of a page is parsed only, and what runs it; None: it is run."""
    if why := _COMMANDS_ELSEWHERE.get(command[0]):
        return why
    return next(
        (why for name, why in _ARGUMENTS_ELSEWHERE.items() if any(re.fullmatch(name, word) for word in command)), None
    )


def smaller(command: list[str]) -> list[str]:
    """The same command on little."""
    if "--duration" in command:  # which says the same as the --frames of few
        at = command.index("--duration")
        command = command[:at] + command[at + 2 :]
    if "--panorama" in command:
        return [*command, "--frames", "2", "--width", "24", "--height", "12"]
    few = ["--add", "2", "--every", "2"] if "active" in command else []
    few += ["--refit", "2"] if "--refit" in command else []
    return [*command, *_SMALLER.get(command[0], []), *few]


def figures(page: Path) -> list[tuple[str, str]]:
    """Path of each picture of a page, and the paragraphs before and behind it (and behind other pictures there)."""
    paragraphs = re.split(r"\n\s*\n", page.read_text(encoding="utf-8"))
    picture = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
    found = []
    for i, paragraph in enumerate(paragraphs):
        for path in picture.findall(paragraph):
            before = next((p for p in reversed(paragraphs[:i]) if not picture.search(p)), "")
            behind = next((p for p in paragraphs[i + 1 :] if not picture.search(p)), "")
            found.append((path, "\n\n".join((before, paragraph, behind))))
    return found


def make_folder(folder: Path) -> Path:
    """Fill a folder with what pages speak of.

    `scene`, nine posed pictures of a few Gaussians; `data/room`, the same with a teacher's maps; `point_cloud.ply`
    and `scene.ply`, the Gaussians; `cameras.json`, poses alone; `flight.json`, a flight through three of them;
    `phone.mp4`, seconds of video, and `photos`, an empty folder; `my_package/rasterizer.py` and `plain_rasterizer.py`,
    rasterizers in plain torch.
    """
    import cv2
    import numpy as np
    import torch

    import drgs
    from drgs.cameras import c2w_to_opengl, orbit
    from drgs.data.camera_lists import save_cameras_json
    from drgs.files import save_ply

    rng = np.random.default_rng(3)
    n = 40
    g = drgs.Gaussians.from_arrays(
        (rng.normal(size=(n, 3)) * 0.5).astype(np.float32),
        rng.normal(size=(n, 4)),
        rng.uniform(0.05, 0.2, (n, 3)),
        rng.uniform(0.5, 0.95, n),
        rng.normal(size=(n, 4, 3)) * 0.5,
    )
    save_ply(g, folder / "point_cloud.ply")
    shutil.copy(folder / "point_cloud.ply", folder / "scene.ply")
    (folder / "scene").mkdir()
    frames = []
    cameras = orbit((0, 0, 0), 3.0, 9, width=32, height=24, up=(0, -1, 0))
    for i, camera in enumerate(cameras):
        out = drgs.render(g, camera)
        image = (out.rgb.numpy().clip(0, 1) * 255).round().astype(np.uint8)
        z = out.median_depth if out.median_depth is not None else out.depth
        cv2.imwrite(str(folder / f"scene/{i}.png"), image[..., ::-1])
        cv2.imwrite(str(folder / f"scene/{i}.depth.png"), (z.numpy() * 1000).round().astype(np.uint16))
        frames.append(
            {
                "file_path": f"{i}.png",
                "depth_file_path": f"{i}.depth.png",
                "transform_matrix": c2w_to_opengl(camera.c2w).tolist(),
            }
        )
    K = camera.K
    lens = {"w": 32, "h": 24, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    transforms = {"camera_model": "OPENCV", **lens, "depth_unit_scale_factor": 1e-3, "frames": frames}
    (folder / "scene/transforms.json").write_text(json.dumps(transforms))
    save_cameras_json(folder / "cameras.json", cameras[:6])
    keys = [{"w2c": camera.w2c.tolist(), "fov": 50, "seconds": k} for k, camera in enumerate(cameras[:3])]
    (folder / "flight.json").write_text(json.dumps({"keyframes": keys}))
    room = folder / "data/room"  # in place of the made one: the same views, with maps of chairs left and walls right
    shutil.copytree(folder / "scene", room)
    (room / "rgb_feature_langseg").mkdir()
    maps = torch.zeros(2, 6, 8, dtype=torch.half)
    maps[0, :, :4] = maps[1, :, 4:] = 1
    for i in range(9):
        torch.save(maps, room / f"rgb_feature_langseg/{i}_fmap_CxHxW.pt")
    np.save(room / "text_embeddings.npy", np.eye(2, dtype=np.float32))
    (room / "classes.txt").write_text("chair\nwall\n")
    (folder / "photos").mkdir()
    video = cv2.VideoWriter(str(folder / "phone.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for i in range(24):
        frame = cv2.imread(str(folder / f"scene/{i % 9}.png"))
        video.write(cv2.resize(frame, (64, 48)))
    video.release()
    shutil.copy(ROOT / "examples/plain_rasterizer.py", folder)
    (folder / "my_package").mkdir()
    shutil.copy(ROOT / "tests/torch_model.py", folder / "my_package/rasterizer.py")
    return folder
