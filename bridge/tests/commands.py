"""Commands and feedback for tests."""

from __future__ import annotations

from typing import Any

from edge_runtime.wire import Command, Feedback


def make_command(step: int, **changes: Any) -> Command:
    """Make a valid command of session ``here``, episode 0; ``changes`` replace its fields."""
    fields: dict[str, Any] = {
        "session": "here",
        "episode": 0,
        "step": step,
        "mode": "drive",
        "action": [0.5],
        "policy_id": "p",
        "received_ns": 1,
        "inference_ns": 1,
        "sent_ns": 1,
    }
    return Command(**{**fields, **changes})


def make_feedback(step: int, **changes: Any) -> Feedback:
    """Make a valid feedback of a vehicle that obeys ``make_command(step)``, stamped at its tick."""
    fields: dict[str, Any] = {
        "vehicle": "robot",
        "session": "here",
        "episode": 0,
        "step": step,
        "mode": "drive",
        "action": [0.5],
        "speed_mps": 1.0,
        "self_braking": False,
        "faults": [],
        "sent_ns": 1_000_000_000 + step * 100_000_000,
    }
    return Feedback(**{**fields, **changes})
