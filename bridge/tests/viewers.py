"""Viewers that behave as a test wants, in the place of rerun's program."""

import contextlib
import os
import signal
import socket
from pathlib import Path

import rerun

PROGRAM = Path(rerun.__file__).parents[1] / "rerun_cli" / "rerun"
NO_GPU = "app creation error: The GPU/graphics driver is lacking some abilities"
KINDS = {
    "ends at once": f'echo "Error: {NO_GPU}" >&2; exit 1',
    "is killed": f'exec timeout --foreground -s KILL 0.7 {PROGRAM} "$@"',
    "hangs": f'exec timeout --foreground -s STOP 0.7 {PROGRAM} "$@"',
    "never listens": "exec sleep 60",
    "works": f'exec {PROGRAM} "$@"',
}
WINDOWLESS = 'case "$*" in *--serve-web*) ;; *) set -- "$@" --serve-grpc ;; esac'
"""A window that needs no screen: what it listens to is kept, and not shown."""


@contextlib.contextmanager
def in_place(kind, folder, monkeypatch):
    """Have the viewer be one of these, with little patience."""
    fake, pids = folder / "rerun", folder / "pids"
    fake.write_text(f"#!/bin/sh\necho $$ >> {pids}\n{WINDOWLESS}\n{KINDS[kind]}\n")
    fake.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(fake))
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("bridge.rerun.FLUSH_S", 0.5)
    monkeypatch.setattr("bridge.rerun.END_S", 0.3)
    if kind == "never listens":
        monkeypatch.setattr("bridge.rerun.START_S", 1.0)
    yield
    for pid in pids.read_text().split():
        with contextlib.suppress(ProcessLookupError):  # Windows stay open.
            os.killpg(os.getpgid(int(pid)), signal.SIGKILL)


def listens(host, port):
    try:
        socket.create_connection((host, port), 1.0).close()
    except OSError:
        return False
    return True
