"""A virtual wheel takes over in a real training process, which is killed and goes on."""

from __future__ import annotations

import time

import pytest

from trainer.person.tests.processes import (
    Training,
    all_steps,
    assert_all_in_replay,
    assert_taken_over_at_once,
    newest_sitting,
)
from trainer.person.tests.virtual_wheel import load_sdl

WHEEL = "trainer.person.tests.virtual_wheel"
WITHOUT_SCREEN = {"SDL_VIDEODRIVER": "dummy"}


def train(run_dir, *more):
    return Training(run_dir, WHEEL, ["--human", "wheel", *more], WITHOUT_SCREEN)


def test_a_wheel_takes_over_at_once_and_a_kill_loses_no_intervention(tmp_path):
    if load_sdl() is None:
        pytest.skip("this pygame has no SDL of its own with virtual joysticks")
    run_dir = tmp_path / "run"
    with train(run_dir) as training:
        training.wait_for_step(lambda step: step.step >= 2)
        began_ns = time.time_ns()
        done_ns = training.tell("axis 3 -1")
        training.wait_for_step(lambda step: step.human and step.action < -0.99)
        training.process.kill()
        training.process.wait()
    killed = newest_sitting(run_dir)
    assert_taken_over_at_once(killed, began_ns, done_ns)

    with train(run_dir, "--resume") as training:
        training.wait_for_step(lambda step: step.sitting == 2 and step.step >= 1)
        training.process.terminate()  # Which is quitting, too.
        status, errors = training.end()
    assert status == 0, errors
    human = sum(step.human for step in killed)
    assert f"{len(killed)} recorded steps after the checkpoint, {human} of them yours" in errors
    assert len(all_steps(run_dir)) > len(killed)
    assert_all_in_replay(run_dir)
