"""A person's training run killed again and again: what is lost, and whether all else comes back.

``python -m trainer.benches.killed_sitting --minutes 30 --out results/person/killed.json`` drives so
many simulated minutes in accelerated time, kills the process with SIGKILL at random moments, goes
on with ``--resume``, and at the end compares what the eyes saw, what the recordings hold, and what
is in the replay buffer.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge_runtime.cli import ArgumentParser, examples, run_cli, write_json_out
from edge_runtime.errors import UserError
from edge_runtime.files import check_writable
from edge_runtime.option_types import not_negative, positive, positive_number
from trainer.benches.scripted_person import NOTE, last_seen
from trainer.drivers import CHECKPOINT_FILE
from trainer.person.recording import DIRECTORY, Step, read_steps, sittings
from trainer.util import about, load_torch

CONTROL_PERIOD_S = 0.1
PATIENCE_S = 120.0


@dataclass(frozen=True)
class Kill:
    """One killed process."""

    after_s: float
    """From its first step on, wall time."""
    recorded: int
    """Steps of this sitting that the recording holds."""
    lost: int
    """Steps that the eyes saw taken, and the recording does not hold."""
    lost_s: float
    """Wall time between the recording's last step and the kill."""


class KilledRun:
    """A training run in a directory, driven by processes that are killed.

    Args:
        directory: an empty one.
        speed: simulated seconds in one of the wall's.
        batch_size: the learner's: a small one leaves the time to the driving.
    """

    def __init__(self, directory: Path, speed: float, batch_size: int) -> None:
        self.run_dir, self.seen = directory / "run", directory / "seen"
        self.speed, self.batch_size = speed, batch_size

    def start(self, episodes: int) -> subprocess.Popen[bytes]:
        """Begin or resume, and wait for the first step."""
        self.seen.write_bytes(bytes(NOTE.size))
        resume = ["--resume"] if (self.run_dir / CHECKPOINT_FILE).is_file() else []
        command = [sys.executable, "-m", "trainer.benches.scripted_person", str(self.seen)]
        command += ["train", "--human", "scripted", "--speed", f"{self.speed}", *resume]
        command += ["--set", f"batch_size={self.batch_size}", "--set", "evaluate_every_steps=0"]
        command += ["--episodes", str(episodes), "--out", str(self.run_dir), "--threads", "1"]
        return subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)

    def kill(self, process: subprocess.Popen[bytes], after_s: float) -> Kill:
        """Kill it so long after its first step; what that cost."""
        try:
            self.wait_for_first_step(process)
            time.sleep(after_s)
        finally:
            process.kill()
            killed_ns = time.time_ns()
            process.wait()
        recorded = list(read_steps(sittings(self.run_dir / DIRECTORY)[-1]))
        episode, taken = last_seen(self.seen)
        kept = sum(step.episode == episode for step in recorded)
        lost_s = (killed_ns - recorded[-1].time_ns) * 1e-9
        return Kill(after_s, len(recorded), max(taken - kept, 0), lost_s)

    def end(self, process: subprocess.Popen[bytes]) -> None:
        """End it well after its first step; UserError if that does not happen."""
        try:
            self.wait_for_first_step(process)
            process.terminate()
            if process.wait(timeout=PATIENCE_S) != 0:
                raise UserError("the training did not end well on SIGTERM")
        finally:
            process.kill()

    def steps(self) -> list[Step]:
        """All that was recorded, in its order."""
        return [step for path in sittings(self.run_dir / DIRECTORY) for step in read_steps(path)]

    def missing(self) -> int:
        """How many of the recorded steps the replay buffer does not hold as they are recorded."""
        state = load_torch(self.run_dir / CHECKPOINT_FILE)["learning"]["replay"]
        steps = self.steps()
        count = min(len(steps), len(state["human"]))
        human = np.array([step.human for step in steps[:count]])
        actions = np.array([step.action for step in steps[:count]], np.float32)
        stored_human = state["human"].numpy()[:count]
        stored_actions = state["actions"].numpy()[:count, 0]
        wrong = int(((human != stored_human) | (actions != stored_actions)).sum())
        return wrong + len(steps) - count

    def wait_for_first_step(self, process: subprocess.Popen[bytes]) -> None:
        """Wait until the person has seen a step taken; UserError if that does not happen."""
        end_s = time.monotonic() + PATIENCE_S
        while last_seen(self.seen)[1] == 0:
            if process.poll() is not None or time.monotonic() > end_s:
                raise UserError("the training did not begin to drive")
            time.sleep(0.01)


def measure(run: KilledRun, minutes: float, longest_s: float, seed: int) -> dict[str, Any]:
    """Kill until so many simulated minutes are recorded, then end well and compare."""
    draw, kills = random.Random(seed), list[Kill]()
    while len(run.steps()) * CONTROL_PERIOD_S < 60.0 * minutes:
        kills.append(run.kill(run.start(episodes=100000), draw.uniform(0.1, longest_s)))
        print(f"killed after {kills[-1].after_s:.1f} s: {kills[-1]}", file=sys.stderr, flush=True)
    run.end(run.start(episodes=100000))
    steps = run.steps()
    return {
        **about(),
        "simulated_minutes": len(steps) * CONTROL_PERIOD_S / 60.0,
        "steps": len(steps),
        "human_steps": sum(step.human for step in steps),
        "interventions": sum(step.first for step in steps),
        "bytes": sum(path.stat().st_size for path in sittings(run.run_dir / DIRECTORY)),
        "kills": [asdict(kill) for kill in kills],
        "most_lost_steps": max(kill.lost for kill in kills),
        "most_lost_s": max(kill.lost_s for kill in kills),
        "missing_in_replay": run.missing(),
    }


def main(argv: list[str]) -> int:
    """Measure and report; exit status 1 where more than the last second was lost."""
    parser = ArgumentParser(
        prog="python -m trainer.benches.killed_sitting",
        description=(__doc__ or "").split("\n\n")[0],
        epilog=examples("python -m trainer.benches.killed_sitting --minutes 5 --out killed.json"),
    )
    _add_arguments(parser)
    arguments = parser.parse_args(argv)
    if arguments.out is not None:
        check_writable(arguments.out)
    with tempfile.TemporaryDirectory() as directory:
        run = KilledRun(Path(directory), arguments.speed, arguments.batch_size)
        result = measure(run, arguments.minutes, arguments.longest, arguments.seed)
    write_json_out(arguments.out, result)
    print(
        f"{result['simulated_minutes']:.1f} minutes, {len(result['kills'])} kills: at most "
        f"{result['most_lost_steps']} steps, {result['most_lost_s']:.2f} s lost; "
        f"{result['missing_in_replay']} of {result['steps']} steps not in the replay buffer"
    )
    return int(result["most_lost_s"] > 1.0 or result["missing_in_replay"] > 0)


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=positive_number, default=30.0, help="simulated, in all")
    parser.add_argument("--speed", type=positive_number, default=10.0, help="times real time")
    parser.add_argument("--batch-size", type=positive, default=8, help="of the learner")
    parser.add_argument("--longest", type=positive_number, default=40.0, help="s until a kill")
    parser.add_argument("--seed", type=not_negative, default=0, help="of the moments")
    parser.add_argument("--out", metavar="F.json", help="the figures")


if __name__ == "__main__":
    sys.exit(run_cli(main))
