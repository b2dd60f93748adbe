"""``python -m hil_tests bench``: the loop against the least that could answer, and what it costs.

Two processes answer the same states: the edge runtime, and the floor, which is this file run by
itself. Their blocks take turns, so that the machine disturbs both alike. Then the runtime's memory,
idle load and start.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnxruntime
import zenoh

from bridge.ports import add_options
from bridge.report import ProgressBar, markdown_table
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
PERIOD_S, WARM_UP, PICTURES = 0.004, 200, 64
STARTS, IDLE_S, MEMORY_SAMPLES = 5, 10.0, 10
ROUSE_EVERY_S, LAST_ANSWER_S = 0.02, 0.2
QUANTILES, RESAMPLES, INTERVAL = (50, 90, 99), 2000, (2.5, 97.5)
RATIO_BAR = 1.25  # At most as many times the floor
BARS = (
    ("memory after the last step, MB", "memory_mb", 110.0),
    ("memory grown after the first tenth of the steps, MB", "grown_mb", 1.0),
    ("idle, part of a core", "idle_load", 0.02),
    (f"process start to first command, s (median of {STARTS})", "first_command_s", 1.5),
)
"""What is measured of the runtime's process, its name in the report, and its bar: below that."""
EXAMPLE = examples("python -m hil_tests bench --blocks 5 --out runs/loop.json")
HEAD = ("", "ours", "floor", "ratio", "bar")


def add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("--policy", default=str(POLICY), help="policy file")
    parser.add_argument("--public-key", default=str(PUBLIC_KEY), help="of the policy's signature")
    for name, default, text in (
        ("--blocks", 20, "blocks of each contender"),
        ("--states", 500, "states in each block"),
        ("--steps", 100_000, "steps of the memory's run"),
    ):
        parser.add_argument(name, type=positive, default=default, help=text)
    add_options(parser, "--out")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the table, and write the JSON. Bars are shown, never enforced."""
    load_policy(arguments.policy, arguments.public_key)
    machine = {"processor": processor_model(), "cores": os.cpu_count()}
    load = {"load_before": os.getloadavg()[0]}
    measured = _measure(arguments)
    load["load_after"] = os.getloadavg()[0]
    report = {"machine": {**machine, **load}, "source_revision": source_revision(), **measured}
    write_json_out(arguments.out, report)
    print(f"\n{', '.join(f'{name} {value}' for name, value in report['machine'].items())}\n")
    print("\n".join(markdown_table(HEAD, rows(report))))
    return 0


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    endpoint = free_endpoint()
    policy = ("--policy", arguments.policy, "--public-key", arguments.public_key)
    where = ("--connect", endpoint, "--vehicle-id", OURS)
    with ExitStack() as stack:
        session = stack.enter_context(open_session(listen=endpoint, mode="router"))
        ours, floor = (Contender(session, name, stack) for name in (OURS, FLOOR))
        starts_s: list[float] = []
        while len(starts_s) < STARTS:
            begun_s = time.perf_counter()
            edge = stack.enter_context(Process("edge_runtime", "run", *policy, *where))
            starts_s.append(ours.rouse() - begun_s)
            if len(starts_s) < STARTS:
                edge.end()
        words = ("hil_tests.bench_loop", arguments.policy, endpoint)
        stack.enter_context(Process(*words, ready="ready"))
        for contender in (ours, floor):
            contender.rouse()
            for _ in range(WARM_UP):
                contender.ask()
            contender.end_block()
        latency = alternate(ours, floor, arguments.blocks, arguments.states)
        idle = idle_load(edge.pid)
        memory_mb = memory(edge, ours, arguments.steps)
    # The first tenth fills pools and windows; what comes after it must not grow.
    process = {
        "first_command_s": float(np.median(starts_s)), "idle_load": idle, "steps": arguments.steps,
        "memory_samples_mb": memory_mb, "memory_mb": memory_mb[-1],
        "grown_mb": memory_mb[-1] - memory_mb[1],
    }  # fmt: skip
    return {"latency": latency, "process": process}


class Contender:
    """Sends states to a process and notes when each was answered. A block is an episode."""

    def __init__(self, session: zenoh.Session, vehicle_id: str, stack: ExitStack) -> None:
        self.vehicle_id = vehicle_id
        self.arrivals: dict[int, float] = {}  # Step -> when its answer came (perf_counter, s)
        draw = np.random.default_rng(0).integers
        shape = (PICTURES, 2, 45, 80)
        self._pictures = [one.tobytes() for one in draw(0, 256, shape, dtype=np.uint8)]
        self._step = self._episode = 0
        publisher = session.declare_publisher(
            wire.key(vehicle_id, "state"), congestion_control=zenoh.CongestionControl.DROP
        )
        self._put = stack.enter_context(publisher).put
        commands = wire.key(vehicle_id, "command")
        stack.enter_context(session.declare_subscriber(commands, self._on_command))

    def send(self, final: bool = False) -> tuple[int, float]:
        """Send the next state; return its step and when it was sent (perf_counter, s)."""
        self._step += 1
        state = make_state(
            self._step, session="bench", episode=self._episode, final=final,
            observation={"frames": self._pictures[self._step % PICTURES]},
        )  # fmt: skip
        payload = wire.encode(state)
        sent_s = time.perf_counter()
        self._put(payload)
        return self._step, sent_s

    def end_block(self) -> None:
        """Send a final state: the edge runtime stands by while the other process works."""
        self.send(final=True)
        self._episode += 1

    def rouse(self) -> float:
        """Send states until the first answer comes; return when it came (perf_counter, s)."""
        self.arrivals.clear()

        def is_answered() -> bool:
            self.send()
            time.sleep(ROUSE_EVERY_S)
            return bool(self.arrivals)

        wait_until(is_answered, f"{self.vehicle_id} answers")
        return min(self.arrivals.values())

    def ask(self) -> None:
        """Send a state and wait for its answer."""
        step, _ = self.send()
        what = f"the answer of {self.vehicle_id} to step {step}"
        wait_until(lambda: step in self.arrivals, what, poll_s=0.0001)

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
                block = block_ms(contender, count)
                if number:
                    times[contender.vehicle_id].append(block)
            bar.advance({})
    return {
        "period_ms": PERIOD_S * 1e3,
        "blocks": blocks,
        "states_per_block": count,
        "unanswered": {name: blocks * count - sum(map(len, some)) for name, some in times.items()},
        "latency_ms": compare(times[OURS], times[FLOOR]),
    }


def block_ms(contender: Contender, count: int) -> np.ndarray:
    """Return the latencies of a block's answers, ms; states without an answer are missing."""
    contender.arrivals.clear()
    sent: dict[int, float] = {}
    next_s = time.perf_counter()
    for _ in range(count):
        next_s = max(next_s + PERIOD_S, time.perf_counter())
        time.sleep(max(0.0, next_s - time.perf_counter()))
        step, sent[step] = contender.send()
    time.sleep(LAST_ANSWER_S)
    arrivals = dict(contender.arrivals)
    contender.end_block()
    return np.array([(arrivals[s] - at_s) * 1e3 for s, at_s in sent.items() if s in arrivals])


def compare(ours: Sequence[np.ndarray], floor: Sequence[np.ndarray]) -> dict[str, Any]:
    """For each quantile return ours, the floor's, their ratio over all blocks, its 95 % interval.

    Both are the latencies of each block, block by block side by side: blocks are resampled in pairs
    (bootstrap), for neighbours in time share the machine's noise.
    """

    def quantiles(draw: Sequence[int] | np.ndarray) -> np.ndarray:  # [ours and floor, quantiles]
        both = (np.concatenate([blocks[index] for index in draw]) for blocks in (ours, floor))
        return np.array([np.percentile(times, QUANTILES) for times in both])

    draws = np.random.default_rng(0).integers(0, len(ours), (RESAMPLES, len(ours)))
    resampled = np.array([mine / theirs for mine, theirs in map(quantiles, draws)])
    intervals = np.percentile(resampled, INTERVAL, axis=0).T.tolist()
    found = zip(QUANTILES, *quantiles(range(len(ours))).tolist(), intervals, strict=True)
    return {
        f"p{quantile}": {"ours": own, "floor": bare, "ratio": own / bare, "interval": interval}
        for quantile, own, bare, interval in found
    }


def memory(process: Process, contender: Contender, steps: int) -> list[float]:
    """Return the resident memory, MB, at the start and after each tenth of ``steps`` answers."""
    samples = [process.resident_mb()]
    for tenth in range(MEMORY_SAMPLES):
        contender.arrivals.clear()
        for _ in range(steps * tenth // MEMORY_SAMPLES, steps * (tenth + 1) // MEMORY_SAMPLES):
            contender.ask()
        samples.append(process.resident_mb())
    return samples


def idle_load(pid: int) -> float:
    """Return the part of a core that the process uses while nobody sends anything."""
    begin, begun_s = _cpu_s(pid), time.perf_counter()
    time.sleep(IDLE_S)
    return (_cpu_s(pid) - begin) / (time.perf_counter() - begun_s)


def _cpu_s(pid: int) -> float:
    # After the name, which may hold spaces: state is field 3, utime and stime 14 and 15.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rows(report: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of what was measured, with their bars."""
    for name, row in report["latency"]["latency_ms"].items():
        low, high = row["interval"]
        ratio, bar = row["ratio"], _bar(f"≤ {RATIO_BAR:g} times", row["ratio"] <= RATIO_BAR)
        both = f"{row['ours']:.3f}", f"{row['floor']:.3f}", f"{ratio:.2f} [{low:.2f}, {high:.2f}]"
        yield f"state sent to command received, {name}, ms", *both, bar
    for what, name, most in BARS:
        value = report["process"][name]
        yield what, f"{value:.3g}", "", "", _bar(f"< {most:g}", value < most)


def _bar(bar: str, met: bool) -> str:
    return f"{bar}  {'met' if met else 'MISSED'}"


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
            action=actions[0].tolist(), policy_id="0" * 64, received_ns=state.sent_ns,
            inference_ns=0, sent_ns=state.sent_ns,
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
