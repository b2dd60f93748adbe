"""Simulators and recorders as processes, recordings in process, and damage to recordings."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import ChunkIndex

from bridge.__main__ import main
from bridge.environments import describe, make_environment
from bridge.fork import ForkedDrive, RecordedEpisode
from bridge.messages import Origin
from bridge.recording import RecordingWriter
from bridge.report import EpisodeResult
from edge_runtime.policy import load_policy
from edge_runtime.reach import free_endpoint
from hil_tests.processes import Process, wait_until
from hil_tests.testing.commands import exit_status
from hil_tests.testing.edge import start_edge
from hil_tests.testing.policies import write_policy

TOY = "hil_tests.testing.environments:BridgeToy-v0"
SHORT_TOY = "hil_tests.testing.environments:BridgeToyShort-v0"
SLOW_TOY = "hil_tests.testing.environments:BridgeToySlow-v0"


LEFT_TURN = Path(__file__).parents[1] / "recordings" / "left_turn.mcap"


def bridge_status(arguments: list[str]) -> int:
    return exit_status(main, arguments)


def make_policy(folder: Path, kind: str = "mean", value: float = 0.3) -> Path:
    """Write an unsigned policy file."""
    path = folder / f"{kind}{value:g}.onnx"
    write_policy(path, kind, value)
    return path


def start_simulate(endpoint, out, env, *options, **more) -> Process:
    fixed = ["simulate", "--env", env, "--listen", endpoint, "--out", str(out)]
    return Process("bridge", *fixed, *options, **more)


def start_record(endpoint: str, path: Path, *options: str) -> Process:
    """Start ``python -m bridge record``, and wait until there is a recording."""
    run = Process("bridge", "record", "--out", str(path), "--connect", endpoint, *options)
    # A file is made before its first bytes are in it.
    wait_until(lambda: path.exists() and path.stat().st_size > 0, "the recording to begin", 100.0)
    return run


def record_drive(
    folder: Path, env: str, policy: Path, *options: str, edge: Sequence[str] = (), **more: Any
) -> Path:
    """Record a drive of the three processes; its report is ``report.json`` beside it."""
    endpoint, path = free_endpoint(), folder / "drive.mcap"
    simulating = ("--wait-edge-s", "100", *options)
    with (
        start_simulate(endpoint, folder / "report.json", env, *simulating, **more) as simulator,
        start_record(endpoint, path, "--wait-s", "100", "--linger-s", "0.5") as recorder,
        start_edge(endpoint, policy, *edge),
    ):
        assert simulator.wait(200.0) == 0, simulator.errors
        assert recorder.wait() == 0, recorder.errors
    return path


@contextlib.contextmanager
def writing(path: Path) -> Iterator[RecordingWriter]:
    with contextlib.closing(RecordingWriter(path)) as writer:
        yield writer
        writer.finish()


def record_in_process(
    path: Path, env: str, policy: Path, seed: int, latency: str, condition: str = "nominal"
) -> EpisodeResult:
    """Record a drive in lock-step as the processes would, without them."""
    origin = Origin(
        session="s", environment=env, condition=condition, seed=seed, standing=False,
        clock="lockstep", loop="policy", latency=latency,
    )  # fmt: skip
    environment = make_environment(env, condition)
    nothing = RecordedEpisode(path, "v", 0, origin, 0, describe(environment), began_ns=0)
    with writing(path) as out:
        loaded = load_policy(policy, allow_unsigned=True)
        return ForkedDrive(nothing, environment, 0, loaded, out=out).run()


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def rerun(*arguments: str) -> str:
    command = [sys.executable, "-m", "rerun_cli", *arguments]
    return subprocess.run(command, check=True, capture_output=True, timeout=60, text=True).stdout


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
