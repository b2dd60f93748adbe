"""Recordings written by hand, message by message."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from bridge.messages import Heard
from bridge.recording import RecordingWriter
from edge_runtime.wire import Health, encode
from hil_tests.testing.messages import HEALTH, make_command, make_state

EPOCH_NS = 1_700_000_000 * 10**9
ANSWER_S, INFERENCE_S = 0.002, 0.001
SILENCE = {"mode": "safe_stop", "reason": "no_fresh_state", "action": [-1.0]}


def ns(seconds: float) -> int:
    """Return a stamp so many seconds after a recording's beginning."""
    return EPOCH_NS + round(seconds * 1e9)


def heard(topic: str, payload: bytes, arrived_ns: int = 1) -> Heard:
    """Return a message of the vehicle v as a listener gets it."""
    return Heard(f"phil/v/{topic}", topic, payload, arrived_ns, len(payload))


def health(
    sent_ns: int, uptime_s: float, vehicle: str = "none", needs_rearm: bool = False, **rejected: int
) -> Health:
    """Make a health message with counts of rejected states."""
    what: dict[str, Any] = {"vehicle": vehicle, "needs_rearm": needs_rearm, "rejected": rejected}
    return msgspec.structs.replace(HEALTH, sent_ns=sent_ns, uptime_s=uptime_s, **what)


class Hand:
    """Writes a recording message by message; times in seconds since its beginning."""

    def __init__(self, path: Path, edge_clock_s: float = 0.0) -> None:
        self.path, self.writer = path, RecordingWriter(path)
        self.edge_clock_s, self.closed = edge_clock_s, False

    def hear(self, at_s: float, topic: str, message: Any, vehicle_id: str = "v") -> None:
        payload = encode(message)
        key = f"phil/{vehicle_id}/{topic}"
        self.writer.write(Heard(key, topic, payload, ns(at_s), len(payload)))

    def hear_health(self, at_s: float, uptime_s: float, **changes: Any) -> None:
        self.hear(at_s, "health", health(ns(at_s), uptime_s, **changes))

    def state(self, at_s: float, step: int, **changes: Any) -> None:
        fields = {"session": "here", "sent_ns": ns(at_s), **changes}
        self.hear(at_s, "state", make_state(step, **fields))

    def command(self, at_s: float, step: int, answer_s: float = ANSWER_S, **changes: Any) -> None:
        stamps = {
            "received_ns": ns(at_s - answer_s + self.edge_clock_s),
            "sent_ns": ns(at_s + self.edge_clock_s),
            "inference_ns": round(INFERENCE_S * 1e9),
            "action": [0.3],
        }
        self.hear(at_s, "command", make_command(step, **{**stamps, **changes}))

    def drive(self, first: int, last: int, start_s: float = 0.0, **changes: Any) -> None:
        """Write states at every T, each answered, with ``drive`` unless ``changes`` differ."""
        for step in range(first, last):
            at_s = start_s + step * 0.1
            self.state(at_s, step)
            self.command(at_s + ANSWER_S, step, **changes)

    def stop(self, step: int, count: int) -> None:
        """Write the watchdog's stop 2 T after the state at ``step`` * T, and its repetitions."""
        for repetition in range(count):
            late_s = 0.2001 + repetition * 0.1
            self.command(step * 0.1 + late_s, step, answer_s=late_s, inference_ns=0, **SILENCE)

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.writer.finish()
            self.writer.close()
