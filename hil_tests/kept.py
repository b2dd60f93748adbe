"""What a campaign has driven, on disk: one that was killed, or is asked for more, goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge_runtime.files import make_directory, write_json
from edge_runtime.util import UserError, read_json
from trainer.drivers import make_environment
from trainer.experiments.plan import digest


class KeptResults:
    """A file for each result, named by a hash of all that decides it.

    Args:
        directory: where; it is made.
        scenario: its environment's settings decide, too,
        condition: under this condition.
        deciding: what all results have in common.

    Raises:
        UserError: there can be no such directory.
    """

    def __init__(
        self, directory: Path, scenario: str, condition: str, deciding: Mapping[str, Any]
    ) -> None:
        config = make_environment(scenario, condition).config
        shared = {"scenario": scenario, "condition": condition, "environment": asdict(config)}
        self._deciding = {**deciding, **shared}
        self._directory = directory
        make_directory(directory)

    def load(self, one: Mapping[str, Any]) -> dict[str, Any] | None:
        """The kept result of ``one``; None where there is none. UserError: it is no JSON."""
        path = self._path(one)
        if not path.is_file():
            return None
        try:
            result: dict[str, Any] = read_json(path, "kept result")
        except UserError as error:
            raise UserError(f"{error}; remove it") from None
        return result

    def save(self, one: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Keep the result of ``one``."""
        write_json(self._path(one), result)

    def _path(self, one: Mapping[str, Any]) -> Path:
        return self._directory / f"{digest({**self._deciding, **one})}.json"
