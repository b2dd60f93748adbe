"""Real key events, through an X server, take over in a real training process."""

from __future__ import annotations

import os
import shutil
import subprocess
import time

import pytest

from trainer.person.tests.processes import (
    Training,
    assert_all_in_replay,
    assert_taken_over_at_once,
    newest_sitting,
)


@pytest.fixture
def display():
    """A screen without a screen."""
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
    run_dir = tmp_path / "run"
    with Training(run_dir, "trainer", ["--human", "keyboard"], display) as training:
        training.wait_for_step(lambda step: step.step >= 2)
        began_ns = time.time_ns()
        done_ns = xdotool(display, "keydown", "Down")
        training.wait_for_step(lambda step: step.human and step.action < -0.99)
        let_go_ns = xdotool(display, "keyup", "Down")
        back = training.wait_for_step(lambda step: step.time_ns > let_go_ns and not step.human)
        steps = newest_sitting(run_dir)
        assert_taken_over_at_once(steps, began_ns, done_ns)
        after = next(step for step in steps if step.time_ns > let_go_ns)
        assert after.control != "human"
        assert back.action == back.policy_action
        xdotool(display, "key", "q")
        status, errors = training.end()
    assert status == 0, errors
    assert_all_in_replay(run_dir)
