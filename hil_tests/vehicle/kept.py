"""The points of a sweep that are done, on disk: one that was killed goes on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge_runtime.files import read_bytes, write_json
from hil_tests.vehicle.lag_axes import Lag
from trainer.drivers import make_environment
from trainer.experiments.units import digest

FORMAT = 1
"""Raise it where the same point begins to mean another drive: kept points become void."""


class KeptPoints:
    """Rows by a hash of all that decides them; ``task`` is the sweep's, with its policy's id."""

    def __init__(self, directory: Path, task: Mapping[str, Any], policy_id: str) -> None:
        self._directory = directory
        config = make_environment(task["scenario"], task["condition"]).config
        self._deciding = {
            **{name: value for name, value in task.items() if name != "policy"},
            "format": FORMAT,
            "policy_id": policy_id,
            "environment": asdict(config),
        }

    def load(self, lag: Lag) -> dict[str, Any] | None:
        """The kept row; None where there is none."""
        path = self._path(lag)
        if not path.is_file():
            return None
        row: dict[str, Any] = json.loads(read_bytes(path, "kept point"))
        return row

    def save(self, lag: Lag, row: Mapping[str, Any]) -> None:
        """Keep a row."""
        self._directory.mkdir(parents=True, exist_ok=True)
        write_json(self._path(lag), row)

    def _path(self, lag: Lag) -> Path:
        return self._directory / f"{digest({**self._deciding, 'lag': lag.spec})}.json"
