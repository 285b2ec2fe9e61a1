"""The PLY of 3DGS: Gaussians by named columns. Claimed sizes are compared with the file's before anything is
allocated.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.cameras.origins import origin_text
from drgs.checks.arguments import ArgumentError, check_path, said
from drgs.codecs.ply_headers import (
    EXTRA,
    extra_kind,
    is_antialiased,
    offset_line,
    ply_offset,
    ply_source,
    read_ply_header,
)
from drgs.io.foreign import refuse_foreign
from drgs.io.outputs import atomic_write

if TYPE_CHECKING:
    import torch

    from drgs.ellipsoids import Gaussians

_log = logging.getLogger(__name__)

_COLUMNS = {
    "means": ("x", "y", "z"),
    "quats": tuple(f"rot_{i}" for i in range(4)),
    "log_scales": tuple(f"scale_{i}" for i in range(3)),
    "logit_opacities": ("opacity",),
    "dc": tuple(f"f_dc_{i}" for i in range(3)),
}
_NORMALS = ("nx", "ny", "nz")
_FEATURE = "semantic_"
_HIGHER = 15  # SH coefficients a color channel above degree 0, up to degree 3


def load_ply(path: str | os.PathLike) -> Gaussians:
    """Gaussians from a 3DGS PLY; columns are found by name, in any order.

        g = drgs.load_ply("point_cloud.ply")

    Args:
        path: A file with vertex columns x y z, f_dc_0..2, f_rest_* (0, 9, 24, 45 or 72 of them, channel by channel; of
            72, SH of degree 4, those up to degree 3 are kept, with a warning), opacity (logit), scale_0..2 (log) and
            rot_0..3 (wxyz), and semantic_0, ... (features) as Feature 3DGS writes them. Normals and features may be
            missing. What `save_ply` added (uncertainty_*, label) is left out; any other column, too, with a warning.
    Positions are relative to a line `comment offset X Y Z` of the header, if there is one: it becomes their `origin`.
    Without it, `property double x` far from 0 gets an origin, too (`drgs.cameras.origins`); float32 positions far from
    0 stay as they are, with a warning, for their detail was lost when they were written.

    Returns:
        float32 `Gaussians` with the file's bits; an infinite logit becomes one of `ellipsoids.LOGIT_ENDS`, and the log
        says how many did.
    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no PLY, shorter than its header claims, of another layout, or holds other values, or an
            offset, that are not finite (the first index is named).
    """
    import plyfile
    import torch

    from drgs.codecs.values import note_lost, recentered
    from drgs.ellipsoids import Gaussians

    path = check_path("load_ply", path)
    names = _check_ply(path)
    rest, features = _rest_columns(path, names), _feature_columns(path, names)
    _check_columns(path, names, {*rest, *features})
    if is_antialiased(path):
        note_antialiased(path)
    offset = ply_offset(path)
    try:
        vertex = plyfile.PlyData.read(ply_source(path))["vertex"].data
        arrays: dict[str, Any] = {name: _columns(vertex, group) for name, group in _COLUMNS.items()}
        if any(vertex[name].dtype.itemsize == 8 for name in "xyz"):
            arrays["means"] = _columns(vertex, _COLUMNS["means"], np.float64)
        higher, described = _columns(vertex, rest), _columns(vertex, features)
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file, whatever its words make plyfile and NumPy raise
        raise ValueError(f"{path}: must be a readable PLY, got {said(error, 200)}; export it again") from None
    sh = arrays.pop("dc")[:, None, :]
    if rest:
        # f_rest is stored channel by channel; ours are coefficient by coefficient.
        higher = higher.reshape(len(vertex), 3, len(rest) // 3)[..., :_HIGHER].transpose(1, 2)
        sh = torch.cat([sh, higher], dim=1)
    if features:
        arrays["features"] = described
    arrays["logit_opacities"] = _finite_logits(path, arrays["logit_opacities"][:, 0])
    held = Gaussians(**arrays, sh=sh.contiguous())
    gaussians = recentered(held if offset is None else held.replace(origin=offset))
    gaussians.validate(str(path))
    if held.means.dtype == torch.float32:
        note_lost(path, held)
    elif offset is None and gaussians.origin.any():
        _log.info("%s: stands far from 0: positions are relative to %s now", path, origin_text(gaussians.origin))
    return gaussians


def note_antialiased(path: Path) -> None:
    """Say in the log that a file is meant for antialiased rasterization, which `Gaussians` have no room for."""
    _log.warning(
        "%s: was fitted by antialiased rasterization, which no preset is: what is below a pixel is too opaque in "
        "gsplat and inria; files that are written of it do not say what it was",
        path,
    )


def note_offset(path: Path, origin: np.ndarray, where: str = "which its header states") -> None:
    """Say in the log that positions of a file that was written are relative to an offset, and `where` that is said."""
    if origin.any():
        _log.info("%s: positions are relative to the offset %s, %s", path, origin_text(origin), where)


def _finite_logits(path: Path, logits: torch.Tensor) -> torch.Tensor:
    """Logits of which the infinite ones, of opacities 0 and 1, have become `LOGIT_ENDS`; the log says how many."""
    from drgs.ellipsoids import LOGIT_ENDS

    infinite = logits.isinf()
    if not infinite.any():
        return logits
    _log.warning(
        "%s: %d of %d opacities are 0 or 1 (infinite logits), read as logits of %.1f and %.1f",
        path,
        int(infinite.sum()),
        len(logits),
        *LOGIT_ENDS,
    )
    return logits.where(~infinite, logits.clamp(*LOGIT_ENDS))


def _columns(vertex: np.ndarray, names: tuple[str, ...], kind: type = np.float32) -> torch.Tensor:
    """(N, columns), float32 but for what has more digits."""
    import torch

    out: np.ndarray = np.empty((len(vertex), len(names)), kind)
    for i, name in enumerate(names):
        out[:, i] = vertex[name]
    return torch.from_numpy(out)


def save_ply(
    g: Gaussians,
    path: str | os.PathLike,
    *,
    extra: Mapping[str, np.ndarray] | None = None,
    comments: tuple[str, ...] = (),
) -> None:
    """Write Gaussians as INRIA's trainer does: binary little-endian float32, normals 0, the same order of columns.

        drgs.save_ply(g, "out.ply", comments=("made by hand",))

    `load_ply` gives the same bits back. Means are stored as they are, relative to `origin`: where that is not 0, the
    first comment is `offset X Y Z`, to be added to positions. Float64 means far from 0 get an origin first. Features,
    where there are any, follow as semantic_0, ..., as Feature 3DGS writes them; other viewers leave them out.

    Args:
        g: The Gaussians.
        path: The file.
        extra: More columns, which viewers and `load_ply` leave out: (N,) floats named uncertainty_*, and whole numbers
            named label*, which are written as uchar, or as ushort where one is above 255.
        comments: Lines of the header.
    Raises:
        ValueError: If a parameter or an extra number is not finite (the first index is named), or an extra column has
            another name or length.
    """
    import plyfile

    from drgs.codecs.values import recentered
    from drgs.ellipsoids import check_gaussians

    if isinstance(g, str | os.PathLike):
        raise ArgumentError("save_ply: gaussians must come first and the path second, got a path first; swap them")
    check_gaussians("save_ply", g)
    path = check_path("save_ply", path)
    g.validate("save_ply")
    g = recentered(g)
    # A file holds values.
    fields = {name: x.detach().cpu().numpy() for name, x in g.parameters().items()}
    means = fields["means"]
    rest = fields["sh"][:, 1:].transpose(0, 2, 1).reshape(len(g), 3 * (g.sh.shape[1] - 1))  # channel by channel
    columns = {
        **{name: means[:, i] for i, name in enumerate("xyz")},
        **dict.fromkeys(_NORMALS, np.float32(0)),
        **{f"f_dc_{i}": fields["sh"][:, 0, i] for i in range(3)},
        **{f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])},
        "opacity": fields["logit_opacities"],
        **{f"scale_{i}": fields["log_scales"][:, i] for i in range(3)},
        **{f"rot_{i}": fields["quats"][:, i] for i in range(4)},
        **{f"{_FEATURE}{i}": x for i, x in enumerate(fields["features"].T if "features" in fields else ())},
    }
    kinds = {name: extra_kind(name, x, len(g)) for name, x in (extra or {}).items()}
    vertex = np.empty(len(g), [*((name, "<f4") for name in columns), *kinds.items()])
    for name, values in {**columns, **(extra or {})}.items():
        vertex[name] = values
    lines = [*([offset_line(g.origin)] if g.origin.any() else []), *(" ".join(text.split()) for text in comments)]
    ply = plyfile.PlyData([plyfile.PlyElement.describe(vertex, "vertex")], byte_order="<", comments=lines)
    with atomic_write(path) as file:
        ply.write(file)


def _check_ply(path: Path) -> list[str]:
    """Columns of the vertex element, once the file is known to be as long as its header claims."""
    if path.is_file():
        refuse_foreign(path, "a 3DGS PLY file")
    elements = read_ply_header(path)
    vertex = next((element.columns for element in elements if element.name == "vertex"), None)
    if vertex is None:
        raise ValueError(f"{path}: a 3DGS PLY must have an element `vertex`, found none; export it again")
    return list(vertex)


def _check_columns(path: Path, names: list[str], optional: set[str]) -> None:
    """Refuse a file without the columns that Gaussians have; the log says which others are left out.

    Args:
        path: The file.
        names: Its columns.
        optional: Those of its higher SH and features.
    """
    needed = [name for group in _COLUMNS.values() for name in group]
    missing = [name for name in needed if name not in names]
    if missing:
        raise ValueError(
            f"{path}: a 3DGS PLY must have the vertex columns x y z f_dc_* opacity scale_* rot_*, "
            f"{', '.join(missing[:4])}{' ...' if len(missing) > 4 else ''} missing; "
            f"{_layout_hint(names)}"
        )
    known = {*needed, *optional, *_NORMALS}
    extra = [name for name in names if name not in known and not name.startswith(EXTRA)]
    if extra:
        shown = ", ".join(extra[:4]) + (" ..." if len(extra) > 4 else "")
        _log.warning("%s: left out %d columns that are not 3DGS: %s", path, len(extra), shown)


def _rest_columns(path: Path, names: list[str]) -> tuple[str, ...]:
    count = sum(name.startswith("f_rest_") for name in names)
    rest = tuple(f"f_rest_{i}" for i in range(count))
    if count not in (0, 9, 24, 45, 72) or not set(rest) <= set(names):
        raise ValueError(
            f"{path}: must have 0, 9, 24, 45 or 72 columns f_rest_0, f_rest_1, ... (SH degree 0 to 4), got {count}; "
            "export it again"
        )
    if count // 3 > _HIGHER:
        _log.warning("%s: left out the SH coefficients of degree 4, there is no such color here", path)
    return rest


def _feature_columns(path: Path, names: list[str]) -> tuple[str, ...]:
    """Columns of features, none missing; a label or the like of the same prefix is no feature."""
    held = [name for name in names if name.startswith(_FEATURE) and name.removeprefix(_FEATURE).isdecimal()]
    wanted = tuple(f"{_FEATURE}{i}" for i in range(len(held)))
    if set(held) != set(wanted):
        odd = next(name for name in wanted if name not in held)
        raise ValueError(
            f"{path}: features must be columns {_FEATURE}0, {_FEATURE}1, ... without a gap, got {len(held)} without "
            f"{odd}; export it again"
        )
    return wanted


def _layout_hint(names: list[str]) -> str:
    if {"red", "green", "blue", "opacity", "scale_0"} <= set(names):
        return "its colors are RGB: export it with `ns-export gaussian-splat --ply-color-mode sh_coeffs`"
    if {"red", "green", "blue"} & set(names):
        return "this is a plain point cloud, fit Gaussians with `drgs fit`"
    return "export it as a 3DGS point_cloud.ply"
