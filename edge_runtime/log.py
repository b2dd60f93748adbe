"""Log to stderr, one line an event: time, level, event, then its fields.

As text (`time LEVEL event key=value`) or as JSON, one object a line. A thread of its own writes
the lines, so that a stalled reader of stderr cannot hold the thread that drives.
"""

from __future__ import annotations

import contextlib
import json
import logging
import queue
import threading
import time
from typing import Any, Optional

LEVELS = ("debug", "info", "warning", "error")
FORMATS = ("text", "json")
_LOGGER = logging.getLogger("edge_runtime")
_WAITING_LINES = 1000
_FLUSH_S = 0.5


def configure(level: str, log_format: str = "text") -> None:
    """Send lines of at least `level` to stderr."""
    stream = logging.StreamHandler()
    stream.setFormatter(_Formatter(as_json=log_format == "json"))
    close()
    _LOGGER.handlers = [_Background(stream)]
    _LOGGER.propagate = False
    _LOGGER.setLevel(level.upper())
    logging.raiseExceptions = False  # a closed stderr must not stop the vehicle's controller


def event(level: str, name: str, /, **fields: Any) -> None:
    _LOGGER.log(logging.getLevelName(level.upper()), name, extra={"fields": fields})


def close() -> bool:
    """Write the waiting lines before the process ends, for half a second at most.

    Returns False where a reader of stderr is stalled: the interpreter's exit would wait for it.
    """
    for handler in _LOGGER.handlers:
        handler.close()
    backgrounds = [one for one in _LOGGER.handlers if isinstance(one, _Background)]
    return not any(one.thread.is_alive() for one in backgrounds)


class _Background(logging.Handler):
    """Hands the lines to a thread; drops lines while its queue is full."""

    def __init__(self, target: logging.Handler) -> None:
        super().__init__()
        self._target = target
        self._lines: queue.Queue[Optional[logging.LogRecord]] = queue.Queue(_WAITING_LINES)
        self.thread = threading.Thread(target=self._run, name="log", daemon=True)
        self.thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(record)

    def close(self) -> None:
        try:
            self._lines.put(None, timeout=_FLUSH_S)
        except queue.Full:
            return
        self.thread.join(_FLUSH_S)
        super().close()

    def _run(self) -> None:
        for record in iter(self._lines.get, None):
            self._target.handle(record)


class _Formatter(logging.Formatter):
    def __init__(self, as_json: bool) -> None:
        super().__init__()
        self._as_json = as_json

    def format(self, record: logging.LogRecord) -> str:
        # UTC, so that the logs of board and workstation can be compared.
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        at, level, name = f"{seconds}.{int(record.msecs):03d}Z", record.levelname, record.msg
        fields = getattr(record, "fields", {})
        if self._as_json:
            line = {"time": at, "level": level.lower(), "event": name}
            # Twice, so that the line begins with them and no field can take their place.
            return json.dumps({**line, **fields, **line}, default=str)
        pairs = (f" {label}={_quoted(value)}" for label, value in fields.items())
        return f"{at} {level} {name}{''.join(pairs)}"


def _quoted(value: Any) -> str:
    text = str(value)
    # Other parties' words may hold what a terminal would act upon: repr writes it as escapes.
    is_plain = text and text.isprintable() and not any(c in " \"'=" for c in text)
    return text if is_plain else repr(text)
