"""Files for users: 3DGS `point_cloud.ply`, safetensors checkpoints, and run folders.

The work is done by `drgs.codecs.ply` and `drgs.io`, which writes every file whole or not at all.
"""

from __future__ import annotations

from drgs.codecs.ply import load_ply, save_ply
from drgs.io.checkpoint import load_state, save_state, state_header
from drgs.io.journal import SCHEMA
from drgs.io.outputs import atomic_write, write_json
from drgs.io.run import CONFIG_SCHEMA, Run

__all__ = [
    "CONFIG_SCHEMA",
    "SCHEMA",
    "Run",
    "atomic_write",
    "load_ply",
    "load_state",
    "save_ply",
    "save_state",
    "state_header",
    "write_json",
]
