"""Drives that are recorded, recordings written by hand, and damage to recordings."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from bridge.__main__ import main
from bridge.environments import describe, make_environment
from bridge.fork import ForkedDrive, RecordedEpisode
from bridge.messages import Heard, Origin
from bridge.recording import RecordingWriter, whole_recording
from bridge.report import EpisodeResult
from edge_runtime.policy import load_policy
from edge_runtime.reach import free_endpoint
from edge_runtime.wire import Health, encode
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared.commands import exit_status
from hil_tests.tests.shared.drives import start_edge, start_simulate
from hil_tests.tests.shared.messages import HEALTH, make_command, make_state

EPOCH_NS = 1_700_000_000 * 10**9
ANSWER_S, INFERENCE_S = 0.002, 0.001
SILENCE = {"mode": "safe_stop", "reason": "no_fresh_state", "action": [-1.0]}


def ns(seconds: float) -> int:
    """Return a stamp so many seconds after a recording's beginning."""
    return EPOCH_NS + round(seconds * 1e9)


def bridge_status(arguments: list[str]) -> int:
    return exit_status(main, arguments)


def wait_until_driving_steadily(edge: Process, steady_s: float = 0.4) -> None:
    """Wait until the edge runtime has driven that long without a stop."""

    def steady() -> bool:
        before = edge.errors
        if not before.rpartition("now=")[2].startswith("drive"):
            return False
        time.sleep(steady_s)
        return edge.errors == before

    wait_until(steady, "a steady drive")


def start_record(endpoint: str, path: Path, *options: str) -> Process:
    """Start ``python -m bridge record``, and wait until there is a recording."""
    run = Process("bridge", "record", "--out", str(path), "--connect", endpoint, *options)
    # A file is made before its first bytes are in it.
    wait_until(lambda: path.exists() and path.stat().st_size > 0, "the recording to begin", 100.0)
    return run


def record_drive(
    folder: Path, env: str, policy: Path, *options: str, view: Path | None = None, **more: Any
) -> Path:
    """Record a drive of the three processes, with its report in ``report.json`` beside it.

    ``view``: the file of a view that watches it as well.
    """
    endpoint, path = free_endpoint(), folder / "drive.mcap"
    there = ("--connect", endpoint, "--wait-s", "100")
    with contextlib.ExitStack() as stack:
        words = ("--wait-edge-s", "100", *options)
        run = start_simulate(endpoint, folder / "report.json", env, *words, **more)
        simulator = stack.enter_context(run)
        watching = []
        if view is not None:
            viewer = Process("bridge", "view", "--save", str(view), *there)
            watching.append(stack.enter_context(viewer))
            wait_until(lambda: list(view.parent.glob(f".{view.name}*")), "the view to begin")
        recorder = start_record(endpoint, path, "--wait-s", "100", "--linger-s", "0.5")
        watching.append(stack.enter_context(recorder))
        stack.enter_context(start_edge(endpoint, policy))
        simulator.succeed(200.0)
        for process in watching:
            process.succeed()
    return path


def rerun(*arguments: str) -> str:
    command = [sys.executable, "-m", "rerun_cli", *arguments]
    return subprocess.run(command, check=True, capture_output=True, timeout=60, text=True).stdout


def verify_view(recording: Path) -> str:
    rerun("rrd", "verify", str(recording))
    return rerun("rrd", "stats", str(recording))


def chunks(path: Path) -> list[ChunkIndex]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def flip(path: Path, at: int, count: int = 4) -> None:
    data = bytearray(path.read_bytes())
    data[at : at + count] = bytes(byte ^ 0xFF for byte in data[at : at + count])
    path.write_bytes(data)


def flip_chunk(path: Path, number: int) -> None:
    """Damage what the chunk holds, so that its checksum is wrong."""
    index = chunks(path)[number]
    flip(path, index.chunk_start_offset + index.chunk_length // 2)


def health(
    sent_ns: int, uptime_s: float, vehicle: str = "none", needs_rearm: bool = False, **rejected: int
) -> Health:
    """Make a health message with counts of rejected states."""
    what: dict[str, Any] = {"vehicle": vehicle, "needs_rearm": needs_rearm, "rejected": rejected}
    return msgspec.structs.replace(HEALTH, sent_ns=sent_ns, uptime_s=uptime_s, **what)


def heard(topic: str, payload: bytes, arrived_ns: int = 1) -> Heard:
    """Return a message of the vehicle v as a listener gets it."""
    return Heard(f"phil/v/{topic}", topic, payload, arrived_ns, len(payload))


def record_in_process(
    path: Path, env: str, policy: Path, seed: int, latency: str, condition: str = "nominal"
) -> EpisodeResult:
    """Record a drive in lock-step as the processes would, without them."""
    origin = Origin(
        session="s", environment=env, condition=condition, seed=seed, standing=False,
        clock="lockstep", loop="policy", latency=latency,
    )  # fmt: skip
    environment = make_environment(env, condition)
    nothing = RecordedEpisode(path, "v", 0, origin, describe(environment), began_ns=0)
    with whole_recording(path) as out:
        loaded = load_policy(policy, allow_unsigned=True)
        return ForkedDrive(nothing, environment, 0, loaded, out=out).run()


class Hand:
    """Writes a recording message by message; times in seconds since its beginning."""

    def __init__(self, path: Path, edge_clock_s: float = 0.0) -> None:
        self.path, self.writer = path, RecordingWriter(path)
        self.edge_clock_s, self.closed = edge_clock_s, False

    def hear(self, at_s: float, topic: str, message: Any, vehicle_id: str = "v") -> None:
        payload = encode(message)
        key = f"phil/{vehicle_id}/{topic}"
        self.writer.write(Heard(key, topic, payload, ns(at_s), len(payload)))

    def hear_health(self, at_s: float, uptime_s: float, **changes: Any) -> None:
        self.hear(at_s, "health", health(ns(at_s), uptime_s, **changes))

    def state(self, at_s: float, step: int, **changes: Any) -> None:
        fields = {"session": "here", "sent_ns": ns(at_s), **changes}
        self.hear(at_s, "state", make_state(step, **fields))

    def command(self, at_s: float, step: int, answer_s: float = ANSWER_S, **changes: Any) -> None:
        stamps = {
            "received_ns": ns(at_s - answer_s + self.edge_clock_s),
            "sent_ns": ns(at_s + self.edge_clock_s),
            "inference_ns": round(INFERENCE_S * 1e9),
            "action": [0.3],
        }
        self.hear(at_s, "command", make_command(step, **{**stamps, **changes}))

    def drive(self, first: int, last: int, start_s: float = 0.0, **changes: Any) -> None:
        """Write states at every T, each answered, with ``drive`` unless ``changes`` differ."""
        for step in range(first, last):
            at_s = start_s + step * 0.1
            self.state(at_s, step, episode=changes.get("episode", 0))
            self.command(at_s + ANSWER_S, step, **changes)

    def stop(self, step: int, count: int) -> None:
        """Write the watchdog's stop 2 T after the state at ``step`` * T, and its repetitions."""
        for repetition in range(count):
            late_s = 0.2001 + repetition * 0.1
            self.command(step * 0.1 + late_s, step, answer_s=late_s, inference_ns=0, **SILENCE)

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.writer.finish()
            self.writer.close()
