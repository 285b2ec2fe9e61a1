"""Launches, waits and memory of frames with their gradient, counted without a card.

    python benchmarks/cuda/frames.py [--folder FOLDER]

Each frame of several sizes of `cases.FRAMES` is driven in a process of its own, whose memory is counted by the driver
without a card (libcuda.c). With --folder what was driven before is not driven again.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(HERE)]

import kernels  # noqa: E402


def memory(frames: dict[str, dict]) -> list[str]:
    """Launches, waits and Dr.Jit's peak of memory of the steps of several sizes, a line each."""
    made = []
    for name, found in frames.items():
        waits = found["synchronizations"] + found["torch_waits"]
        made.append(f"{name}: {found['launches']} launches, {waits} waits, {found['peak_bytes'] / 1e9:.2f} GB")
    return made


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path, help="what was driven before, and will be")
    args = parser.parse_args()
    if lacks := kernels.missing():
        print(f"frames.py: {lacks}", file=sys.stderr)
        return 2
    from cases import FRAMES
    from where import ran

    frames = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.folder or Path(temporary)
        for name in FRAMES:
            own = folder / re.sub("[ ,]", "_", name)
            told = own / "cases.json"
            frames |= json.loads(told.read_text()) if told.exists() else kernels.driven(own, [name], optix=False)
    print("\n".join(memory(frames)))
    told = {name: {k: v for k, v in found.items() if k != "modules"} for name, found in frames.items()}
    data = {"ran": ran(), "frames": told}
    (HERE / "frames.json").write_text(json.dumps(data, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
