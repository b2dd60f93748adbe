"""``python -m hil_tests bench``: the loop against the least that could answer, and what it costs.

Two processes answer the same states: the edge runtime, and `bench_floor.py`. Their blocks take
turns, so that the machine disturbs both alike. Then the runtime's memory, idle load, start, and how
many simulated seconds the closed loop makes in one of the wall.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zenoh
from rich import box
from rich.console import Console
from rich.table import Table

from edge_runtime import wire
from edge_runtime.cli import ArgumentParser, examples, positive
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.link_probe import free_endpoint
from edge_runtime.policy import load_policy
from edge_runtime.transport import open_session
from hil_tests.bench_floor import STEP_BYTES
from hil_tests.faults.rig import make_state
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, wait_until
from trainer.util import processor_model, source_revision

OURS, FLOOR = "bench-ours", "bench-floor"
PICTURES = 64
PERIOD_S = 0.004
STARTS = 5
IDLE_S = 10.0
WARM_UP = 200
FLOOR_STEPS = 10_000
MEMORY_SAMPLES = 10
QUANTILES = (50, 90, 99)
RESAMPLES, INTERVAL = 2000, (2.5, 97.5)
RATIO_BAR, MEMORY_BAR_MB, FLAT_BAR_MB, IDLE_BAR, START_BAR_S, LOCKSTEP_BAR = (
    1.25, 110.0, 1.0, 0.02, 1.5, 30.0,
)  # fmt: skip
"""At most as many times the floor; at most; at most growth; of a core; s; times real time."""
WIDTH = 110
_ROUSE_EVERY_S = 0.02
_ANSWER_S, _LAST_ANSWER_S = 5.0, 0.2
_LOCKSTEP_LIMIT_S = 300.0
EXAMPLE = examples("python -m hil_tests bench --blocks 5 --out runs/loop.json")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--policy", default=str(POLICY), help="policy file")
    parser.add_argument("--public-key", default=str(PUBLIC_KEY), help="of the policy's signature")
    parser.add_argument("--blocks", type=positive, default=20, help="of each contender")
    parser.add_argument("--states", type=positive, default=500, help="in each block")
    parser.add_argument("--steps", type=positive, default=100_000, help="of the memory's run")
    parser.add_argument("--episodes", type=positive, default=20, help="of the lock-step drive")
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the table, and write the JSON. Bars are shown, never enforced."""
    if arguments.out is not None:
        check_writable(arguments.out)
    load_policy(arguments.policy, arguments.public_key)
    machine: dict[str, Any] = {"processor": processor_model(), "cores": os.cpu_count()}
    machine["load_before"] = os.getloadavg()[0]
    report = {"machine": machine, "source_revision": source_revision(), **_measure(arguments)}
    machine["load_after"] = os.getloadavg()[0]
    write_json_out(arguments.out, report)
    show(report)
    return 0


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    policy = ["--policy", arguments.policy, "--public-key", arguments.public_key]
    endpoint = free_endpoint()
    with ExitStack() as stack:
        session = open_session(listen=endpoint, mode="router")
        stack.callback(session.close)
        ours = Ours(session)
        stack.callback(ours.close)
        starts_s = []
        for number in range(STARTS):
            edge, took_s = first_command_s(policy, endpoint, ours)
            stack.callback(edge.end)
            starts_s.append(took_s)
            if number < STARTS - 1:
                edge.end()
        _tell(f"{STARTS} starts")
        words = (arguments.policy, endpoint, FLOOR, str(ours.reply_bytes))
        bare = stack.enter_context(Process("hil_tests.bench_floor", *words))
        bare.wait_for_line("ready")
        floor = Floor(session, len(ours.prepare()[1]))
        stack.callback(floor.close)
        for contender in (ours, floor):
            contender.rouse()
            for _ in range(WARM_UP):
                contender.ask()
        ours.end_block()
        latency = alternate(ours, floor, arguments.blocks, arguments.states)
        idle = idle_load(edge.pid, IDLE_S)
        memory = memory_mb(edge, ours, arguments.steps)
        ours.end_block()
        floor_memory = memory_mb(bare, floor, min(FLOOR_STEPS, arguments.steps))
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
        "state_bytes": len(wire.encode(make_state(0, session="", sent_ns=0, speed_mps=0.0))),
        "lockstep": drive,
    }


def _tell(done: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{done:<40}", end="", file=sys.stderr, flush=True)


class Contender:
    """Sends states to one process; ``arrivals`` holds when the answer to each step came."""

    def __init__(self, session: zenoh.Session, vehicle_id: str) -> None:
        self.arrivals: dict[int, float] = {}
        self.vehicle_id = vehicle_id
        generator = np.random.default_rng(0)
        self._pictures = [
            generator.integers(0, 256, wire.FRAMES_SHAPE, dtype=np.uint8).tobytes()
            for _ in range(PICTURES)
        ]
        self._step = 0
        self._publisher = session.declare_publisher(
            wire.key(vehicle_id, "state"), congestion_control=zenoh.CongestionControl.DROP
        )
        self._subscriber = session.declare_subscriber(
            wire.key(vehicle_id, "command"), self._on_command
        )

    def end_block(self) -> None:
        """After the last state of a block."""

    def prepare(self) -> tuple[int, bytes]:
        """The next step and its payload."""
        self._step += 1
        return self._step, self._payload(self._step, self._pictures[self._step % PICTURES])

    def put(self, payload: bytes) -> None:
        """Send it."""
        self._publisher.put(payload)

    def rouse(self) -> float:
        """Send states until the first answer, and say when that came (perf_counter).

        A process that is ready may not be known here yet.
        """
        self.arrivals.clear()

        def is_answered() -> bool:
            self.put(self.prepare()[1])
            time.sleep(_ROUSE_EVERY_S)
            return bool(self.arrivals)

        wait_until(is_answered, f"{self.vehicle_id} answers")
        return min(self.arrivals.values())

    def ask(self) -> float:
        """Send one state and wait for its answer: when it came (perf_counter); TimeoutError."""
        step, payload = self.prepare()
        self.put(payload)
        end_s = time.perf_counter() + _ANSWER_S
        while step not in self.arrivals:
            if time.perf_counter() > end_s:
                raise TimeoutError(f"{self.vehicle_id} does not answer step {step}")
            time.sleep(0.0001)
        return self.arrivals[step]

    def close(self) -> None:
        """Undeclare."""
        self._subscriber.undeclare()
        self._publisher.undeclare()

    def _on_command(self, sample: zenoh.Sample) -> None:
        arrived_s = time.perf_counter()
        self.arrivals.setdefault(self._step_of(bytes(sample.payload)), arrived_s)

    def _payload(self, step: int, frames: bytes) -> bytes:
        raise NotImplementedError

    def _step_of(self, payload: bytes) -> int:
        raise NotImplementedError


class Ours(Contender):
    """`edge_runtime run`: real states, real commands. A block is an episode."""

    def __init__(self, session: zenoh.Session) -> None:
        super().__init__(session, OURS)
        self.reply_bytes = 0
        self.modes: dict[str, int] = {}
        self._episode = 0

    def end_block(self) -> None:
        """A final state: it stands by while the other one works."""
        self._step += 1
        self.put(self._payload(self._step, self._pictures[0], final=True))
        self._episode += 1

    def _payload(self, step: int, frames: bytes, final: bool = False) -> bytes:
        state = wire.State(
            session="bench",
            episode=self._episode,
            step=step,
            sim_time_s=step * wire.CONTROL_PERIOD_S,
            sent_ns=time.time_ns(),
            frames=frames,
            speed_mps=3.0,
            final=final,
        )
        return wire.encode(state)

    def _step_of(self, payload: bytes) -> int:
        command = wire.decode_command(payload)
        assert isinstance(command, wire.Command), command
        self.reply_bytes = len(payload)
        self.modes[command.mode] = self.modes.get(command.mode, 0) + 1
        return command.step


class Floor(Contender):
    """The bare process: the step, the frames, and padding to the size of a state."""

    def __init__(self, session: zenoh.Session, state_bytes: int) -> None:
        super().__init__(session, FLOOR)
        self._padding = bytes(state_bytes - wire.FRAMES_BYTES - STEP_BYTES)

    def _payload(self, step: int, frames: bytes) -> bytes:
        return step.to_bytes(STEP_BYTES, "big") + frames + self._padding

    def _step_of(self, payload: bytes) -> int:
        return int.from_bytes(payload[:STEP_BYTES], "big")


def start_ours(policy: list[str], endpoint: str) -> Process:
    """The real edge runtime, not waited for."""
    arguments = [*policy, "--connect", endpoint, "--vehicle-id", OURS]
    return Process("edge_runtime", "run", *arguments)


def first_command_s(policy: list[str], endpoint: str, ours: Ours) -> tuple[Process, float]:
    """Start the edge runtime and send states until it answers: the process, and that time."""
    begun_s = time.perf_counter()
    process = start_ours(policy, endpoint)
    try:
        return process, ours.rouse() - begun_s
    except TimeoutError:
        process.kill()
        raise


def alternate(ours: Ours, floor: Floor, blocks: int, count: int) -> dict[str, Any]:
    """Blocks in turn, who begins a pair ends the next; one pair is not counted."""
    times: dict[str, list[np.ndarray]] = {OURS: [], FLOOR: []}
    for number in range(blocks + 1):
        order: list[Contender] = [ours, floor] if number % 2 else [floor, ours]
        for contender in order:
            block = block_ms(contender, count)
            if number:
                times[contender.vehicle_id].append(block)
        _tell(f"block {number} of {blocks}")
    mine, theirs = times[OURS], times[FLOOR]
    sent = blocks * count
    return {
        "period_ms": PERIOD_S * 1e3,
        "blocks": blocks,
        "states_per_block": count,
        "unanswered": {
            "ours": sent - sum(map(len, mine)),
            "floor": sent - sum(map(len, theirs)),
        },
        "latency_ms": compare(mine, theirs),
    }


def block_ms(contender: Contender, count: int) -> np.ndarray:
    """The latencies of a block's answers, ms; states without an answer are missing."""
    contender.arrivals.clear()
    sent: dict[int, float] = {}
    next_s = time.perf_counter()
    for _ in range(count):
        step, payload = contender.prepare()
        next_s = max(next_s + PERIOD_S, time.perf_counter())
        time.sleep(max(0.0, next_s - time.perf_counter()))
        sent[step] = time.perf_counter()
        contender.put(payload)
    time.sleep(_LAST_ANSWER_S)
    arrivals = dict(contender.arrivals)
    contender.end_block()
    return np.array([(arrivals[s] - at_s) * 1e3 for s, at_s in sent.items() if s in arrivals])


def compare(
    ours: Sequence[np.ndarray], floor: Sequence[np.ndarray], seed: int = 0
) -> dict[str, Any]:
    """For each quantile: ours, the floor's, their ratio over all blocks, and its 95 % interval.

    Blocks are resampled in pairs (bootstrap): neighbours in time share the machine's noise.

    Args:
        ours: the latencies of each block, any unit.
        floor: the floor's, block by block beside ours.
        seed: of the resampling.

    Raises:
        ValueError: no blocks, or not as many of the one as of the other.
    """
    if not ours or len(ours) != len(floor):
        raise ValueError(f"{len(ours)} blocks of ours beside {len(floor)} of the floor")

    def quantiles(blocks: Sequence[np.ndarray], draw: Sequence[int] | np.ndarray) -> np.ndarray:
        found = np.percentile(np.concatenate([blocks[index] for index in draw]), QUANTILES)
        return np.asarray(found)

    everything = range(len(ours))
    draws = np.random.default_rng(seed).integers(0, len(ours), (RESAMPLES, len(ours)))
    resampled = np.array([quantiles(ours, draw) / quantiles(floor, draw) for draw in draws])
    low, high = np.percentile(resampled, INTERVAL, axis=0)
    mine, theirs = quantiles(ours, everything), quantiles(floor, everything)
    return {
        f"p{quantile}": {
            "ours": float(mine[index]),
            "floor": float(theirs[index]),
            "ratio": float(mine[index] / theirs[index]),
            "interval": [float(low[index]), float(high[index])],
        }
        for index, quantile in enumerate(QUANTILES)
    }


def memory_mb(process: Process, contender: Contender, steps: int) -> dict[str, Any]:
    """Resident memory at the start and after each tenth of ``steps`` answers, one by one."""
    contender.arrivals.clear()
    samples, latencies_s = [process.resident_mb()], []
    for part in range(MEMORY_SAMPLES):
        for _ in range(steps // MEMORY_SAMPLES):
            sent_s = time.perf_counter()
            latencies_s.append(contender.ask() - sent_s)
        contender.arrivals.clear()
        samples.append(process.resident_mb())
        _tell(f"{(part + 1) * steps // MEMORY_SAMPLES:,} of {steps:,} steps")
    return {
        "steps": steps,
        "start": samples[0],
        "samples": [round(sample, 2) for sample in samples],
        "end": samples[-1],
        # The first tenth fills pools and windows; what comes after it must not grow.
        "grown_after_first_tenth": samples[-1] - samples[1],
        "answer_ms_p50": float(np.median(latencies_s)) * 1e3,
    }


def idle_load(pid: int, seconds: float) -> float:
    """The part of a core that the process uses while nobody sends anything."""
    begin, begun_s = _cpu_s(pid), time.perf_counter()
    time.sleep(seconds)
    return (_cpu_s(pid) - begin) / (time.perf_counter() - begun_s)


def _cpu_s(pid: int) -> float:
    # After the name, which may hold spaces: state is field 3, utime and stime 14 and 15.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def lockstep(policy: list[str], scenario: str, episodes: int, directory: Path) -> dict[str, Any]:
    """Drive ``episodes`` in lock-step; simulated seconds per wall second, without the start-up."""
    endpoint = free_endpoint()
    begun_s: list[float] = []
    ends: list[tuple[float, float]] = []

    def hear(sample: zenoh.Sample) -> None:
        seen_s = time.perf_counter()
        state = wire.decode_state(bytes(sample.payload))
        if isinstance(state, wire.State):
            begun_s[:] = begun_s or [seen_s]
            if state.final:
                ends.append((seen_s, state.sim_time_s))

    with ExitStack() as stack:
        simulator = stack.enter_context(
            Process(
                "bridge", "simulate", "--env", scenario, "--clock", "lockstep",
                "--listen", endpoint, "--vehicle-id", OURS, "--episodes", str(episodes),
                "--out", str(directory / "lock.json"),
            )
        )  # fmt: skip
        session = open_session(connect=endpoint, mode="peer")
        stack.callback(session.close)
        subscriber = session.declare_subscriber(wire.key(OURS, "state"), hear)
        stack.callback(subscriber.undeclare)
        stack.enter_context(start_ours(policy, endpoint))
        status = simulator.wait(_LOCKSTEP_LIMIT_S)
    if status:
        raise RuntimeError(f"bridge simulate ended with status {status}: {simulator.lines[-3:]}")
    simulated_s, wall_s = sum(time_s for _, time_s in ends), ends[-1][0] - begun_s[0]
    return {
        "scenario": scenario,
        "episodes": episodes,
        "simulated_s": simulated_s,
        "wall_s": wall_s,
        "times_real_time": simulated_s / wall_s,
    }


class Line(NamedTuple):
    """One line of the table."""

    what: str
    ours: str
    floor: str = ""
    ratio: str = ""
    bar: str = ""


def show(report: Mapping[str, Any]) -> None:
    """Print the table."""
    machine = report["machine"]
    title = (
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load_before']:.1f} "
        f"before and {machine['load_after']:.1f} after"
    )
    table = Table(title=title, box=box.SIMPLE, title_justify="left")
    for name in Line._fields:
        table.add_column(name, justify="left" if name in ("what", "bar") else "right")
    for line in lines(report):
        table.add_row(*line)
    Console(markup=False, highlight=False, width=WIDTH).print(table)


def lines(report: Mapping[str, Any]) -> Iterator[Line]:
    """The lines of what was measured, with their bars."""
    for name, row in report["latency"]["latency_ms"].items():
        low, high = row["interval"]
        yield Line(
            f"state sent to command received, {name}, ms",
            f"{row['ours']:.3f}",
            f"{row['floor']:.3f}",
            f"{row['ratio']:.2f} [{low:.2f}, {high:.2f}]",
            _bar(f"≤ {RATIO_BAR:g} times", row["ratio"] <= RATIO_BAR),
        )
    process = report["process"]
    ours, floor = process["memory_mb"], process["floor_memory_mb"]
    yield Line("memory after start, MB", f"{ours['start']:.1f}", f"{floor['start']:.1f}")
    yield Line(
        f"memory after {ours['steps']:,} steps, MB",
        f"{ours['end']:.1f}",
        f"{floor['end']:.1f} ({floor['steps']:,})",
        bar=_bar(f"< {MEMORY_BAR_MB:g}", ours["end"] < MEMORY_BAR_MB),
    )
    grown_mb, floor_grown_mb = (each["grown_after_first_tenth"] for each in (ours, floor))
    yield Line(
        "  growth after the first tenth, MB",
        f"{grown_mb:.2f}",
        f"{floor_grown_mb:.2f}",
        bar=_bar(f"< {FLAT_BAR_MB:g}", grown_mb < FLAT_BAR_MB),
    )
    idle, starts = process["idle_load"], process["first_command_s"]
    yield Line(
        "idle, part of a core", f"{idle:.2%}", bar=_bar(f"< {IDLE_BAR:.0%}", idle < IDLE_BAR)
    )
    yield Line(
        f"process start to first command, s (median of {starts['starts']})",
        f"{starts['median']:.2f}",
        bar=_bar(f"< {START_BAR_S:g}", starts["median"] < START_BAR_S),
    )
    times = report["lockstep"]["times_real_time"]
    yield Line(
        f"lock-step, {report['lockstep']['scenario']}: times real time",
        f"{times:.1f}",
        bar=_bar(f"≥ {LOCKSTEP_BAR:g}", times >= LOCKSTEP_BAR),
    )


def _bar(bar: str, met: bool) -> str:
    return f"{bar}  {'met' if met else 'MISSED'}"
