"""Runs the cases on LLVM, then on the card that is none, in one process; for kernels.py, which sets the environment.

python benchmarks/cuda/drive.py OUT.json [CASE ...]
"""

from __future__ import annotations

import json
import os
import sys
import traceback
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "benchmarks" / "cuda")]

import card  # noqa: E402
import cases  # noqa: E402
import mitsuba as mi  # noqa: E402
import torch  # noqa: E402
from cases import CASES, FRAMES, OPTIX  # noqa: E402

from drgs import runtime  # noqa: E402
from drgs.tracing import rows as rows_of_hits  # noqa: E402
from drgs.tracing import sort_keys, tiles  # noqa: E402

FOLDER = Path(os.environ["CARD_MODULES"])
_LARGE = 8 << 20  # numbers: above the pixels of an image of 1920x1080, below those of a band's rows


def on(variant: str) -> None:
    """Compute with a backend."""
    mi.set_variant(variant)
    runtime.setup(variant)


def driven(case: object, large: bool = False) -> dict:
    """What a case has asked of the card; of a failure its last line.

    Args:
        large: It has rows of hits that would fill this machine's memory: they are not kept, and not sorted twice.
    """
    found: dict = {}
    sort = rows_of_hits._sort_at_once
    try:
        answers = card.Answers(_LARGE if large else None)
        on("llvm_ad_rgb")
        cases.home = torch.device("cpu")
        torch.manual_seed(0)
        with answers.written():
            case()  # type: ignore[operator]
        on("cuda_ad_rgb")
        if large:
            rows_of_hits._sort_at_once = lambda *_: None
        there = set(FOLDER.iterdir())
        # The Gaussians of a caller may be on either side, which changes no kernel.
        for home in ("cpu", "cuda") if os.environ.get("CARD_BOTH") else ("cpu",):
            torch.manual_seed(0)
            before = card.counts()
            with card.Device() as device, answers.given():
                cases.home = torch.device(home)
                case()  # type: ignore[operator]
        found["modules"] = sorted(x.name for x in set(FOLDER.iterdir()) - there)
        after = card.counts()
        found |= {name: after[name] - before[name] for name in ("launches", "synchronizations", "copies")}
        found["peak_bytes"] = after["peak_bytes"]
        found |= {"read_backs": len(answers.kept), "torch_waits": device.waits}
    except Exception as error:
        if os.environ.get("CARD_VERBOSE"):
            traceback.print_exc()
        chain: BaseException | None = error
        while chain is not None and (chain.__cause__ or chain.__context__) is not None:
            chain = chain.__cause__ or chain.__context__
        found["error"] = f"{type(chain).__name__}: {chain}".splitlines()[0]
    finally:
        rows_of_hits._sort_at_once = sort
    return found


def main() -> None:
    """Write what each case has done."""
    out, *names = sys.argv[1:]
    warnings.simplefilter("ignore")
    # On LLVM, too, as on a card.
    sort_keys._by_torch = lambda: True
    tiles._room = lambda size: tiles._MAX_GPU_BANDS * size
    known = {**CASES, **FRAMES, **(OPTIX if os.environ.get("DRJIT_LIBOPTIX_PATH") else {})}
    rows = {}
    for name, case in known.items():
        if (names and name not in names) or (not names and name in FRAMES):
            continue
        rows[name] = driven(case, name in FRAMES)
        print(name, {k: v for k, v in rows[name].items() if k != "modules"}, flush=True)
        Path(out).write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
