"""``python -m hil_tests bench``: the loop against the least that could answer, and what it costs.

Two processes answer the same states: the edge runtime, and the floor, which is this file run by
itself. Their blocks take turns, so that the machine disturbs both alike. Then the runtime's memory,
idle load and start.
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
from typing import Any

import msgspec
import numpy as np
import onnxruntime
import zenoh

from bridge.ports import add_options
from bridge.report import ProgressBar
from edge_runtime import wire
from edge_runtime.cli import ArgumentParser, examples, positive
from edge_runtime.files import write_json_out
from edge_runtime.policy import load_policy
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, wait_until
from hil_tests.testing.messages import make_state
from trainer.util import processor_model, source_revision

OURS, FLOOR = "bench-ours", "bench-floor"
PERIOD_S, LAST_ANSWER_S = 0.004, 0.2
IDLE_S, MEMORY_SAMPLES, QUANTILES = 10.0, 10, (50, 90, 99)
PICTURES = np.random.default_rng(0).integers(0, 256, (64, 2, 45, 80), dtype=np.uint8)
EXAMPLE = examples("python -m hil_tests bench --blocks 5 --out runs/loop.json")


def add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("--policy", default=str(POLICY), help="policy file")
    parser.add_argument("--public-key", default=str(PUBLIC_KEY), help="of the policy's signature")
    parser.add_argument("--blocks", type=positive, default=20, help="blocks of each contender")
    parser.add_argument("--states", type=positive, default=500, help="states in each block")
    steps = "steps of the memory's run"
    parser.add_argument("--steps", type=positive, default=100_000, help=steps)
    add_options(parser, "--out")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print, and write the JSON."""
    load_policy(arguments.policy, arguments.public_key)
    endpoint = free_endpoint()
    policy = ("--policy", arguments.policy, "--public-key", arguments.public_key)
    where = ("--connect", endpoint, "--vehicle-id", OURS)
    with ExitStack() as stack:
        session = stack.enter_context(open_session(listen=endpoint, mode="router"))
        ours, floor = (Contender(session, name, stack) for name in (OURS, FLOOR))
        begun_s = time.perf_counter()
        edge = stack.enter_context(Process("edge_runtime", "run", *policy, *where))
        first_command_s = ours.rouse() - begun_s
        words = ("hil_tests.bench_loop", arguments.policy, endpoint)
        stack.enter_context(Process(*words, ready="ready"))
        floor.rouse()
        latency = alternate(ours, floor, arguments.blocks, arguments.states)
        begin_s = cpu_s(edge.pid)
        time.sleep(IDLE_S)
        idle = (cpu_s(edge.pid) - begin_s) / IDLE_S
        memory_mb = [edge.resident_mb()]
        for _ in range(MEMORY_SAMPLES):
            for _ in range(arguments.steps // MEMORY_SAMPLES):
                ours.ask()
            memory_mb.append(edge.resident_mb())
    # The first tenth fills pools and windows; what comes after it must not grow.
    report = {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "source_revision": source_revision(), "latency": latency,
        "process": {"first_command_s": first_command_s, "idle_load": idle, "memory_mb": memory_mb},
    }  # fmt: skip
    write_json_out(arguments.out, report)
    print(json.dumps(report, indent=2))
    return 0


class Contender:
    """Sends states to a process and notes when each was answered. A block is an episode."""

    def __init__(self, session: zenoh.Session, vehicle_id: str, stack: ExitStack) -> None:
        self.vehicle_id = vehicle_id
        self.arrivals: dict[int, float] = {}  # Step -> when its answer came (perf_counter, s)
        self._step = self._episode = 0
        publisher = session.declare_publisher(wire.key(vehicle_id, "state"))
        self._put = stack.enter_context(publisher).put
        commands = wire.key(vehicle_id, "command")
        stack.enter_context(session.declare_subscriber(commands, self._on_command))

    def send(self, final: bool = False) -> tuple[int, float]:
        """Send the next state; return its step and when it was sent (perf_counter, s)."""
        self._step += 1
        seen = {"frames": PICTURES[self._step % len(PICTURES)].tobytes()}
        state = make_state(
            self._step, session="bench", episode=self._episode, final=final, observation=seen
        )
        payload = wire.encode(state)
        sent_s = time.perf_counter()
        self._put(payload)
        return self._step, sent_s

    def end_block(self) -> None:
        """Send a final state: the edge runtime stands by while the other process works."""
        self.send(final=True)
        self._episode += 1
        self.arrivals.clear()

    def rouse(self) -> float:
        """Send states until the first answer comes; return when it came (perf_counter, s)."""
        wait_until(lambda: self.send() and self.arrivals, self.vehicle_id, poll_s=0.02)
        first_s = min(self.arrivals.values())
        self.end_block()
        return first_s

    def ask(self) -> None:
        """Send a state and wait for its answer."""
        step, _ = self.send()
        wait_until(lambda: self.arrivals.pop(step, None), self.vehicle_id, poll_s=0.0001)

    def block_ms(self, count: int) -> np.ndarray:
        """Return the latencies of a block's answers, ms; states without an answer are missing."""
        sent: dict[int, float] = {}
        next_s = time.perf_counter()
        for _ in range(count):
            next_s = max(next_s + PERIOD_S, time.perf_counter())
            time.sleep(max(0.0, next_s - time.perf_counter()))
            step, sent[step] = self.send()
        time.sleep(LAST_ANSWER_S)
        arrivals = dict(self.arrivals)
        self.end_block()
        return np.array([(arrivals[s] - at_s) * 1e3 for s, at_s in sent.items() if s in arrivals])

    def _on_command(self, sample: zenoh.Sample) -> None:
        arrived_s = time.perf_counter()
        command = wire.decode_command(bytes(sample.payload))
        assert isinstance(command, wire.Command), command
        self.arrivals.setdefault(command.step, arrived_s)


def alternate(ours: Contender, floor: Contender, blocks: int, count: int) -> dict[str, Any]:
    """Ask both in blocks by turns; who begins a pair changes, and the first pair is a warm-up."""
    times: dict[str, list[np.ndarray]] = {OURS: [], FLOOR: []}
    with ProgressBar("pairs of blocks", blocks + 1) as bar:
        for number in range(blocks + 1):
            for contender in (ours, floor) if number % 2 else (floor, ours):
                block = contender.block_ms(count)
                if number:
                    times[contender.vehicle_id].append(block)
            bar.advance({})
    own, bare = (np.concatenate(some) for some in times.values())
    latency_ms = {}
    for quantile in QUANTILES:
        mine, least = np.percentile(own, quantile), np.percentile(bare, quantile)
        latency_ms[f"p{quantile}"] = {"ours": mine, "floor": least, "ratio": mine / least}
    answered = {OURS: len(own), FLOOR: len(bare)}
    return {"states": blocks * count, "answered": answered, "latency_ms": latency_ms}


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
