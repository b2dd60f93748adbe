"""Log to stderr, one line an event: time, level, event, then its fields.

A thread writes the lines, so that a stalled reader cannot hold the thread that drives.
"""

from __future__ import annotations

import logging
import queue
import time
from logging.handlers import QueueHandler, QueueListener
from typing import Any, Optional

from edge_runtime.util import ends_within

LEVELS = ("debug", "info", "warning", "error")
_LOGGER = logging.getLogger("edge_runtime")
_WAITING_LINES = 1000
_FLUSH_S = 0.5
_listener: Optional[QueueListener] = None


def configure(level: str) -> None:
    """Send lines of at least `level` to stderr."""
    global _listener
    stream = logging.StreamHandler()
    stream.setFormatter(_Formatter())
    close()
    lines: queue.Queue[logging.LogRecord] = queue.Queue(_WAITING_LINES)
    _listener = _Listener(lines, stream)
    _listener.start()
    _LOGGER.handlers = [QueueHandler(lines)]  # drops lines while its queue is full
    _LOGGER.propagate = False
    _LOGGER.setLevel(level.upper())
    logging.raiseExceptions = False  # a closed stderr must not stop the vehicle's controller


def event(level: str, name: str, /, **fields: Any) -> None:
    _LOGGER.log(logging.getLevelName(level.upper()), name, extra={"fields": fields})


def close() -> bool:
    """Write the waiting lines before the process ends, for half a second at most.

    Returns False where a reader of stderr is stalled: the interpreter's exit would wait for it.
    """
    global _listener
    listener, _listener = _listener, None
    return listener is None or ends_within(_FLUSH_S, listener.stop)


class _Listener(QueueListener):
    queue: Any

    def enqueue_sentinel(self) -> None:
        self.queue.put(None)  # waits for room, where the library's raises Full


class _Formatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        # UTC, so that the logs of board and workstation can be compared.
        seconds = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        fields = getattr(record, "fields", {})
        pairs = (f" {label}={_quoted(value)}" for label, value in fields.items())
        return f"{seconds}.{int(record.msecs):03d}Z {record.levelname} {record.msg}{''.join(pairs)}"


def _quoted(value: Any) -> str:
    text = str(value)
    # Foreign text may hold characters that a terminal acts upon: repr escapes them.
    is_plain = text and text.isprintable() and not any(c in " \"'=" for c in text)
    return text if is_plain else repr(text)
