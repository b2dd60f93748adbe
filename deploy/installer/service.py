"""The ways to run the service: systemd, a supervisor of our own (containers, tests), or none."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Iterator

from deploy.installer import systemctl
from deploy.installer.apart import Account
from deploy.installer.errors import UnhealthyError, UserError
from deploy.installer.health import Limits, settle
from deploy.installer.layout import write_whole

WAYS = ("systemd", "process", "none")
_STOP_LIMIT_S = 10.0
_WAY = "way"
_FITS_A_UNIT = re.compile(r"[A-Za-z0-9._+@/-]+")
"""Spaces would cut a unit's line in two, and a % would be a specifier (systemd.unit(5))."""
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM)


class NoService:
    """The bundle is installed, and somebody else runs it."""

    name = "none"

    def account(self) -> Account | None:
        """Nobody special."""
        return None

    def stop(self) -> None:
        """Nothing runs."""

    def start(self, release: Path) -> None:
        """Nothing is started."""

    def watch(self, limits: Limits) -> None:
        """Nothing can be wrong."""

    def describe(self) -> str:
        """How it is, in a few words."""
        return "not run by the installer"

    def remove(self) -> None:
        """Nothing is there."""


class SupervisedProcess(NoService):
    """`install.pyz supervise`, a process that outlives the installer."""

    name = "process"

    def __init__(self, root: Path) -> None:
        self._root = root
        self._state = root / "state"

    def stop(self) -> None:
        """End the supervisor, and with it the runtime."""
        pid = self._pid()
        if pid is None:
            return
        for number, limit_s in ((signal.SIGTERM, _STOP_LIMIT_S), (signal.SIGKILL, _STOP_LIMIT_S)):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
            end_s = time.monotonic() + limit_s
            while self._pid() is not None and time.monotonic() < end_s:
                time.sleep(0.05)
        if self._pid() is not None:
            raise UnhealthyError(f"process {pid}, the service's, does not end")

    def start(self, release: Path) -> None:
        """Start a supervisor of whatever `current` names."""
        with contextlib.suppress(FileNotFoundError):
            (self._state / "service.json").unlink()
        with open(str(self._state / "service.log"), "ab") as log, _uninterrupted():
            process = subprocess.Popen(
                [sys.executable, "-I", str(release / "install.pyz"), "supervise",
                 "--root", str(self._root)],
                cwd="/", stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
                preexec_fn=_interruptible,
            )  # fmt: skip
            # `stop` finds it by its lock: until it has that, nobody could end it. Its name comes
            # after the lock, which to ask for would be in its way.
            end_s = time.monotonic() + _STOP_LIMIT_S
            while self._named() != process.pid and process.poll() is None:
                if time.monotonic() > end_s:
                    break
                time.sleep(0.02)

    def watch(self, limits: Limits) -> None:
        """Raise UnhealthyError unless it is ready within the limit and stays so for a while."""
        settle(self._is_ready, limits, "the service")

    def describe(self) -> str:
        """How it is, in a few words."""
        if self._pid() is None:
            return "stopped"
        shown = self._read()
        return (
            f"{'active' if shown.get('ready') else 'starting'} restarts={shown.get('restarts', 0)}"
        )

    def remove(self) -> None:
        """Stop it; its files go with the root."""
        self.stop()

    def _is_ready(self) -> bool:
        shown = self._read()
        if shown.get("restarts"):
            raise UnhealthyError(f"the service ended; see {self._state / 'service.log'}")
        return bool(shown.get("ready"))

    def _read(self) -> dict[str, Any]:
        try:
            value = json.loads((self._state / "service.json").read_bytes())
        except (OSError, ValueError):
            return {}
        return value if isinstance(value, dict) else {}

    def _named(self) -> int | None:
        """The id in the supervisor's file, whether or not that still lives."""
        try:
            return int((self._state / "supervisor.pid").read_text())
        except (OSError, ValueError):
            return None

    def _pid(self) -> int | None:
        """The supervisor's id while it lives: it holds a lock, so no other process is mistaken."""
        try:
            with open(str(self._state / "supervisor.pid"), "r+") as stream:
                try:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    return int(stream.read() or 0) or None
        except (OSError, ValueError):
            return None
        return None


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """^C and SIGTERM wait until the end."""
    signal.pthread_sigmask(signal.SIG_BLOCK, _INTERRUPTS)
    try:
        yield
    finally:
        _interruptible()


def _interruptible() -> None:
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _INTERRUPTS)


def choose(way: str | None, root: Path, only_look: bool = False) -> Any:
    """The service of a way; without one, that of the last install here, or what is there.

    Raises UserError where it cannot be run by this user; whoever may `only_look` needs no right.
    """
    if way == "systemd" and not systemctl.is_there():
        # Before it makes a user and unpacks for a start that cannot come.
        raise UserError("--service systemd: no systemd runs this computer; use process or none")
    if way is None:
        way = _remembered(root) or ("systemd" if systemctl.is_there() else "none")
    if way == "systemd":
        if os.geteuid() != 0 and not only_look:
            raise UserError("--service systemd needs root: use sudo, or --service none")
        if not _FITS_A_UNIT.fullmatch(str(root)):
            raise UserError(f"--root {root}: in a unit only letters, digits and ._+@/- are taken")
        return systemctl.Systemd(root)
    return SupervisedProcess(root) if way == "process" else NoService()


def remember(way: str, root: Path) -> None:
    """Keep the way, so that `status` and `rollback` need not be told."""
    write_whole(root / "state" / _WAY, way.encode())


def _remembered(root: Path) -> str | None:
    try:
        way = (root / "state" / _WAY).read_text()
    except OSError:
        return None
    return way if way in WAYS else None
