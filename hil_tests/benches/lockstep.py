"""How many simulated seconds the closed loop makes in one of the wall."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import zenoh

from edge_runtime import wire
from edge_runtime.link_probe import free_endpoint
from edge_runtime.transport import open_session
from hil_tests.benches.contenders import OURS, start_ours
from hil_tests.faults.processes import Process

_RUN_S = 300.0


class _Listener:
    """From the first state to the last final one, and the simulated time of every episode."""

    def __init__(self) -> None:
        self.begun_s = self.ended_s = 0.0
        self.simulated_s = 0.0

    def hear(self, sample: zenoh.Sample) -> None:
        seen_s = time.perf_counter()
        state = wire.decode_state(bytes(sample.payload))
        if not isinstance(state, wire.State):
            return
        self.begun_s = self.begun_s or seen_s
        if state.final:
            self.ended_s = seen_s
            self.simulated_s += state.sim_time_s


def lockstep(policy: list[str], scenario: str, episodes: int, directory: Path) -> dict[str, Any]:
    """Drive ``episodes`` in lock-step; simulated seconds per wall second, without the start-up."""
    endpoint, listener = free_endpoint(), _Listener()
    simulator = Process(
        "bridge", "simulate", "--env", scenario, "--clock", "lockstep", "--listen", endpoint,
        "--vehicle-id", OURS, "--episodes", str(episodes), "--out", str(directory / "lock.json"),
    )  # fmt: skip
    session = open_session(connect=endpoint, mode="peer")
    subscriber = session.declare_subscriber(wire.key(OURS, "state"), listener.hear)
    edge = start_ours(policy, endpoint)
    try:
        status = simulator.wait(_RUN_S)
    finally:
        edge.end()
        simulator.end()
        subscriber.undeclare()
        session.close()
    if status:
        raise RuntimeError(f"bridge simulate ended with status {status}: {simulator.lines[-3:]}")
    wall_s = listener.ended_s - listener.begun_s
    return {
        "scenario": scenario,
        "episodes": episodes,
        "simulated_s": listener.simulated_s,
        "wall_s": wall_s,
        "times_real_time": listener.simulated_s / wall_s,
    }
