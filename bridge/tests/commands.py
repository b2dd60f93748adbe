"""Commands for tests."""

from __future__ import annotations

from typing import Any

from edge_runtime.wire import Command


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
