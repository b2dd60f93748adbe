"""The installer killed right before one of its own writes: each is a moment of a power cut."""

from __future__ import annotations

import signal
import subprocess

import pytest

from deploy.installer.layout import Layout, why_not_whole
from deploy.tests.boards import Board

KILLER = """\
import os, runpy, signal, sys
_, where, number, *sys.argv = sys.argv
left = int(number)
STEPS = ("os.rename", "os.symlink", "os.remove", "os.rmdir", "os.mkdir")

def watch(event, arguments):
    global left
    if event in STEPS and str(arguments[event in STEPS[:2]]).endswith(where):
        left -= 1
        if left == 0:
            os.killpg(0, signal.SIGKILL)

sys.addaudithook(watch)
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Kills itself, and what it has started, before the step of that number among those whose path ends
so."""


def killed(board: Board, bundle, where: str, number: int) -> bool:
    """Whether it came to that step."""
    python, _, *line = board.command(
        "install", bundle, "--trust", board.workshop.public_key, "--service", "none"
    )
    done = subprocess.run(
        [python, "-c", KILLER, where, str(number), *line], start_new_session=True,
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode in (0, -signal.SIGKILL), done.stderr
    return done.returncode != 0


def whole(board: Board) -> str | None:
    """The current version, when every release that bears a name is whole."""
    layout = Layout(str(board.root))
    for version in layout.versions():
        assert why_not_whole(layout.release(version)) == "", version
    return layout.linked("current")


def complete(board: Board, made) -> None:
    done = board.install(made.path)
    assert done.returncode == 0, done.stderr
    assert whole(board) == made.manifest.version
    assert not [p for p in (board.root / "releases").iterdir() if p.name.startswith(".")]


def test_killed_before_each_step_of_the_switch(board, workshop):
    old, new = workshop.make(0.1), workshop.make(0.2)
    complete(board, old)
    for where in (f"releases/{new.manifest.version}", ".previous", "/previous", "/current"):
        assert killed(board, new.path, where, 1), where
        assert whole(board) == old.manifest.version
    complete(board, new)


@pytest.mark.board
@pytest.mark.timeout(1800)
def test_killed_before_every_step(board, workshop):
    # Of three in turn the next one is neither current nor previous, so it is unpacked anew.
    made = [workshop.make(value) for value in (0.1, 0.2, 0.3)]
    complete(board, made[0])
    for number in range(1, 1000):
        old, new = made[(number - 1) % 3], made[number % 3]
        was_killed = killed(board, new.path, "", number)
        assert whole(board) in (old.manifest.version, new.manifest.version)
        complete(board, new)
        print(number, flush=True)
        if not was_killed:
            break
    assert number > 20
