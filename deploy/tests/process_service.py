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
from deploy.installer.layout import CONFIG, CURRENT, LAUNCHER
from deploy.installer.systemd import HealthLimits, Systemd, UnhealthyError


class ProcessService(Systemd):
    """Runs the runtime itself, without a trial, and forgets to start it again."""

    def __init__(self, service: object, root: Path) -> None:
        super().__init__(root)
        self._current = root / CURRENT
        self._pid, self._log = root / "state/pid", root / "state/log"

    def group(self) -> int:
        return os.getgid()

    def try_release(self, folder: Path, policy_id: str, limits: HealthLimits) -> None:
        pass

    def prepare(self, folder: Path) -> None:
        pass

    def start(self, limits: HealthLimits) -> None:
        with open(self._log, "wb") as log:
            run = subprocess.Popen(
                [self._current / LAUNCHER, "run", "--config", CONFIG], cwd=self._current.resolve(),
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        self._pid.write_text(str(run.pid))
        end_s = time.monotonic() + limits.within_s
        while "ready " not in self._log.read_text():
            time.sleep(0.05)
            if self.pid() is None or time.monotonic() > end_s:
                raise UnhealthyError("the service does not get ready")
        time.sleep(limits.settle_s)
        if self.pid() is None:
            raise UnhealthyError("the service ended")

    def stop(self) -> None:
        while (pid := self.pid()) is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)
            time.sleep(0.02)

    def describe(self) -> str:
        return "stopped" if self.pid() is None else "active"

    def remove(self) -> None:
        self.stop()

    def pid(self) -> int | None:
        """The process while it lives, and is no zombie of ours."""
        try:
            pid = int(self._pid.read_text())
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, ValueError):
            return None
        return None if state == "Z" else pid


if __name__ == "__main__":
    installer.choose = ProcessService
    sys.exit(installer.main(sys.argv[1:]))
