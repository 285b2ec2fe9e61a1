"""Checkpoints of trainers, which are PyTorch archives: gsplat's simple_trainer and nerfstudio's splatfacto.

gsplat      results/ckpts/ckpt_29999_rank0.pt: {"step", "splats": {means, scales (logarithms), quats (wxyz), opacities
            (logits), sh0 (N, 1, 3), shN (N, K - 1, 3)}}. Of a run on several cards each rank wrote its own Gaussians.
            Source: examples/simple_trainer.py.
nerfstudio  nerfstudio_models/step-000029999.ckpt: {"step", "pipeline": {"_model.gauss_params.means", ...}} with the
            same values under names features_dc (N, 3), features_rest (N, K - 1, 3), opacities (N, 1).
            Source: nerfstudio/models/splatfacto.py.

They are read with `weights_only`: nothing in the pickle is run, and one that holds more than tensors, numbers and texts
is refused. A file is mapped, so that no size that it claims is allocated.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from drgs.checks.arguments import said
from drgs.codecs.codec import Codec
from drgs.codecs.folders import is_checkpoint, nerfstudio_run
from drgs.codecs.values import SH_COUNTS, check_count
from drgs.ellipsoids import Gaussians
from drgs.io.archives import check_archive

_GSPLAT = {
    "means": "means",
    "quats": "quats",
    "log_scales": "scales",
    "logit_opacities": "opacities",
    "dc": "sh0",
    "rest": "shN",
}
_SPLATFACTO = _GSPLAT | {"dc": "features_dc", "rest": "features_rest"}
_PREFIX = "_model.gauss_params."  # of names in a pipeline of nerfstudio
_RANK = re.compile(r"(.*_rank)0(\.[a-z]+)")
_log = logging.getLogger(__name__)


def load_checkpoint(path: Path) -> Gaussians:
    """Gaussians of a checkpoint of gsplat's simple_trainer or of nerfstudio's splatfacto.

    Of `..._rank0.pt` the Gaussians of all ranks beside it are read, in their order. They are in the frame in which the
    trainer has put its world, which is rarely that of the data set.

    Raises:
        ValueError: If the file is damaged, holds no Gaussians under these names, colors of a network instead of SH, or
            values that are not finite (the first index is named).
    """
    import torch

    parts = [_part(x) for x in _ranks(path)]
    counts = {part["sh"].shape[1] for part in parts}
    if len(counts) > 1:
        raise ValueError(f"{path}: all ranks must have SH of one degree, got {sorted(counts)} coefficients; name one")
    fields: dict[str, Any] = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    made = Gaussians(**fields)
    made.validate(str(path))
    return made


def _ranks(path: Path) -> list[Path]:
    """The checkpoints of all ranks of a run on several cards; the file itself if it is of none, or another one's."""
    match = _RANK.fullmatch(path.name)
    if match is None:
        return [path]
    found = [path]
    while (other := path.with_name(f"{match[1]}{len(found)}{match[2]}")).is_file():
        found.append(other)
    if len(found) > 1:
        _log.info("%s: read with those of ranks 1 to %d beside it", path, len(found) - 1)
    return found


def _part(path: Path) -> dict[str, Any]:
    """Raw parameters in one file, by the names of `Gaussians`."""
    import torch

    check_archive(path)
    try:
        # mmap: what its storages claim to hold is not allocated, and what is not asked for is not read.
        state: Any = torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file, or of a pickle with more in it than weights
        text = said(error)
        if nerfstudio_run(path) is not None:
            _refuse_nerfstudio(path, text)
        raise ValueError(
            f"{path}: must be a checkpoint of tensors alone, got {text}; write a PLY with the program that made it"
        ) from None
    values, names = _named(path, state)
    found = {}
    for name, key in names.items():
        x = values.get(key)
        if x is None and name == "rest":
            continue  # of a fit with SH of degree 0
        if not isinstance(x, torch.Tensor) or not x.is_floating_point() or x.ndim == 0:
            got = "none" if x is None else type(x).__name__
            raise ValueError(f"{path}: must hold a tensor of floats {key!r}, got {got}; name another checkpoint")
        # Of a tensor that repeats its numbers (a stride of 0), a kilobyte would become gigabytes.
        if (claimed := x.numel() * x.element_size()) > (size := path.stat().st_size):
            raise ValueError(
                f"{path}: {key} must be what the file holds, {claimed} bytes are claimed of {size}; save it again"
            )
        found[name] = x
    dc, rest = found.pop("dc"), found.pop("rest", None)
    count = len(found["means"])
    sh = [dc.reshape(count, 1, 3)] if dc.numel() == 3 * count else []
    if rest is not None and rest.numel():
        sh.append(rest)
    if not sh or any(x.ndim != 3 or len(x) != count or x.shape[2] != 3 for x in sh):
        shapes = [tuple(x.shape) for x in (dc, rest) if x is not None]
        raise ValueError(f"{path}: SH must be of {count} Gaussians and 3 channels, got shapes {shapes}; name another")
    coefficients = sum(x.shape[1] for x in sh)
    if coefficients not in SH_COUNTS:
        raise ValueError(f"{path}: SH must have 1, 4, 9 or 16 coefficients, got {coefficients}; write a PLY instead")
    check_count(path, count, coefficients)
    found["logit_opacities"] = found["logit_opacities"].reshape(-1)
    found["sh"] = torch.cat(sh, dim=1)
    return {name: x.detach().to(torch.float32, copy=True) for name, x in found.items()}


def _named(path: Path, state: Any) -> tuple[Mapping[str, Any], dict[str, str]]:
    """The tensors of a checkpoint, and which of them is what."""
    if isinstance(state, Mapping):
        if isinstance(splats := state.get("splats"), Mapping):
            if "sh0" not in splats and "colors" in splats:
                raise ValueError(
                    f"{path}: colors must be SH, are of a network (app_opt of simple_trainer); fit without it"
                )
            return splats, _GSPLAT
        if isinstance(pipeline := state.get("pipeline"), Mapping):
            values = {k.removeprefix(_PREFIX): x for k, x in pipeline.items() if str(k).startswith(_PREFIX)}
            if values:
                return values, _SPLATFACTO
    if nerfstudio_run(path) is not None:
        _refuse_nerfstudio(path, "no Gaussians of splatfacto")
    keys = ", ".join(map(str, list(state)[:5])) if isinstance(state, Mapping) else type(state).__name__
    raise ValueError(
        f"{path}: must be a checkpoint of gsplat's simple_trainer or of splatfacto, holds {keys or 'nothing'}; write a "
        "PLY with the program that made it"
    )


def _refuse_nerfstudio(path: Path, got: str) -> NoReturn:
    run = nerfstudio_run(path)
    raise ValueError(
        f"{path}: must be a checkpoint of splatfacto that holds tensors alone, got {got}; run `ns-export "
        f"gaussian-splat --load-config {run}/config.yml --output-dir {run}/export` and name its PLY"
    )


CHECKPOINT = Codec(".pt", load_checkpoint, is_checkpoint, by_suffix=False, made_by="")
