"""Run a release as a systemd service, and try it before.

A trial is the release's own runtime with its own policy, settings, certificates and user, but
without a vehicle, towards a port where nobody listens, in a network of its own. Whatever is wrong
with it, the vehicle gets no command from it.
"""

from __future__ import annotations

import os
import pwd
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from deploy.installer.layout import CONFIG, CURRENT, DEFAULT_ROOT, LAUNCHER, TLS
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError

MAIN_UNIT, CAN_UNIT, TRIAL_UNIT = "phil-edge.service", "phil-can.service", "phil-trial.service"
USER = "phil"
SERVICES = ("systemd", "none")
UNIT_FOLDER = Path("/etc/systemd/system")
BOOTED = Path("/run/systemd/system")
"""A folder where systemd runs this computer (sd_booted(3))."""
_NOWHERE = "127.0.0.1:9"
"""The discard port: nobody listens there, and in a network of its own nobody can."""
_TRIAL_STOP_S = 3.0


class UnhealthyError(UserError):
    """A release may not run here. Its text says why, on one line."""


class HealthLimits(NamedTuple):
    """How soon a trial must be ready, and how long a release must then stay healthy, s."""

    within_s: float = 10.0
    settle_s: float = 3.0


class Systemd:
    """The service as units, in whose text `root` replaces /opt/phil."""

    def __init__(self, root: Path, unit_folder: Path = UNIT_FOLDER) -> None:
        self._root = root
        self._unit_folder = unit_folder

    def group(self) -> int:
        """The id of the user's group. The user is made where missing: no rights, home or shell."""
        try:
            return pwd.getpwnam(USER).pw_gid
        except KeyError:
            _run("useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", USER)
            return pwd.getpwnam(USER).pw_gid

    def try_release(self, folder: Path, policy_id: str, limits: HealthLimits) -> None:
        """Run a release heard by nobody. Raises UnhealthyError where it does not run well.

        It must say READY=1 within the limit, go on with WATCHDOG=1, and log this policy's name.
        """
        protocol = "tls" if (folder / TLS).is_dir() else "tcp"
        with tempfile.TemporaryDirectory(prefix="phil-trial-") as place:
            log = Path(place, "log")
            log.touch()
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
                _require_active(TRIAL_UNIT, limits.settle_s)
            except UnhealthyError as error:
                said = log.read_text("utf-8", "replace").splitlines()
                result, why = _show(TRIAL_UNIT).get("Result"), said[-1] if said else error
                raise UnhealthyError(f"trial: {result}: {why}") from None
            finally:
                self._end_trial()
            if f"policy_id={policy_id}" not in log.read_text("utf-8", "replace"):
                raise UnhealthyError("trial: its log does not name this policy")

    def _end_trial(self) -> None:
        for verb in ("stop", "reset-failed"):
            _run("systemctl", verb, TRIAL_UNIT, check=False)

    def stop(self) -> None:
        """End the service, if there is one."""
        if (self._unit_folder / MAIN_UNIT).exists():
            _run("systemctl", "stop", MAIN_UNIT)

    def prepare(self, folder: Path) -> None:
        """Install the units of a release, which start it now and at every boot."""
        for path in sorted((folder / "units").iterdir()):
            text = path.read_text().replace(DEFAULT_ROOT, str(self._root))
            write_atomic(self._unit_folder / path.name, text.encode())
        _run("systemctl", "daemon-reload")
        _run("systemctl", "enable", MAIN_UNIT, CAN_UNIT)

    def start(self, limits: HealthLimits) -> None:
        """Start the release that `current` names. Raises UnhealthyError where it does not run well.

        `systemctl start` waits for READY=1 as long as the unit and what it comes after allow.
        systemd ends a service that does not go on with WATCHDOG=1.
        """
        _run("systemctl", "reset-failed", MAIN_UNIT, check=False)
        _run("systemctl", "start", MAIN_UNIT)
        _require_active(MAIN_UNIT, limits.settle_s)

    def describe(self) -> str:
        """Say in a few words how the service is."""
        shown = _show(MAIN_UNIT)
        return f"{shown.get('ActiveState', 'unknown')} {shown.get('StatusText', '')}".strip()

    def remove(self) -> None:
        """Stop the service and remove its units; the user stays."""
        self.stop()
        _run("systemctl", "disable", "--now", MAIN_UNIT, CAN_UNIT, check=False)
        for name in (MAIN_UNIT, CAN_UNIT):
            (self._unit_folder / name).unlink(missing_ok=True)
        _run("systemctl", "daemon-reload")


def choose(service: str | None, root: Path) -> Systemd | None:
    """The service of `--service`, None where somebody else runs the release.

    Without the option an installation stays as it is, and a first one takes systemd where that runs
    this computer. Raises UserError where systemd is asked for and does not run it, or is not asked
    for and runs this installation.
    """
    is_booted, has_unit = BOOTED.is_dir(), (UNIT_FOLDER / MAIN_UNIT).exists()
    if service == "systemd" and not is_booted:
        raise UserError("--service systemd: no systemd runs this computer; use --service none")
    if service == "none" and has_unit:
        raise UserError("systemd runs this board: leave --service out, or `uninstall` first")
    is_first = not os.path.lexists(root / CURRENT)
    if service == "systemd" or (service is None and is_booted and (has_unit or is_first)):
        return Systemd(root)
    return None


def _require_active(unit: str, settle_s: float) -> None:
    """Raise UnhealthyError where a unit that was just started has ended or begun anew by then."""
    time.sleep(settle_s)
    shown = _show(unit)
    if shown.get("ActiveState") != "active" or shown.get("NRestarts", "0") != "0":
        state = f"{shown.get('ActiveState')}, {shown.get('Result')}"
        raise UnhealthyError(f"{unit} does not stay up: {state} (journalctl --unit {unit})")


def _show(unit: str) -> dict[str, str]:
    names = "ActiveState,NRestarts,Result,StatusText"
    lines = _run("systemctl", "show", unit, f"--property={names}").splitlines()
    return dict(line.split("=", 1) for line in lines if "=" in line)


def _run(*words: object, check: bool = True) -> str:
    """Run a command; return what it prints. Raises UnhealthyError where it fails and is checked."""
    command = [str(word) for word in words]
    done = subprocess.run(command, check=False, text=True, capture_output=True)
    if check and done.returncode != 0:
        said = done.stderr.strip() or f"exit status {done.returncode}"
        raise UnhealthyError(f"{' '.join(command[:2])}: {said}")
    return done.stdout
