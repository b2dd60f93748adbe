"""The bridge's commands as processes, for the tests."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from bridge.__main__ import main
from bridge.environments import describe, make_environment
from bridge.fork import ForkedDrive, RecordedEpisode
from bridge.messages import Origin
from bridge.record import RecordingWriter
from bridge.report import EpisodeResult
from edge_runtime.policy import load_policy
from edge_runtime.reach import free_endpoint
from edge_runtime.wire import Feedback, State, decode_state
from hil_tests.testing.edge import (
    PATIENCE_S,
    CommandProcess,
    EdgeProcess,
    exit_status,
    wait_until,
)
from hil_tests.testing.policies import write_policy

TOY = "hil_tests.testing.environments:BridgeToy-v0"
SHORT_TOY = "hil_tests.testing.environments:BridgeToyShort-v0"
SLOW_TOY = "hil_tests.testing.environments:BridgeToySlow-v0"


BridgeProcess = partial(CommandProcess, "bridge")


def start_edge(endpoint, policy, *options, stderr=subprocess.PIPE) -> EdgeProcess:
    """Start ``python -m edge_runtime run`` with an unsigned test policy and wait until ready."""
    fixed = ("--policy", str(policy), "--connect", endpoint, "--allow-unsigned")
    return EdgeProcess(*fixed, *options, stderr=stderr)


def bridge_status(arguments: list[str]) -> int:
    return exit_status(main, arguments)


def wait_until_driving(edge: EdgeProcess) -> None:
    wait_until(lambda: "now=drive" in edge.process.stderr.readline(), "the first drive")


def wait_until_driving_steadily(log: Path, steady_s: float = 0.4) -> None:
    """Wait until the edge runtime, whose stderr is ``log``, has driven that long without a stop."""

    def steady() -> bool:
        before = log.read_text()
        if not before.rpartition("now=")[2].startswith("drive"):
            return False
        time.sleep(steady_s)
        return log.read_text() == before

    wait_until(steady, "a steady drive")


def refused(run: CommandProcess, out: Path, *parts: str) -> None:
    """Assert that it ends with status 2 and one line, which holds the parts, and writes nothing."""
    assert run.wait() == 2
    (line,) = run.errors.splitlines()
    assert all(part in line for part in parts), line
    assert not out.exists()


def make_policy(folder: Path, kind: str = "mean", value: float = 0.3) -> Path:
    path = folder / f"{kind}{value:g}.onnx"
    write_policy(path, kind, value)
    return path


def start_simulate(endpoint, out, env, *options, **more) -> CommandProcess:
    fixed = ["simulate", "--env", env, "--listen", endpoint, "--out", str(out)]
    return BridgeProcess(*fixed, *options, **more)


def start_record(endpoint: str, path: Path, *options: str) -> CommandProcess:
    """Start ``python -m bridge record``, and wait until there is a recording."""
    run = BridgeProcess("record", "--out", str(path), "--connect", endpoint, *options)
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
def writing(path: Path, dropped: int = 0) -> Iterator[RecordingWriter]:
    with contextlib.closing(RecordingWriter(path)) as writer:
        yield writer
        writer.finish(dropped)


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


def simulate(folder: Path, endpoint: str, env: str, options: Sequence[str]) -> dict[str, Any]:
    out = folder / f"report-{time.monotonic_ns()}.json"
    with start_simulate(endpoint, out, env, *options) as run:
        assert run.wait(PATIENCE_S * 3) == 0, run.errors
    return read(out)


def simulate_undisturbed(folder, endpoint, env, options, attempts=4) -> dict[str, Any]:
    """Run ``simulate`` again where the machine itself stood still for over 2 T in the middle."""
    for _ in range(attempts):
        report = simulate(folder, endpoint, env, options)
        reasons = {event["reason"] for event in report["safe_stop_events"]}
        if report["clock"] == "lockstep" and not report["wall_clock_stalls"]:
            return report
        if report["clock"] == "realtime" and reasons <= {"no_command"}:  # an injected one's reason
            return report
    raise AssertionError(f"disturbed {attempts} times: {report['safe_stop_events']}")


def drive_in_process(policy_path: Path, seed: int) -> tuple[str, np.ndarray]:
    policy = load_policy(str(policy_path), allow_unsigned=True)
    environment = gymnasium.make(TOY)
    seen, info = environment.reset(seed=seed)
    actions, ended = [], False
    while not ended:
        actions.append(policy.act({"frames": seen}))
        seen, _, terminated, truncated, info = environment.step(actions[-1])
        ended = terminated or truncated
    return info["outcome"], np.array(actions)


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def rerun(*arguments: str) -> str:
    command = [sys.executable, "-m", "rerun_cli", *arguments]
    return subprocess.run(command, check=True, capture_output=True, timeout=60, text=True).stdout


def make_feedback(step: int, **changes: Any) -> Feedback:
    """Make a valid feedback of a vehicle that obeys ``make_command(step)``, stamped at its tick."""
    fields: dict[str, Any] = {
        "vehicle": "robot", "session": "here", "episode": 0, "step": step, "mode": "drive",
        "action": [0.5], "speed_mps": 1.0, "self_braking": False, "faults": [],
        "sent_ns": 1_000_000_000 + step * 100_000_000,
    }  # fmt: skip
    return Feedback(**{**fields, **changes})


def decoded(payload: bytes) -> State:
    state = decode_state(payload)
    assert isinstance(state, State)
    return state


LEFT_TURN = Path(__file__).parents[2] / "hil_tests" / "recordings" / "left_turn.mcap"


def chunks(path: Path) -> list[ChunkIndex]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def messages_of(path: Path, chunk: ChunkIndex) -> int:
    """How many messages a chunk of an undamaged file holds."""
    with path.open("rb") as stream:
        stream.seek(chunk.chunk_start_offset)
        record = next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
    assert isinstance(record, Chunk)
    return sum(isinstance(part, Message) for part in breakup_chunk(record, True))


def flip(path: Path, at: int, count: int = 4) -> None:
    data = bytearray(path.read_bytes())
    data[at : at + count] = bytes(byte ^ 0xFF for byte in data[at : at + count])
    path.write_bytes(data)


def flip_chunk(path: Path, number: int) -> None:
    """Damage what the chunk holds, so that its checksum is wrong."""
    index = chunks(path)[number]
    flip(path, index.chunk_start_offset + index.chunk_length // 2)
