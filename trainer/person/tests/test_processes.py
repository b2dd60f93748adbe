"""Real key events, through an X server, take over in a real training process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_runtime.util import UserError
from trainer.drivers import CHECKPOINT_FILE
from trainer.person.interface import vector
from trainer.person.recording import DIRECTORY, Step, read_steps, sittings
from trainer.person.takeover import MAX_SLEW
from trainer.person.tests.browser import (
    PERSON_DRIVES,
    POLICY_DRIVES,
    address,
    open_browser,
    quit_sitting,
    until,
)
from trainer.person.tests.virtual_wheel import load_sdl
from trainer.util import load_torch

SOON_S = 60.0
SMALL = ["--threads", "1", "--set", "batch_size=4", "--set", "evaluate_every_steps=0"]
"""A learner that leaves the processor to the others."""


class Training:
    """A ``trainer train`` with a person in it, by a module that has the trainer's command line."""

    def __init__(self, run_dir: Path, *more: str, module: str = "trainer", **environment: str):
        self.run_dir = run_dir
        command = [sys.executable, "-m", module, "train", "--out", str(run_dir), *SMALL, *more]
        pipes: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen(
            command, **pipes, text=True, env={**os.environ, **environment}
        )

    def close(self) -> None:
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
        end_s = time.monotonic() + SOON_S
        while time.monotonic() < end_s and self.process.poll() is None:
            for step in newest_sitting(self.run_dir):
                if wanted(step):
                    return step
            time.sleep(0.05)
        raise AssertionError(f"no such step: {self.process.poll()}")

    def end(self) -> tuple[int, str]:
        _, errors = self.process.communicate(timeout=SOON_S)
        return self.process.returncode, errors


def newest_sitting(run_dir: Path) -> list[Step]:
    there = sittings(run_dir / DIRECTORY)
    with suppress(UserError):  # one that has just begun is an empty file
        return list(read_steps(there[-1])) if there else []
    return []


def all_in_replay(run_dir: Path) -> list[Step]:
    """All recorded steps; the saved replay buffer holds each with its mask and its action."""
    replay: dict[str, Any] = load_torch(run_dir / CHECKPOINT_FILE)["learning"]["replay"]
    steps = [step for path in sittings(run_dir / DIRECTORY) for step in read_steps(path)]
    assert replay["human"].tolist() == [step.human for step in steps]
    actions = np.array([step.action for step in steps], np.float32)
    np.testing.assert_array_equal(replay["actions"].numpy()[:, 0], actions)
    assert replay["terminals"].tolist() == [float(step.terminated) for step in steps]
    return steps


def first_of_the_persons(steps: Sequence[Step]) -> int:
    """The index of the step that begins the only intervention; it moves as far as it may."""
    (index,) = (index for index, step in enumerate(steps) if step.first)
    taken, last = steps[index], steps[index].policy_action
    assert not any(step.human for step in steps[:index])
    if taken.step:
        last = steps[index - 1].action
    assert isinstance(last, float)
    assert isinstance(taken.human_action, float)
    assert taken.action == last + min(max(taken.human_action - last, -MAX_SLEW), MAX_SLEW)
    assert taken.action != taken.policy_action
    return index


def assert_taken_over_at_once(steps: Sequence[Step], began_ns: int, done_ns: int) -> None:
    """The first control period that asked the hands after ``done_ns`` is already the person's; an
    earlier one may be: a key is down before the press is confirmed."""
    taken = first_of_the_persons(steps)
    assert steps[taken].time_ns >= began_ns
    assert steps[taken - 1].time_ns < done_ns


@pytest.fixture
def display():
    for program in ("Xvfb", "xdotool"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed (Debian packages xvfb and xdotool)")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x800x24", "-nolisten", "tcp"],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with os.fdopen(read) as pipe:
        number = pipe.readline().strip()
    yield {"DISPLAY": f":{number}", "SDL_VIDEODRIVER": "x11"}
    server.terminate()
    server.wait()


def xdotool(display, *words) -> int:
    """Do something as a person would; when it was done, ns since 1970."""
    subprocess.run(["xdotool", *words], env={**os.environ, **display}, check=True, timeout=30)
    return time.time_ns()


def test_a_key_takes_over_at_once_and_everything_is_kept(tmp_path, display):
    with closing(Training(tmp_path / "run", "--human", "keyboard", **display)) as training:
        training.wait_for_step(lambda step: step.step >= 2)
        began_ns = time.time_ns()
        done_ns = xdotool(display, "keydown", "Down")
        training.wait_for_step(lambda step: step.human and vector(step.action)[0] < -0.99)
        let_go_ns = xdotool(display, "keyup", "Down")
        back = training.wait_for_step(lambda step: step.time_ns > let_go_ns and not step.human)
        steps = newest_sitting(training.run_dir)
        assert_taken_over_at_once(steps, began_ns, done_ns)
        after = next(step for step in steps if step.time_ns > let_go_ns)
        assert after.control != "human"
        assert back.action == back.policy_action
        xdotool(display, "key", "q")
        status, errors = training.end()
    assert status == 0, errors
    all_in_replay(training.run_dir)


def test_the_window_loads_no_llvm_beside_that_of_triton(display):
    code = """
from pathlib import Path
from trainer.person.devices import KeyboardHands, Window
window = Window(KeyboardHands("left_turn"))
window.poll(0.0)
print("LLVM" in Path("/proc/self/maps").read_text())
"""
    command, environment = [sys.executable, "-c", code], {**os.environ, **display}
    told = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert told.stdout == "False\n", told.stderr


def train(run_dir, *more):
    module = "trainer.person.tests.virtual_wheel"
    return Training(run_dir, "--human", "wheel", *more, module=module, SDL_VIDEODRIVER="dummy")


def test_a_wheel_takes_over_at_once_and_a_kill_loses_no_intervention(tmp_path):
    if load_sdl() is None:
        pytest.skip("this pygame has no SDL of its own with virtual joysticks")
    run_dir = tmp_path / "run"
    with closing(train(run_dir)) as training:
        training.wait_for_step(lambda step: step.step >= 2)
        began_ns = time.time_ns()
        done_ns = training.tell("axis 3 -1")
        training.wait_for_step(lambda step: step.human and vector(step.action)[0] < -0.99)
        training.process.kill()
        training.process.wait()
    killed = newest_sitting(run_dir)
    assert_taken_over_at_once(killed, began_ns, done_ns)

    with closing(train(run_dir, "--resume")) as training:
        training.wait_for_step(lambda step: step.sitting == 2 and step.step >= 1)
        training.process.terminate()  # Which is quitting, too.
        status, errors = training.end()
    assert status == 0, errors
    human = sum(step.human for step in killed)
    assert f"{len(killed)} recorded steps after the checkpoint, {human} of them yours" in errors
    assert len(all_in_replay(run_dir)) > len(killed)


APPLIED = "document.querySelector('.bar.applied output').textContent"


def test_a_key_held_in_the_page_takes_over_in_the_training_process(tmp_path, runner):
    async def sit(url):
        async with open_browser() as page:
            await page.goto(url)
            await until(page, POLICY_DRIVES)
            await page.keyboard.down("ArrowDown")
            await until(page, f"{PERSON_DRIVES} && {APPLIED} === '-1.00'")
            await page.keyboard.up("ArrowDown")
            await until(page, POLICY_DRIVES)
            await quit_sitting(page)

    web = Training(tmp_path / "run", "--human", "web", "--set", "warmup_steps=8")
    with closing(web) as training:
        runner.run(sit(address(training.process)))
        status, errors = training.end()
    assert status == 0, errors
    steps = all_in_replay(training.run_dir)
    assert vector(steps[first_of_the_persons(steps)].human_action)[0] < 0.0
    assert -1.0 in [step.action for step in steps if step.human]
    assert steps[-1].outcome == "stopped"
