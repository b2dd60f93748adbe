"""Valid messages of the wire, with fields to be replaced."""

from __future__ import annotations

import time
from typing import Any

from edge_runtime.wire import Command, Feedback, Health, State
from hil_tests.tests.shared.policies import SIZE

BLACK, WHITE = 0, 255


def frames(level: int) -> dict[str, bytes]:
    """Return the observation of pictures that are grey throughout."""
    return {"frames": bytes([level]) * SIZE}


def make_state(step: int, **changes: Any) -> State:
    """Make a valid black state; `changes` replace its fields."""
    fields: dict[str, Any] = {
        "session": "simulator-a", "episode": 0, "step": step,
        "sim_time_s": step * 0.1, "sent_ns": time.time_ns(),
        "observation": frames(BLACK), "speed_mps": 1.0, "final": False,
    }  # fmt: skip
    return State(**{**fields, **changes})


def make_command(step: int = 0, **changes: Any) -> Command:
    """Make a valid command to drive; `changes` replace its fields."""
    fields: dict[str, Any] = {
        "session": "here", "episode": 0, "step": step, "mode": "drive", "action": [0.5],
        "policy_id": "p", "received_ns": 1, "inference_ns": 1, "sent_ns": 1,
    }  # fmt: skip
    return Command(**{**fields, **changes})


def make_feedback(step: int, **changes: Any) -> Feedback:
    """Make a valid feedback of a vehicle that obeys ``make_command(step)``, stamped at its tick."""
    fields: dict[str, Any] = {
        "vehicle": "robot", "session": "here", "episode": 0, "step": step, "mode": "drive",
        "action": [0.5], "speed_mps": 1.0, "self_braking": False, "faults": [],
        "sent_ns": 1_000_000_000 + step * 100_000_000,
    }  # fmt: skip
    return Feedback(**{**fields, **changes})


HEALTH = Health(
    vehicle_id="hunter01", vehicle="none", mode="standby", reason="", needs_rearm=False,
    accepted=0, superseded=0, rejected={}, deadline_misses=0, safe_stops=0, policy_id="p",
    inference_ms={}, uptime_s=0.0, sent_ns=0, command_ms={"p50": 1.5}, temperature_c=40.0,
    load_1min=0.5, rss_mb=90.0, rivals=1,
)  # fmt: skip
