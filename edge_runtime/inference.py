"""The policy in a thread of its own, so that the watchdog runs on while it computes."""

from __future__ import annotations

import time
from typing import NamedTuple, Optional

import numpy as np

from edge_runtime import log
from edge_runtime.policy import Policy


class Inference(NamedTuple):
    """An answer of the policy, float32 [n] or None where it failed, and how long it took."""

    output: Optional[np.ndarray]
    duration_ns: int


def infer(policy: Policy, frames: np.ndarray) -> Inference:
    """Run the policy on frames, uint8 [2, 45, 80]. Where it raises, there is no answer."""
    begun_ns = time.perf_counter_ns()
    output: Optional[np.ndarray] = None
    try:
        output = policy.act(frames)
    except Exception as error:  # onnxruntime's exceptions share no narrower base
        log.event("error", "inference_failed", detail=error)
    return Inference(output, time.perf_counter_ns() - begun_ns)
