"""Real ``python -m trainer`` processes with a person's devices, and what they leave behind."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trainer.drivers import CHECKPOINT_FILE
from trainer.files import load_torch
from trainer.person.recording import DIRECTORY, Step, read_steps, sittings
from trainer.person.takeover import MAX_SLEW

SOON_S = 60.0
SMALL = ["--threads", "1", "--set", "batch_size=4", "--set", "evaluate_every_steps=0"]
"""A learner that leaves the processor to the others."""


class Training:
    """A ``trainer train`` with a person in it.

    Args:
        run_dir: its directory.
        module: whose command line begins with the trainer's command.
        arguments: more of the command's.
        environment: more variables.
    """

    def __init__(
        self, run_dir: Path, module: str, arguments: Sequence[str], environment: dict[str, str]
    ) -> None:
        self.run_dir = run_dir
        command = [sys.executable, "-m", module, "train", "--out", str(run_dir)]
        self.process = subprocess.Popen(
            [*command, *SMALL, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment},
        )

    def __enter__(self) -> Training:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def tell(self, line: str) -> int:
        """Have the virtual wheel do something; when it was done, ns since 1970."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(line, file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        assert answer.startswith(f"did {line} "), answer
        return int(answer.split()[-1])

    def wait_for_step(self, wanted: Callable[[Step], bool]) -> Step:
        """The first step of the newest sitting that is as wanted."""
        end_s = time.monotonic() + SOON_S
        while time.monotonic() < end_s and self.process.poll() is None:
            for step in newest_sitting(self.run_dir):
                if wanted(step):
                    return step
            time.sleep(0.05)
        raise AssertionError(f"no such step: {self.process.poll()}")

    def end(self) -> tuple[int, str]:
        """Wait for its end: exit status, and stderr."""
        _, errors = self.process.communicate(timeout=SOON_S)
        return self.process.returncode, errors


def newest_sitting(run_dir: Path) -> list[Step]:
    """The steps of the sitting that is going on, or was last."""
    there = sittings(run_dir / DIRECTORY)
    return list(read_steps(there[-1])) if there else []


def all_steps(run_dir: Path) -> list[Step]:
    """The steps of all sittings."""
    return [step for path in sittings(run_dir / DIRECTORY) for step in read_steps(path)]


def assert_all_in_replay(run_dir: Path) -> None:
    """The saved replay buffer holds the recorded steps, each with its mask and its action."""
    replay: dict[str, Any] = load_torch(run_dir / CHECKPOINT_FILE)["learning"]["replay"]
    steps = all_steps(run_dir)
    assert replay["human"].tolist() == [step.human for step in steps]
    actions = np.array([step.action for step in steps], np.float32)
    np.testing.assert_array_equal(replay["actions"].numpy()[:, 0], actions)
    assert replay["terminals"].tolist() == [float(step.terminated) for step in steps]


def assert_taken_over_at_once(steps: Sequence[Step], began_ns: int, done_ns: int) -> None:
    """The first control period that asked the hands after ``done_ns`` is already the person's.

    One between ``began_ns`` and ``done_ns`` may be: a key is down before who presses it says so.
    """
    taken = next(number for number, step in enumerate(steps) if step.human)
    before, after = steps[:taken], steps[taken:]
    assert before
    assert after[0].time_ns >= began_ns
    assert before[-1].time_ns < done_ns
    assert after[0].first
    assert after[0].action != after[0].policy_action
    # It has moved from what was applied before towards what the person wants, as far as it may.
    together = before[-1].episode == after[0].episode
    last = before[-1].action if together else after[0].policy_action
    wanted = after[0].human_action
    assert last is not None
    assert after[0].action == last + min(max(wanted - last, -MAX_SLEW), MAX_SLEW)
