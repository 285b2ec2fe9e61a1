"""Run folders: a fit's configuration, environment, log, checkpoint and pictures."""

from __future__ import annotations

import datetime
import os
from pathlib import Path
from typing import Any

from drgs.io.journal import SCHEMA, Journal, check_schema
from drgs.io.json_files import read_json
from drgs.io.outputs import json_form, write_json

CONFIG_SCHEMA = 2
"""Version of config.json. Of version 1, which is read too, the fields of a fit stand beside each other, those of its
selection under `active`; of version 2 they are nested by subject."""


class Run:
    """A run folder: `config.json`, `env.json`, `log.jsonl`, `metrics.json`, the checkpoint, the PLY, the
    record of its errors and `renders/`.

    Attributes:
        path: The folder; made by `start`.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)

    @property
    def state(self) -> Path:
        """The checkpoint."""
        return self.path / "state.safetensors"

    @property
    def point_cloud(self) -> Path:
        """The Gaussians, as a 3DGS PLY."""
        return self.path / "point_cloud.ply"

    @property
    def errors(self) -> Path:
        """What the photographs say about the errors of the scene (`drgs.fitting.errors`)."""
        return self.path / "errors.safetensors"

    @property
    def renders(self) -> Path:
        """Folder of pictures."""
        return self.path / "renders"

    def start(self, config: dict, resume: bool = False) -> None:
        """Record the configuration, and the environment (`env.json`).

        Args:
            config: Everything that determines the run; JSON-serializable.
            resume: Continue in a folder that holds a run.
        Raises:
            ValueError: If the folder holds a run and `resume` is False.
        """
        from drgs import runtime

        if not resume and (self.path / "config.json").exists():
            raise ValueError(
                f"{self.path}: must be a new run folder, holds a run already; add --resume or choose another"
            )
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path}: must be a folder, is a file; choose another")
        self.path.mkdir(parents=True, exist_ok=True)
        self.record(config)
        write_json(self.path / "env.json", {"schema": SCHEMA, **runtime.info()})

    def record(self, config: dict) -> None:
        """Write config.json again, when a fit has determined more of it."""
        write_json(self.path / "config.json", {"schema": SCHEMA, **config})

    def config(self) -> dict:
        """The recorded configuration.

        Raises:
            FileNotFoundError: If this is no run folder.
            ValueError: If the file is damaged or of another schema version.
        """
        path = self.path / "config.json"
        if not self.path.exists():
            raise FileNotFoundError(f"{self.path}: must be a run folder, nothing is there; check the path")
        if not path.is_file():
            raise FileNotFoundError(f"{self.path}: must be a run folder, found no config.json; run `drgs fit` first")
        config = read_json(path, "a run's config.json", "fit again in another folder")
        check_schema(path, config, (SCHEMA, CONFIG_SCHEMA), "schema", "fit again in another folder")
        return config

    @property
    def journal(self) -> Journal:
        """`log.jsonl`."""
        return Journal(self.path / "log.jsonl", json_form)

    def log(self, event: str, **fields: Any) -> None:
        """Append one event to `log.jsonl`."""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
        self.journal.append({"schema": SCHEMA, "time": now, "event": event, **fields})

    def events(self) -> list[dict]:
        """The events of `log.jsonl`.

        Raises:
            ValueError: If a line is no JSON.
        """
        return self.journal.rows()
