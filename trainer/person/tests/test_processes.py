"""A page takes over in a real training process, and nothing that it did is lost."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from edge_runtime.util import UserError
from hil_tests.processes import wait_until
from trainer.evaluation import CHECKPOINT_FILE
from trainer.person import vector
from trainer.person.recording import DIRECTORY, RecordedStep, read_steps, sittings
from trainer.person.tests.browser import address, page, say
from trainer.person.tests.people import LET_GO, Puppet
from trainer.util import load_torch

SOON_S = 60.0
TRAIN = [
    "train", "--human", "web", "--threads", "1", "--set", "batch_size=4",
    "--set", "evaluate_every_steps=0", "--out",
]  # fmt: skip
"""With a learner that leaves the processor to the others."""


def wait_for_step(run_dir: Path, wanted: Callable[[RecordedStep], bool]) -> None:
    wait_until(lambda: any(map(wanted, newest_sitting(run_dir))), "such a step", SOON_S, 0.3)


def newest_sitting(run_dir: Path) -> list[RecordedStep]:
    there = sittings(run_dir / DIRECTORY)
    with suppress(UserError):  # one that has just begun is an empty file
        return list(read_steps(there[-1])) if there else []
    return []


def all_in_replay(run_dir: Path) -> list[RecordedStep]:
    """All recorded steps; the saved replay buffer holds each with its mask and its action."""
    replay: dict[str, Any] = load_torch(run_dir / CHECKPOINT_FILE)["learning"]["replay"]
    steps = [step for path in sittings(run_dir / DIRECTORY) for step in read_steps(path)]
    assert replay["human"].tolist() == [step.human for step in steps]
    actions = np.array([step.action for step in steps], np.float32)
    np.testing.assert_array_equal(replay["actions"].numpy()[:, 0], actions)
    return steps


def first_of_the_persons(steps: Sequence[RecordedStep]) -> int:
    """The index of the step that begins the only intervention."""
    (index,) = (index for index, step in enumerate(steps) if step.first)
    assert not any(step.human for step in steps[:index])
    assert steps[index].action != steps[index].policy_action
    return index


@asynccontextmanager
async def at_the_wheel(process):
    """A page whose wheel is where the list says, and which speaks as often as a page does."""
    url, places = address(process), [0.0]

    async def speak(link):
        while True:
            await say(link, action=places[-1], by_moving=True)
            await asyncio.sleep(0.05)

    async with page(SimpleNamespace(url=url, port=urlsplit(url).port)) as link:
        speaking = asyncio.create_task(speak(link))
        yield places
        speaking.cancel()


def until_terminated():
    yield from [LET_GO] * 3
    signal.raise_signal(signal.SIGTERM)


async def test_a_wheel_takes_over_at_once_and_a_kill_loses_no_intervention(tmp_path, sit_down):
    run_dir = tmp_path / "run"
    words = [sys.executable, "-m", "trainer", *TRAIN, str(run_dir)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        async with at_the_wheel(process) as places:
            await asyncio.to_thread(wait_for_step, run_dir, lambda step: step.step >= 2)
            began_ns = time.time_ns()
            places.append(-1.0)
            await asyncio.to_thread(
                wait_for_step, run_dir, lambda step: step.human and vector(step.action)[0] < -0.99
            )
    finally:
        process.kill()
        process.communicate()
    killed = newest_sitting(run_dir)
    assert killed[first_of_the_persons(killed)].time_ns >= began_ns

    # Which is quitting, too.
    status, _, errors = sit_down(Puppet(until_terminated()), *TRAIN, str(run_dir), "--resume")
    assert status == 0, errors
    human = sum(step.human for step in killed)
    assert f"{len(killed)} recorded steps after the checkpoint, {human} of them yours" in errors
    assert len(all_in_replay(run_dir)) > len(killed)
