"""systemd as a way to run the service: unit files and `systemctl`, in one thin place."""

from __future__ import annotations

import contextlib
import grp
import pwd
import subprocess
from pathlib import Path

from deploy.installer.apart import Account
from deploy.installer.errors import UnhealthyError, UserError
from deploy.installer.health import Limits, settle
from deploy.installer.layout import DEFAULT_ROOT, write_whole

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
