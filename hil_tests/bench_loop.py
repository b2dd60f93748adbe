"""``python -m hil_tests bench``: the loop against the least that could answer, and what it costs.

Two processes answer the same states by turns, so that the machine disturbs both alike: the edge
runtime, and the floor, which is this file run by itself. Then the runtime's memory and idle load.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import msgspec
import numpy as np
import onnxruntime
import zenoh

from bridge.ports import add_options
from edge_runtime import wire
from edge_runtime.cli import ArgumentParser, examples, positive
from edge_runtime.files import write_json_out
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, wait_until
from hil_tests.testing.messages import make_state
from trainer.util import processor_model, source_revision

OURS, FLOOR = "bench-ours", "bench-floor"
PERIOD_S, LAST_ANSWER_S = 0.004, 0.2
IDLE_S, MEMORY_SAMPLES, QUANTILES = 10.0, 10, (50, 90, 99)
PICTURES = np.random.default_rng(0).integers(0, 256, (64, 2, 45, 80), dtype=np.uint8)
EXAMPLE = examples("python -m hil_tests bench --states 1000 --out runs/loop.json")


def add_arguments(parser: ArgumentParser) -> None:
    states = "states that each answers; the memory's run has ten times as many"
    parser.add_argument("--states", type=positive, default=10_000, help=states)
    add_options(parser, "--out")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print, and write the JSON."""
    endpoint = free_endpoint()
    policy = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY))
    with ExitStack() as stack:
        session = stack.enter_context(open_session(listen=endpoint, mode="router"))
        ours, floor = (Contender(session, name, stack) for name in (OURS, FLOOR))
        begun_s = time.perf_counter()
        run_edge = ("edge_runtime", "run", *policy, "--connect", endpoint, "--vehicle-id", OURS)
        edge = stack.enter_context(Process(*run_edge))
        wait_until(lambda: ours.ask_ms(limit_s=0.02), OURS)
        first_command_s = time.perf_counter() - begun_s
        stack.enter_context(Process("hil_tests.bench_loop", str(POLICY), endpoint, ready="ready"))
        wait_until(floor.ask_ms, FLOOR)
        latency_ms = compare(ours, floor, arguments.states)
        begin_s = cpu_s(edge.pid)
        time.sleep(IDLE_S)
        idle = (cpu_s(edge.pid) - begin_s) / IDLE_S
        memory_mb = [edge.resident_mb()]
        for _ in range(MEMORY_SAMPLES):
            for _ in range(arguments.states):
                ours.ask_ms()
            memory_mb.append(edge.resident_mb())
    # The first tenth fills pools and windows; what comes after it must not grow.
    report = {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "source_revision": source_revision(), "states": arguments.states, "latency_ms": latency_ms,
        "process": {"first_command_s": first_command_s, "idle_load": idle, "memory_mb": memory_mb},
    }  # fmt: skip
    write_json_out(arguments.out, report)
    print(json.dumps(report, indent=2))
    return 0


class Contender:
    """Sends states to a process, each when the one before was answered."""

    def __init__(self, session: zenoh.Session, vehicle_id: str, stack: ExitStack) -> None:
        self._step, self._arrived_s, self._answered = 0, 0.0, threading.Event()
        publisher = session.declare_publisher(wire.key(vehicle_id, "state"))
        self._put = stack.enter_context(publisher).put
        commands = wire.key(vehicle_id, "command")
        stack.enter_context(session.declare_subscriber(commands, self._on_command))

    def ask_ms(self, limit_s: float = LAST_ANSWER_S) -> float | None:
        """Send a state; return how long its answer took, ms, or None where none came in time."""
        self._step += 1
        seen = {"frames": PICTURES[self._step % len(PICTURES)].tobytes()}
        payload = wire.encode(make_state(self._step, observation=seen))
        self._answered.clear()
        sent_s = time.perf_counter()
        self._put(payload)
        return (self._arrived_s - sent_s) * 1e3 if self._answered.wait(limit_s) else None

    def _on_command(self, sample: zenoh.Sample) -> None:
        arrived_s = time.perf_counter()
        command = wire.decode_command(bytes(sample.payload))
        assert isinstance(command, wire.Command), command
        if command.step == self._step and not self._answered.is_set():
            self._arrived_s = arrived_s
            self._answered.set()


def compare(ours: Contender, floor: Contender, count: int) -> dict[str, dict[str, float]]:
    """Ask both ``count`` times by turns; return how many answered, and quantiles of the time."""
    times_ms: list[list[float | None]] = [[], []]
    next_s = time.perf_counter()
    for _ in range(count):
        for contender, taken_ms in zip((ours, floor), times_ms, strict=True):
            next_s = max(next_s + PERIOD_S, time.perf_counter())
            time.sleep(max(0.0, next_s - time.perf_counter()))
            taken_ms.append(contender.ask_ms())
    answered = [[each for each in taken_ms if each is not None] for taken_ms in times_ms]
    counts = {"ours": float(len(answered[0])), "floor": float(len(answered[1]))}
    found = {"answered": counts}
    for quantile in QUANTILES:
        mine, least = (float(np.percentile(each, quantile)) for each in answered)
        found[f"p{quantile}"] = {"ours": mine, "floor": least, "ratio": mine / least}
    return found


def cpu_s(pid: int) -> float:
    """Return the processor time that a process has used, s."""
    # After the name, which may hold spaces: state is field 3, utime and stime 14 and 15.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def answer(policy: str, connect: str) -> None:
    """Be the floor: answer states until SIGTERM by a Zenoh callback, onnxruntime and a put.

    No validation, no watchdog, no limits: the edge runtime's cost is measured against this.
    """
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    network = onnxruntime.InferenceSession(policy, options, providers=["CPUExecutionProvider"])
    decode = msgspec.msgpack.Decoder(wire.State).decode

    def on_state(sample: zenoh.Sample) -> None:
        state = decode(bytes(sample.payload))
        frames = np.frombuffer(state.observation["frames"], np.uint8).reshape(1, 2, 45, 80)
        (actions,) = network.run(["action"], {"frames": frames})
        command = wire.Command(
            session=state.session, episode=state.episode, step=state.step, mode=wire.DRIVE,
            action=actions[0].tolist(), policy_id="", received_ns=0, inference_ns=0, sent_ns=0,
        )  # fmt: skip
        publisher.put(wire.encode(command))

    with (
        open_session(connect=connect, mode="peer") as session,
        session.declare_publisher(
            wire.key(FLOOR, "command"),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        ) as publisher,
        session.declare_subscriber(wire.key(FLOOR, "state"), on_state),
    ):
        print("ready", flush=True)
        end.wait()


if __name__ == "__main__":
    answer(*sys.argv[1:])
