"""The ways to run the service: systemd, a supervisor of our own (containers, tests), or none."""

from __future__ import annotations

import contextlib
import fcntl
import grp
import json
import os
import pwd
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Callable, Iterator, NamedTuple

from deploy.installer.apart import Account
from deploy.installer.layout import DEFAULT_ROOT, write_whole
from deploy.installer.verify import UnhealthyError, UserError

_LOOK_S = 0.05


class Limits(NamedTuple):
    """Both in seconds."""

    within_s: float = 10.0
    settle_s: float = 3.0


def settle(looks_well: Callable[[], bool], limits: Limits, what: str) -> None:
    """Look again and again until it was well for `settle_s` on end.

    `looks_well` raises UnhealthyError itself where there is no hope. Raises UnhealthyError where
    it is not well within `within_s`, or not any more after that.
    """
    end_s = time.monotonic() + limits.within_s
    since_s = None
    while since_s is None or time.monotonic() - since_s < limits.settle_s:
        now_s = time.monotonic()
        if not looks_well():
            since_s = None
            if now_s > end_s:
                raise UnhealthyError(f"{what} is not healthy within {limits.within_s:g} s")
        elif since_s is None:
            since_s = now_s
        time.sleep(_LOOK_S)


MAIN_UNIT = "phil-edge.service"
USER = "phil"
UNIT_FOLDER = Path("/etc/systemd/system")
_BOOTED = Path("/run/systemd/system")
_LIST = "phil-units"


def is_there() -> bool:
    """Whether systemd runs this computer (sd_booted(3))."""
    return _BOOTED.is_dir()


class Systemd:
    """The service as units. `root` replaces /opt/phil in their text."""

    name = "systemd"

    def __init__(self, root: Path, unit_folder: Path = UNIT_FOLDER) -> None:
        self._root = root
        self._unit_folder = unit_folder
        self._list = root / "state" / _LIST

    def account(self) -> Account | None:
        """The service's user, made where it is missing: no rights, no home, no shell."""
        try:
            user = pwd.getpwnam(USER)
        except KeyError:
            _run(["useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", USER])
            user = pwd.getpwnam(USER)
        return Account(user.pw_uid, grp.getgrgid(user.pw_gid).gr_gid)

    def stop(self) -> None:
        """End the service; nothing where there is none."""
        if (self._unit_folder / MAIN_UNIT).exists():
            self._systemctl("stop", MAIN_UNIT)

    def start(self, release: Path) -> None:
        """Install the release's units, and start the service now and at every boot."""
        units = sorted((release / "units").glob("*.*"))
        if not any(unit.name == MAIN_UNIT for unit in units):
            raise UnhealthyError(f"the bundle holds no {MAIN_UNIT}")
        self._forget({unit.name for unit in units})
        write_whole(self._list, "".join(f"{unit.name}\n" for unit in units).encode())
        for unit in units:
            text = unit.read_text().replace(DEFAULT_ROOT, str(self._root))
            write_whole(self._unit_folder / unit.name, text.encode())
        self._systemctl("daemon-reload")
        for unit in units:
            if "[Install]" in unit.read_text():
                self._systemctl("enable", unit.name)
        self._systemctl("reset-failed", MAIN_UNIT, check=False)
        self._systemctl("start", MAIN_UNIT)

    def watch(self, limits: Limits) -> None:
        """Raise UnhealthyError unless it is active within the limit and stays so for a while."""
        settle(self._is_active, limits, MAIN_UNIT)

    def describe(self) -> str:
        """How it is, in a few words."""
        shown = self._show()
        words = [shown.get("ActiveState", "unknown"), shown.get("StatusText", "")]
        return " ".join(filter(None, words))

    def remove(self) -> None:
        """Stop, and take the units away."""
        self.stop()
        self._forget(set())
        with contextlib.suppress(FileNotFoundError):
            self._list.unlink()
        self._systemctl("daemon-reload")

    def _is_active(self) -> bool:
        shown = self._show()
        if shown.get("ActiveState") == "failed" or shown.get("NRestarts", "0") != "0":
            result = shown.get("Result", "?")
            raise UnhealthyError(f"{MAIN_UNIT} ended: {result} (journalctl --unit {MAIN_UNIT})")
        return shown.get("ActiveState") == "active"

    def _forget(self, kept: set) -> None:
        """Take away the units of an earlier release that are not among those kept."""
        names = self._list.read_text().split() if self._list.exists() else []
        for name in sorted(set(names) - kept):
            self._systemctl("disable", "--now", name, check=False)
            with contextlib.suppress(FileNotFoundError):
                (self._unit_folder / name).unlink()

    def _show(self) -> dict[str, str]:
        properties = "ActiveState,SubState,NRestarts,Result,StatusText"
        lines = self._systemctl("show", MAIN_UNIT, f"--property={properties}").splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line)

    def _systemctl(self, *arguments: str, check: bool = True) -> str:
        return _run(["systemctl", *arguments], check)


def _run(command: list[str], check: bool = True) -> str:
    try:
        done = subprocess.run(
            command, check=False, text=True,
            capture_output=True,
        )  # fmt: skip
    except OSError as error:
        raise UserError(f"{command[0]} cannot be run: {error.strerror}") from None
    if check and done.returncode != 0:
        raise UnhealthyError(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}")
    return done.stdout


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
    if way == "systemd" and not is_there():
        # Before it makes a user and unpacks for a start that cannot come.
        raise UserError("--service systemd: no systemd runs this computer; use process or none")
    if way is None:
        way = _remembered(root) or ("systemd" if is_there() else "none")
    if way == "systemd":
        if os.geteuid() != 0 and not only_look:
            raise UserError("--service systemd needs root: use sudo, or --service none")
        if not _FITS_A_UNIT.fullmatch(str(root)):
            raise UserError(f"--root {root}: in a unit only letters, digits and ._+@/- are taken")
        return Systemd(root)
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
