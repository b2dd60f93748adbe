"""Run a release as a systemd service, after a trial.

A trial runs the release's own runtime, policy, settings and certificates as the service's user, but
without a vehicle and in a network of its own.
"""

from __future__ import annotations

import os
import pwd
import subprocess
import tempfile
import time
from pathlib import Path

from deploy.installer.release import CONFIG, CURRENT, DEFAULT_ROOT, LAUNCHER, TLS
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError

MAIN_UNIT, CAN_UNIT, TRIAL_UNIT = "phil-edge.service", "phil-can.service", "phil-trial.service"
USER = "phil"
READY_S, SETTLE_S = 30.0, 3.0
"""Limit until a trial is ready, and time for which a release must then stay healthy."""
UNIT_FOLDER = Path("/etc/systemd/system")
BOOTED = Path("/run/systemd/system")
"""Exists where systemd runs this computer (sd_booted(3))."""


class UnhealthyError(UserError):
    """A release may not run here. Its text says why, on one line."""


class Systemd:
    """The service as units, in whose text `root` replaces /opt/phil."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def group(self) -> int:
        """Return the id of the user's group; make the user if it is missing."""
        options = ("--system", "--no-create-home", "--shell", "/usr/sbin/nologin")
        _run("useradd", *options, USER, check=False)
        return pwd.getpwnam(USER).pw_gid

    def try_release(self, folder: Path) -> None:
        """Give the user's group the TLS key, and run a trial. Raises UnhealthyError."""
        protocol, group = "tcp", self.group()
        for path in (folder / TLS).glob("*"):
            protocol = "tls"
            os.chown(path, -1, group)
            path.chmod(0o640)
        with tempfile.TemporaryDirectory(prefix="phil-trial-") as place:
            log = Path(place, "log")
            log.touch()
            properties = {
                "NotifyAccess": "main",
                "PrivateNetwork": "yes",
                "User": USER,
                "WorkingDirectory": folder,
                "StandardOutput": f"file:{log}",
                "StandardError": f"file:{log}",
                "TimeoutStartSec": READY_S,
                "WatchdogSec": SETTLE_S / 3,
                # The trial ends by itself if the installer is killed.
                "RuntimeMaxSec": 2 * (READY_S + SETTLE_S),
            }
            _run("systemctl", "stop", TRIAL_UNIT, check=False)  # of an installer that was killed
            try:
                _run(
                    "systemd-run", "--quiet", f"--unit={TRIAL_UNIT}", "--collect",
                    "--service-type=notify",
                    *(f"--property={name}={value}" for name, value in properties.items()),
                    folder / LAUNCHER, "run", "--config", CONFIG, "--vehicle", "none",
                    "--connect", f"{protocol}/127.0.0.1:9", "--log-level", "warning",
                )  # fmt: skip
                _require_active(TRIAL_UNIT)
            except UnhealthyError as error:
                raise UnhealthyError(f"trial: {error} {log.read_text()[-300:]}") from None
            finally:
                _run("systemctl", "stop", TRIAL_UNIT, check=False)

    def stop(self) -> None:
        if (UNIT_FOLDER / MAIN_UNIT).exists():
            _run("systemctl", "stop", MAIN_UNIT)

    def prepare(self, folder: Path) -> None:
        """Install the units of a release, which start it now and at every boot."""
        for path in sorted((folder / "units").iterdir()):
            text = path.read_text().replace(DEFAULT_ROOT, str(self._root))
            write_atomic(UNIT_FOLDER / path.name, text.encode())
        _run("systemctl", "daemon-reload")
        _run("systemctl", "enable", MAIN_UNIT, CAN_UNIT)

    def start(self) -> None:
        """Start the release that `current` names, and wait for READY=1. Raises UnhealthyError."""
        _run("systemctl", "reset-failed", MAIN_UNIT, check=False)
        _run("systemctl", "start", MAIN_UNIT)
        _require_active(MAIN_UNIT)

    def describe(self) -> str:
        return _run("systemctl", "is-active", MAIN_UNIT, check=False).strip()

    def remove(self) -> None:
        """End the service and remove its units; the user stays."""
        _run("systemctl", "disable", "--now", MAIN_UNIT, CAN_UNIT, check=False)
        for name in (MAIN_UNIT, CAN_UNIT):
            (UNIT_FOLDER / name).unlink(missing_ok=True)
        _run("systemctl", "daemon-reload")


def choose(service: str | None, root: Path) -> Systemd | None:
    """Return the service of `--service`, None where somebody else runs the release.

    Without the option an installation stays as it is, and a first one uses systemd if it runs.
    """
    has_unit = (UNIT_FOLDER / MAIN_UNIT).exists()
    if service == "none" and has_unit:
        raise UserError("systemd runs this board: leave --service out, or `uninstall` first")
    is_first = BOOTED.is_dir() and not (root / CURRENT).exists()
    return Systemd(root) if has_unit or (service is None and is_first) else None


def _require_active(unit: str) -> None:
    """Raise UnhealthyError if a unit that was just started has ended or restarted by then."""
    time.sleep(SETTLE_S)
    shown = _run("systemctl", "show", unit, "--property=ActiveState,NRestarts,Result").split()
    if not {"ActiveState=active", "NRestarts=0"} <= set(shown):
        raise UnhealthyError(f"{unit} does not stay up: {' '.join(shown)}")


def _run(*words: object, check: bool = True) -> str:
    """Run a command; return what it prints. Raises UnhealthyError where it fails and is checked."""
    command = [str(word) for word in words]
    done = subprocess.run(command, check=False, text=True, capture_output=True)
    if check and done.returncode != 0:
        raise UnhealthyError(f"{' '.join(command[:2])}: {done.stderr or done.returncode}")
    return done.stdout
