"""``python -m hil_tests.recordings.make``: drive, record, check by replay, and keep.

The recording holds four left turns in lock-step and one in real time whose simulator is stopped
for half a second: the edge runtime must go into safe stop, and drive again after five states.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from bridge.recording import Recording
from edge_runtime.cli import ArgumentParser, examples, run_cli
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import UserError, read_bytes
from hil_tests.commands import BackgroundCommand, run_command

LEFT_TURN = Path("hil_tests/recordings/left_turn.mcap")
POLICY, PUBLIC_KEY = "results/policies/left_turn.onnx", "results/policies/policy.pub"
EPISODES = 4
MAX_BYTES = 300_000
DRIVEN_BEFORE_S = 2.0
STOPPED_S = 0.5
PATIENCE_S = 60.0


def main(argv: list[str]) -> int:
    """Make the recording anew; the old one stays where anything goes wrong."""
    parser = ArgumentParser(
        prog="python -m hil_tests.recordings.make",
        description=__doc__,
        epilog=examples("python -m hil_tests.recordings.make --out runs/left_turn.mcap"),
    )
    parser.add_argument("--policy", metavar="POLICY.onnx", default=POLICY, help="who drives")
    parser.add_argument(
        "--public-key", metavar="FILE", default=PUBLIC_KEY, help="Ed25519 public key, PEM"
    )
    parser.add_argument(
        "--out", metavar="F.mcap", type=Path, default=LEFT_TURN, help="where it is kept"
    )
    arguments = parser.parse_args(argv)
    check_writable(arguments.out)
    trust = ("--policy", arguments.policy, "--public-key", arguments.public_key)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "drive.mcap"
        _record(made, trust)
        run_command("bridge", "replay", str(made), *trust)
        data = read_bytes(made, "recording")
        if len(data) > MAX_BYTES:
            raise UserError(f"the recording has {len(data)} bytes, more than {MAX_BYTES}")
        write_atomic(arguments.out, data)
    print(f"wrote {arguments.out}: {len(data)} bytes")
    return 0


def _record(out: Path, trust: tuple[str, ...]) -> None:
    """The runtime starts last, so that the drive begins once the recorder listens."""
    endpoint = free_endpoint()
    common = ("simulate", "--env", "left_turn", "--listen", endpoint)
    first = _start("bridge", *common, "--episodes", str(EPISODES))
    wait = ("--wait-s", "30", "--linger-s", "30")
    recorder = _start("bridge", "record", "--out", str(out), "--connect", endpoint, *wait)
    try:
        _wait_for_simulators(out, 1)
        with BackgroundCommand("edge_runtime", "run", *trust, "--connect", endpoint, ready="ready"):
            _end(first)
            second = _start("bridge", *common, "--seed", str(EPISODES), "--clock", "realtime")
            _wait_for_simulators(out, 2)
            _stop_in_the_middle(second)
            _end(second)
    finally:
        recorder.terminate()
        _end(recorder)


def _start(*arguments: str) -> subprocess.Popen[Any]:
    return subprocess.Popen([sys.executable, "-m", *arguments], stdout=subprocess.DEVNULL)


def _end(process: subprocess.Popen[Any]) -> None:
    if process.wait(PATIENCE_S):
        raise UserError(f"{' '.join(map(str, process.args[1:4]))} failed")  # type: ignore[index]


def _wait_for_simulators(out: Path, count: int) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while not out.exists() or _simulators(out) < count:
        if time.monotonic() > give_up_s:
            raise UserError("the simulator did not come")
        time.sleep(0.1)


def _simulators(out: Path) -> int:
    """How many simulators have come so far."""
    return sum(
        stored.channel.topic.endswith("/simulator") and b"true" in stored.message.data
        for stored in Recording(out).messages()
    )


def _stop_in_the_middle(simulator: subprocess.Popen[Any]) -> None:
    time.sleep(DRIVEN_BEFORE_S)
    simulator.send_signal(signal.SIGSTOP)
    time.sleep(STOPPED_S)
    simulator.send_signal(signal.SIGCONT)


if __name__ == "__main__":
    sys.exit(run_cli(main))
