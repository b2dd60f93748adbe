"""``python -m hil_tests.benches``: the loop against the floor, and what the process costs."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from edge_runtime import wire
from edge_runtime.cli import ArgumentParser, examples, run_cli, write_json_out
from edge_runtime.files import check_writable
from edge_runtime.option_types import positive
from edge_runtime.policy import load_policy
from edge_runtime.transport import free_endpoint, open_session
from hil_tests.benches.contenders import Floor, Ours, answer, rouse, start_floor, start_ours
from hil_tests.benches.footprint import first_command_s, idle_load, memory_mb
from hil_tests.benches.latency import alternate
from hil_tests.benches.lockstep import lockstep
from hil_tests.benches.table import show
from hil_tests.faults.campaign import POLICY, PUBLIC_KEY
from trainer.util import processor_model, source_revision

STARTS = 5
IDLE_S = 10.0
WARM_UP = 200
FLOOR_STEPS = 10_000


def main(argv: list[str]) -> int:
    """Measure, print the table, and write the JSON. Bars are shown, never enforced."""
    parser = ArgumentParser(
        prog="python -m hil_tests.benches",
        description="The loop's bench.",
        epilog=examples("python -m hil_tests.benches --blocks 5 --out runs/loop.json"),
    )
    parser.add_argument("--policy", default=str(POLICY), help="policy file")
    parser.add_argument("--public-key", default=str(PUBLIC_KEY), help="of the policy's signature")
    parser.add_argument("--blocks", type=positive, default=20, help="of each contender")
    parser.add_argument("--states", type=positive, default=500, help="in each block")
    parser.add_argument("--steps", type=positive, default=100_000, help="of the memory's run")
    parser.add_argument("--episodes", type=positive, default=20, help="of the lock-step drive")
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")
    arguments = parser.parse_args(argv)
    if arguments.out is not None:
        check_writable(arguments.out)
    load_policy(arguments.policy, arguments.public_key)
    machine = {"processor": processor_model(), "cores": os.cpu_count(), "load_before": _load()}
    report = {"machine": machine, "source_revision": source_revision(), **_measure(arguments)}
    machine["load_after"] = _load()
    write_json_out(arguments.out, report)
    show(report)
    return 0


def _measure(arguments: Any) -> dict[str, Any]:
    policy = ["--policy", arguments.policy, "--public-key", arguments.public_key]
    endpoint = free_endpoint()
    session = open_session(listen=endpoint, mode="router")
    ours = Ours(session)
    processes = []
    try:
        starts_s = []
        for _ in range(STARTS):
            edge, took_s = first_command_s(lambda: start_ours(policy, endpoint), ours)
            processes.append(edge)
            starts_s.append(took_s)
            if len(starts_s) < STARTS:
                edge.end()
        _tell(f"{STARTS} starts")
        bare_process = start_floor(arguments.policy, endpoint, ours.reply_bytes)
        processes.append(bare_process)
        bare_process.wait_for_line("ready")
        floor = Floor(session, len(ours.prepare()[1]))
        for contender in (ours, floor):
            rouse(contender)
            for _ in range(WARM_UP):
                answer(contender, 5.0)
        ours.end_block()
        latency = alternate(ours, floor, arguments.blocks, arguments.states, _tell)
        idle = idle_load(edge.pid, IDLE_S)
        memory = memory_mb(edge.pid, ours, arguments.steps, _tell)
        ours.end_block()
        floor_steps = min(FLOOR_STEPS, arguments.steps)
        floor_memory = memory_mb(bare_process.pid, floor, floor_steps, _tell)
        floor.close()
    finally:
        for process in processes:
            process.end()
        ours.close()
        session.close()
    with tempfile.TemporaryDirectory() as directory:
        drive = lockstep(policy, "left_turn", arguments.episodes, Path(directory))
    return {
        "latency": latency,
        "process": {
            "first_command_s": {"median": float(np.median(starts_s)), "starts": STARTS},
            "idle_load": idle,
            "memory_mb": memory,
            "floor_memory_mb": floor_memory,
        },
        "modes": ours.modes,
        "state_bytes": len(wire.encode(_any_state())),
        "lockstep": drive,
    }


def _any_state() -> wire.State:
    return wire.State(
        session="", episode=0, step=0, sim_time_s=0.0, sent_ns=0, speed_mps=0.0, final=False,
        frames=bytes(wire.FRAMES_BYTES),
    )  # fmt: skip


def _load() -> float:
    return os.getloadavg()[0]


def _tell(done: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{done:<40}", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(run_cli(main))
