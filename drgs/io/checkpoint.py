"""Checkpoints: tensors and a JSON header in one safetensors file, written whole or not at all; no pickle."""

from __future__ import annotations

import contextlib
import json
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.io.foreign import refuse_foreign
from drgs.io.journal import SCHEMA, check_schema
from drgs.io.json_files import parse_json
from drgs.io.outputs import json_form, write_whole

if TYPE_CHECKING:
    import torch


def save_state(path: str | os.PathLike, tensors: dict[str, torch.Tensor], header: dict) -> None:
    """Write a checkpoint: tensors, and a JSON header to which the schema version is added."""
    from safetensors.torch import save

    metadata = {"drgs": json.dumps({"schema": SCHEMA, **header}, default=json_form)}
    # A file holds values, in the order of their shapes.
    data = save({name: x.detach().cpu().contiguous() for name, x in tensors.items()}, metadata)
    write_whole(path, data)


def load_state(path: str | os.PathLike) -> tuple[dict[str, torch.Tensor], dict]:
    """The tensors and header of `save_state`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no checkpoint, damaged, or of another schema version.
    """
    with _opened_state(Path(path)) as (file, header):
        # Copies: these are views of the file, which ends the process where another program cuts it short meanwhile.
        return {name: file.get_tensor(name).clone() for name in file.keys()}, header  # noqa: SIM118 (no dict)


def state_header(path: str | os.PathLike) -> dict:
    """The header of `save_state` alone, without its tensors; raises as `load_state`."""
    with _opened_state(Path(path)) as (_, header):
        return header


@contextlib.contextmanager
def _opened_state(path: Path) -> Iterator[tuple[Any, dict]]:
    """A checkpoint that is open, and its header; what is wrong with either is one ValueError."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a checkpoint, found none; check the path")
    refuse_foreign(path, "a checkpoint")
    try:
        with safe_open(str(path), "pt") as file:
            header = parse_json((file.metadata() or {}).get("drgs", "{}"), str(path))
            check_schema(path, header, (SCHEMA,), "checkpoint schema", "fit into another run folder (-o)")
            yield file, header
    except (SafetensorError, struct.error) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{path}: must be a checkpoint, got {text}; copy it again") from None
