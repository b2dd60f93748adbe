"""The policy in a thread of its own, so that the watchdog runs on while it computes."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from edge_runtime import log
from edge_runtime.policy import Policy


class Inference(NamedTuple):
    """An answer of the policy, float32 [n], and how long it took."""

    output: np.ndarray
    duration_ns: int


def infer(policy: Policy, frames: np.ndarray) -> Inference:
    """Run the policy on frames, uint8 [2, 45, 80].

    Where it raises, the answer is NaN: a fault like any other.
    """
    begun_ns = time.perf_counter_ns()
    try:
        output = policy.act(frames)
    except Exception as error:  # onnxruntime's exceptions share no narrower base
        log.event("error", "inference_failed", detail=error)
        output = np.full(len(policy.manifest.action), np.nan, dtype=np.float32)
    return Inference(output, time.perf_counter_ns() - begun_ns)
