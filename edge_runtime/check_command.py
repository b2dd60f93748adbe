"""`python -m edge_runtime check`: may this policy drive, and how fast does it answer here?"""

from __future__ import annotations

import argparse
import itertools
import json
from typing import Any, Dict

import msgspec
import onnxruntime

from edge_runtime.errors import UserError
from edge_runtime.files import check_writable, write_json
from edge_runtime.inference import infer
from edge_runtime.latency_window import LatencyWindow
from edge_runtime.policy import Policy, load_policy, probe_frames
from edge_runtime.wire import CONTROL_PERIOD_S

_RUNS = 300


def check(arguments: argparse.Namespace) -> int:
    """Print the report as JSON. Raises UserError where the policy may not drive."""
    if arguments.out is not None:
        check_writable(arguments.out)
    policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
    report = _report(policy)
    limit_ms = CONTROL_PERIOD_S * 1000
    if report["inference_ms"]["p99"] > limit_ms:
        raise UserError(
            f"policy {arguments.policy} may not drive: its inference takes"
            f" {report['inference_ms']['p99']:.0f} ms (p99) here, {limit_ms:.0f} ms is the limit"
        )
    print(json.dumps(report, indent=2))
    if arguments.out is not None:
        write_json(arguments.out, report)
    return 0


def _report(policy: Policy) -> Dict[str, Any]:
    return {
        "policy_id": policy.policy_id,
        "trust": policy.trust,
        "manifest": msgspec.to_builtins(policy.manifest),
        "inference_ms": measure_latency(policy),
        "inference_runs": _RUNS,
        "onnxruntime": onnxruntime.__version__,
    }


def measure_latency(policy: Policy) -> Dict[str, float]:
    """p50, p99 and max of the inference on this machine, in milliseconds."""
    window = LatencyWindow()
    for frames in itertools.islice(itertools.cycle(probe_frames()), _RUNS):
        window.add(infer(policy, frames).duration_ns)
    return window.summary_ms()
