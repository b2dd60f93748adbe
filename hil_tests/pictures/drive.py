"""A drive to look at: the shipped policy in real time, a network with an outage, a mock vehicle."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from edge_runtime.link_probe import free_endpoint
from hil_tests.commands import BackgroundCommand, run_command
from hil_tests.operator import Operator

POLICY, PUBLIC_KEY = "results/policies/left_turn.onnx", "results/policies/policy.pub"
VEHICLE = "pictures"
LATENCY = "50ms+-10ms,outage=0.4s@3s"
EPISODES, SEED = 2, 8
PATIENCE_S = 30.0


def recorded_drive(work: Path) -> Path:
    """The recording of the drive, made once for all pictures of it."""
    out = work / "drive.mcap"
    if not out.exists():
        _drive(out)
    return out


def _drive(out: Path) -> None:
    endpoint = free_endpoint()
    common = ("--connect", endpoint, "--vehicle-id", VEHICLE)
    trust = ("--policy", POLICY, "--public-key", PUBLIC_KEY)
    with ExitStack() as stack:
        edge = ("edge_runtime", "run", *trust, *common, "--vehicle", "mock")
        stack.enter_context(BackgroundCommand(*edge, ready="ready"))
        record = ("bridge", "record", "--out", str(out), *common, "--wait-s", "30")
        recorder = stack.enter_context(BackgroundCommand(*record))
        stack.enter_context(Operator(endpoint, VEHICLE))
        run_command(
            "bridge", "simulate", "--env", "left_turn", "--clock", "realtime",
            "--latency", LATENCY, "--episodes", str(EPISODES), "--seed", str(SEED),
            "--listen", endpoint, "--vehicle-id", VEHICLE,
        )  # fmt: skip
        recorder.wait(PATIENCE_S)
