"""Recorded steps for tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from trainer.person.recording import Step


def picture(value: int) -> bytes:
    """A frame that is hard to compress, a different one for each value."""
    return np.random.default_rng(value).integers(0, 255, (45, 80), np.uint8).tobytes()


def recorded_step(sitting: int, index: int, **changes: Any) -> Step:
    """Step ``index`` of an episode that began with the sitting."""
    values: dict[str, Any] = {
        "sitting": sitting,
        "index": index,
        "scenario": "left_turn",
        "seed": 1,
        "episode": 0,
        "step": index,
        "time_ns": 10**9 + index * 10**8,
        "time_s": 0.1 * index,
        "frames": picture(index) + picture(index + 1),
        "next_frame": picture(index + 2),
        "policy_action": 0.25,
        "human_action": -0.5,
        "action": 0.25,
        "control": "policy",
        "human": False,
        "first": False,
        "reward": float(index),
        "terminated": False,
        "truncated": False,
        "speed_mps": 3.0,
    }
    return Step(**{**values, **changes})
