"""The installer killed right before one of its own writes: each is a moment of a power cut."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

import pytest

from deploy.installer.layout import Layout, why_not_whole
from deploy.tests.boards import Board
from edge_runtime.tests.harness import wait_until

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
"""Kills itself, and the processes that compile for it, before the step of that number among those
whose path ends so."""

COMPILER_KILLER = """\
import os, runpy, signal, sys
sys.argv = sys.argv[1:]
installer = os.getpid()

def watch(event, arguments):
    if event == "os.rename" and os.getpid() != installer:
        os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(watch)
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Kills a process that compiles, as a kernel without memory would."""

COMPILER_THAT_HANGS = """\
import os, runpy, sys, time
_, told, *sys.argv = sys.argv
installer = os.getpid()

def watch(event, arguments):
    if event == "os.rename" and os.getpid() != installer:
        open(told, "w").close()
        time.sleep(60)

sys.addaudithook(watch)
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""A process that compiles says so and does not end by itself."""


def killed(board: Board, bundle, where: str, number: int) -> bool:
    """Whether it came to that step."""
    done = install_under(KILLER, board, bundle, where, str(number))
    assert done.returncode in (0, -signal.SIGKILL), done.stderr
    return done.returncode != 0


def install_under(program: str, board: Board, bundle, *arguments: str):
    """Install in a process group of its own, with a program of Python around the installer."""
    return subprocess.run(
        line_under(program, board, bundle, *arguments), start_new_session=True,
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


def line_under(program: str, board: Board, bundle, *arguments: str) -> list[str]:
    python, _, *line = board.command(
        "install", bundle, "--trust", board.workshop.public_key, "--service", "none"
    )
    return [python, "-c", program, *arguments, *line]


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


def test_a_process_that_compiles_is_killed(board, workshop):
    made = workshop.make(0.1)
    done = install_under(COMPILER_KILLER, board, made.path)
    assert (done.returncode, len(done.stderr.strip().splitlines())) == (2, 1), done.stderr
    assert "too little memory" in done.stderr
    complete(board, made)


def test_killed_while_it_compiles_it_leaves_neither_lock_nor_process(board, workshop, tmp_path):
    """The installer alone is killed, as by a kernel without memory."""
    made, told = workshop.make(0.1), tmp_path / "told"
    line = line_under(COMPILER_THAT_HANGS, board, made.path, str(told))
    with subprocess.Popen(line, stdout=subprocess.DEVNULL) as installer:
        wait_until(told.exists, "a process that compiles")
        pid = installer.pid
        compilers = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        installer.kill()
        installer.wait()
        with Layout(str(board.root)).locked():
            pass
    assert compilers
    wait_until(lambda: not any(map(lives, compilers)), "the end of those that compile")
    complete(board, made)


def lives(pid: str) -> bool:
    """Whether it runs: one that has ended has no command line, even if nobody waited for it yet."""
    try:
        return bool(Path("/proc", pid, "cmdline").read_bytes())
    except OSError:
        return False


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
