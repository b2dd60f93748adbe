"""One line on stderr for each thing worth knowing: time, level, event, then key=value pairs."""

from __future__ import annotations

import logging
import time
from typing import Any

LEVELS = ("debug", "info", "warning", "error")
_LOGGER = logging.getLogger("edge_runtime")


def configure(level: str) -> None:
    """Send lines of at least `level` to stderr."""
    formatter = logging.Formatter("%(asctime)s.%(msecs)03dZ %(levelname)s %(message)s")
    formatter.default_time_format = "%Y-%m-%dT%H:%M:%S"
    formatter.datefmt = "%Y-%m-%dT%H:%M:%S"
    formatter.converter = time.gmtime  # boards and workstations sit in one time zone: UTC
    handler = logging.StreamHandler()
    handler.setFormatter(formatter)
    _LOGGER.handlers = [handler]
    _LOGGER.propagate = False
    _LOGGER.setLevel(level.upper())
    logging.raiseExceptions = False  # a closed stderr must not stop the vehicle's controller


def event(level: str, name: str, **fields: Any) -> None:
    """Log `name key=value ...`; a value with spaces is quoted."""
    pairs = "".join(f" {label}={_quoted(value)}" for label, value in fields.items())
    _LOGGER.log(logging.getLevelName(level.upper()), "%s%s", name, pairs)


def _quoted(value: Any) -> str:
    text = str(value)
    return repr(text) if not text or any(c.isspace() or c in "\"'=" for c in text) else text
