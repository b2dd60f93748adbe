"""What the edge runtime says of itself during a drive, in its health messages. No socket."""

from __future__ import annotations

import threading
from collections import Counter

import msgspec

from edge_runtime.wire import Health, decode_health


class EdgeCounts:
    """Adds up how the edge's counts grow; the first health seen is where they stood before.

    Two threads report here: health messages on Zenoh's, answers to the status query on the
    caller's.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rejected: Counter[str] = Counter()
        self._unreadable: Counter[str] = Counter()
        self._changes = 0
        self._last: Health | None = None

    @property
    def rejected(self) -> dict[str, int]:
        """Return the states rejected by reason, without zeros."""
        with self._lock:
            return dict(self._rejected)

    @property
    def unreadable(self) -> dict[str, int]:
        """Return the health messages that could not be read, by reason."""
        with self._lock:
            return dict(self._unreadable)

    @property
    def changes(self) -> int:
        """Return how often another edge runtime took over, or the same was started again."""
        with self._lock:
            return self._changes

    @property
    def policy_id(self) -> str:
        """Return the policy of the newest health; empty before the first."""
        with self._lock:
            return "" if self._last is None else self._last.policy_id

    @property
    def waits_for_rearm(self) -> bool:
        """Return whether, by the newest health, only an operator can let the vehicle drive."""
        with self._lock:
            return self._last is not None and self._last.needs_rearm

    def observe_message(self, payload: bytes) -> None:
        """Take a health message; one that cannot be read is counted, as ``health_REASON``."""
        health = decode_health(payload)
        if isinstance(health, Health):
            self.observe(health)
            return
        with self._lock:
            self._unreadable[f"health_{health.reason.value}"] += 1

    def observe_status(self, payload: bytes) -> None:
        """Take the JSON answer to the status query, which holds the fields of a health message."""
        try:
            self.observe(msgspec.json.decode(payload, type=Health))
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return

    def observe(self, health: Health) -> None:
        """Add what is new since the last health."""
        with self._lock:
            last = self._last
            if last is None:
                self._last = health
                return
            # Where a message and an answer have overtaken one another both clocks say so; a wall
            # clock that was set back, or a restart, turns back only one of the two.
            if health.sent_ns <= last.sent_ns and health.uptime_s <= last.uptime_s:
                return
            self._last = health
            # A restarted edge runtime has a younger clock; it and another one count for themselves.
            another = health.uptime_s < last.uptime_s or health.policy_id != last.policy_id
            self._changes += another
            before = {} if another else last.rejected
            grown = Counter(health.rejected)
            grown.subtract(before)
            self._rejected += grown
