"""Who runs the service: systemd, or somebody else (a container's engine, a person).

systemd also runs the trial of a release: the release's own runtime with its own policy, settings,
certificates and user, but without a vehicle, towards a port where nobody listens, in a network of
its own. Whatever is wrong with it, the vehicle gets no command from it.
"""

from __future__ import annotations

import os
import pwd
import re
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Callable, NamedTuple

from deploy.installer.layout import (
    CONFIG,
    DEFAULT_ROOT,
    LAUNCHER,
    TLS,
    UNITS,
    WAY,
    read_state,
    write_whole,
)
from deploy.installer.verify import UnhealthyError
from edge_runtime.util import UserError

MAIN_UNIT, TRIAL_UNIT = "phil-edge.service", "phil-trial.service"
USER = "phil"
WAYS = ("systemd", "none")
UNIT_FOLDER = Path("/etc/systemd/system")
_BOOTED = Path("/run/systemd/system")
_FITS_A_UNIT = re.compile(r"[A-Za-z0-9._+@/-]+")
"""Spaces would cut a unit's line in two, and a % would be a specifier (systemd.unit(5))."""
_UNIT = re.compile(r"(?m)^[A-Za-z0-9][A-Za-z0-9@._-]*$")
_NOWHERE = "127.0.0.1:9"
"""The discard port: nobody listens there, and in a network of its own nobody can."""
_TRIAL_STOP_S = 3.0
_LOOK_S = 0.05


class Limits(NamedTuple):
    """How soon a release must be healthy, and how long it must stay so, s."""

    within_s: float = 10.0
    settle_s: float = 3.0


class NoService:
    """The bundle is installed, and somebody else runs it: nothing to start, try or watch."""

    name = "none"

    def group(self) -> int | None:
        """The id of the group that reads the TLS key; None for the owner alone."""
        return None

    def try_release(self, folder: Path, policy_id: str, limits: Limits) -> None:
        """Raise UnhealthyError where a release does not run well, heard by nobody."""

    def stop(self) -> None:
        """End the service; nothing where there is none."""

    def prepare(self, release: Path) -> None:
        """Put in place what starts a release, now and at every boot."""

    def start(self, release: Path) -> None:
        """Start the service of a release."""

    def watch(self, limits: Limits) -> None:
        """Raise UnhealthyError unless it is active within the limit and stays so for a while."""

    def describe(self) -> str:
        """How it is, in a few words."""
        return "not run by the installer"

    def remove(self) -> None:
        """Stop it and take away what `prepare` has made."""


class Systemd(NoService):
    """The service as units. `root` replaces /opt/phil in their text."""

    name = "systemd"

    def __init__(self, root: Path, unit_folder: Path = UNIT_FOLDER) -> None:
        self._root = str(root)
        self._unit_folder = unit_folder
        self._list = root / "state" / UNITS

    def group(self) -> int | None:
        """The group of the service's user, made where missing: no rights, no home, no shell."""
        try:
            return pwd.getpwnam(USER).pw_gid
        except KeyError:
            _run("useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", USER)
            return pwd.getpwnam(USER).pw_gid

    def try_release(self, folder: Path, policy_id: str, limits: Limits) -> None:
        """As `NoService`: ready within the limit, it goes on to say that it works, as this policy.

        `systemd-run` waits for READY=1, and systemd kills what does not say WATCHDOG=1.
        """
        self._units(folder)
        protocol = "tls" if (folder / TLS).is_dir() else "tcp"
        with tempfile.TemporaryDirectory(prefix="phil-trial-") as place:
            log = Path(place) / "log"
            properties = {
                "NotifyAccess": "main",
                "PrivateNetwork": "yes",
                "User": USER,
                "UMask": "0077",
                "WorkingDirectory": folder,
                "StandardOutput": f"file:{log}",
                "StandardError": f"file:{log}",
                "TimeoutStartSec": limits.within_s,
                "WatchdogSec": limits.settle_s / 3,
                # It ends by itself, should the installer be killed.
                "RuntimeMaxSec": 2 * (limits.within_s + limits.settle_s),
                "TimeoutStopSec": _TRIAL_STOP_S,
            }
            self._end_trial()  # of an installer that was killed
            try:
                _run(
                    "systemd-run", "--quiet", f"--unit={TRIAL_UNIT}", "--service-type=notify",
                    *(f"--property={name}={value}" for name, value in properties.items()),
                    folder / LAUNCHER, "run", "--config", CONFIG, "--vehicle", "none",
                    "--connect", f"{protocol}/{_NOWHERE}", "--log-level", "warning",
                )  # fmt: skip
                settle(lambda: _is_active(TRIAL_UNIT), limits, "it")
            except UnhealthyError as error:
                lines = log.read_text("utf-8", "replace").splitlines() if log.exists() else []
                result, why = _show(TRIAL_UNIT).get("Result"), lines[-1] if lines else error
                raise UnhealthyError(f"trial: {result}: {why}") from None
            finally:
                self._end_trial()
            if f"policy_id={policy_id}" not in log.read_text("utf-8", "replace"):
                raise UnhealthyError("it does not say that it has loaded this policy")

    def stop(self) -> None:
        """As `NoService`."""
        if (self._unit_folder / MAIN_UNIT).exists():
            _run("systemctl", "stop", MAIN_UNIT)

    def prepare(self, release: Path) -> None:
        """As `NoService`: install the release's units."""
        units = self._units(release)
        self._forget(set(units))
        write_whole(self._list, "".join(f"{name}\n" for name in units).encode())
        for name, text in units.items():
            write_whole(self._unit_folder / name, text.encode())
        _run("systemctl", "daemon-reload")
        for name, text in units.items():
            if "[Install]" in text:
                _run("systemctl", "enable", name)

    def start(self, release: Path) -> None:
        """As `NoService`."""
        _run("systemctl", "reset-failed", MAIN_UNIT, check=False)
        _run("systemctl", "start", MAIN_UNIT)

    def watch(self, limits: Limits) -> None:
        """As `NoService`."""
        settle(lambda: _is_active(MAIN_UNIT), limits, MAIN_UNIT)

    def describe(self) -> str:
        """As `NoService`, with the service's own status."""
        shown = _show(MAIN_UNIT)
        return f"{shown.get('ActiveState', 'unknown')} {shown.get('StatusText', '')}".strip()

    def remove(self) -> None:
        """As `NoService`: the units go, the user stays."""
        self.stop()
        self._forget(set())
        self._list.unlink(missing_ok=True)
        _run("systemctl", "daemon-reload")

    def _units(self, release: Path) -> dict[str, str]:
        """The text of a release's units by name, for this root. UnhealthyError without the main."""
        paths = sorted((release / "units").glob("*.*"))
        units = {path.name: path.read_text().replace(DEFAULT_ROOT, self._root) for path in paths}
        if MAIN_UNIT not in units:
            raise UnhealthyError(f"the bundle holds no {MAIN_UNIT}")
        return units

    def _end_trial(self) -> None:
        for verb in ("stop", "reset-failed"):
            _run("systemctl", verb, TRIAL_UNIT, check=False)

    def _forget(self, kept: set[str]) -> None:
        """Take away the units of an earlier release that are not among those kept."""
        names = set(_UNIT.findall(read_state(self._list)))
        for name in sorted(names - kept):
            _run("systemctl", "disable", "--now", name, check=False)
            (self._unit_folder / name).unlink(missing_ok=True)


def settle(looks_well: Callable[[], bool], limits: Limits, what: str) -> None:
    """Look again and again until it has been healthy for `settle_s` without a break.

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


def is_there() -> bool:
    """Whether systemd runs this computer (sd_booted(3))."""
    return _BOOTED.is_dir()


def choose(way: str | None, root: Path, only_look: bool = False) -> NoService:
    """The service of a way; without one, that of the last install here, or what is there.

    Raises UserError where it cannot be run by this user; whoever may `only_look` needs no right.
    """
    if way == "systemd" and not is_there():
        # Before it makes a user and unpacks for a start that cannot come.
        raise UserError("--service systemd: no systemd runs this computer; use --service none")
    kept = read_state(root / "state" / WAY)
    if (way, kept) == ("none", "systemd") and is_there() and not only_look:
        raise UserError("systemd runs this board: leave --service out, or `uninstall` first")
    if way is None:
        way = kept if kept in WAYS else "systemd" if is_there() else "none"
    if way == "none":
        return NoService()
    if os.geteuid() != 0 and not only_look:
        raise UserError("--service systemd needs root: use sudo, or --service none")
    if not _FITS_A_UNIT.fullmatch(str(root)):
        raise UserError(f"--root {root}: a unit's path may hold only letters, digits and ._+@/-")
    return Systemd(root)


def remember(way: str, root: Path) -> None:
    """Keep the way, so that `status` and `rollback` need not be told."""
    write_whole(root / "state" / WAY, way.encode())


def _is_active(unit: str) -> bool:
    """Whether it runs. UnhealthyError where it ended, or was started again."""
    shown = _show(unit)
    if shown.get("ActiveState") == "failed" or shown.get("NRestarts", "0") != "0":
        raise UnhealthyError(f"{unit} ended: {shown.get('Result')} (journalctl --unit {unit})")
    return shown.get("ActiveState") == "active"


def _show(unit: str) -> dict[str, str]:
    """What systemd says of a unit."""
    names = "ActiveState,NRestarts,Result,StatusText"
    lines = _run("systemctl", "show", unit, f"--property={names}").splitlines()
    return dict(line.split("=", 1) for line in lines if "=" in line)


def _run(*words: object, check: bool = True) -> str:
    """Run a command; what it prints. UnhealthyError where it fails, unless told not to check."""
    command = [str(word) for word in words]
    try:
        done = subprocess.run(command, check=False, text=True, capture_output=True)
    except OSError as error:
        raise UserError(f"{command[0]} cannot be run: {error.strerror}") from None
    if check and done.returncode != 0:
        what = " ".join(command[:2] if command[0] == "systemd-run" else command)
        raise UnhealthyError(f"{what}: {done.stderr.strip() or done.returncode}")
    return done.stdout
