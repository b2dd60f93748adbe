"""The installer with a service that is a plain process: in tests, what systemd is on a board.

``python -m deploy.tests.process_service`` takes what `install.pyz` takes.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from deploy.installer import __main__ as installer
from deploy.installer.release import CONFIG, CURRENT, LAUNCHER
from deploy.installer.systemd import Systemd, UnhealthyError

READY_S, SETTLE_S = 8.0, 0.8


class ProcessService(Systemd):
    """Runs the runtime itself, without a trial, and forgets to start it again."""

    def __init__(self, service: object, root: Path) -> None:
        self._current = root / CURRENT
        self._pid, self._log = root.with_suffix(".pid"), root.with_suffix(".log")

    def group(self) -> int:
        return os.getgid()

    def prepare(self, folder: Path) -> None:
        pass

    try_release = prepare

    def start(self) -> None:
        folder = self._current.resolve()
        alone = ["env", "--default-signal", "setsid", str(folder / LAUNCHER)]
        with open(self._log, "wb") as log:
            words = [*alone, "run", "--config", CONFIG]
            run = subprocess.Popen(words, cwd=folder, stdout=log, stderr=log)
        self._pid.write_text(str(run.pid))
        end_s = time.monotonic() + READY_S
        while "ready " not in self._log.read_text() and time.monotonic() < end_s and self.pid():
            time.sleep(0.05)
        time.sleep(SETTLE_S)
        if self.pid() is None or "ready " not in self._log.read_text():
            raise UnhealthyError("the service does not stay up")

    def stop(self) -> None:
        while (pid := self.pid()) is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)
            time.sleep(0.02)

    remove = stop

    def describe(self) -> str:
        return "stopped" if self.pid() is None else "active"

    def pid(self) -> int | None:
        """The process while it lives."""
        try:
            pid = int(self._pid.read_text())
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, ValueError):
            return None
        return None if state == "Z" else pid


if __name__ == "__main__":
    installer.choose = ProcessService
    sys.exit(installer.main(sys.argv[1:]))
