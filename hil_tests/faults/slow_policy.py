"""Policies made for the campaign, with the graphs of the edge runtime's own tests."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from edge_runtime.policy import load_policy
from edge_runtime.tests import policies
from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE

SLOW_S = 2.5 * CONTROL_PERIOD_S
_STEADY_PEDAL = 0.6


def write_slow(path: Path) -> None:
    """A policy that takes about SLOW_S on white frames on this machine, and no time on others."""
    trial = path.with_suffix(".trial.onnx")
    policies.write_policy(trial, "slow")
    policy = load_policy(trial, allow_unsigned=True)
    begun_s = time.perf_counter()
    policy.act(np.full(FRAMES_SHAPE, 255, np.uint8))
    took_s = time.perf_counter() - begun_s
    loops = max(1, round(policies.SLOW_LOOPS * SLOW_S / took_s))
    policies.write_policy(path, "slow", loops=loops)


def write_mean(path: Path) -> None:
    """A policy with the brightness for its pedal: full throttle on white frames, else the brake."""
    policies.write_policy(path, "mean")


def write_steady(path: Path) -> None:
    """A policy that always gives the same pedal."""
    policies.write_policy(path, "constant", _STEADY_PEDAL)


def write_full(path: Path) -> None:
    """A policy that always gives full throttle."""
    policies.write_policy(path, "constant", 1.0)
