"""The installer with a service that is a plain process: in tests, what systemd is on a board.

``python -m deploy.tests.process_service`` takes what `install.pyz` takes, and `--service process`.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from deploy.installer import __main__ as installer
from deploy.installer.layout import CONFIG, LAUNCHER
from deploy.installer.systemd import WAYS, Limits, NoService, choose, settle
from deploy.installer.verify import UnhealthyError


class ProcessService(NoService):
    """Runs the runtime itself, and forgets to start it again."""

    name = "process"

    def __init__(self, root: Path) -> None:
        self._pid, self._log = root / "state" / "pid", root / "state" / "log"

    def start(self, release: Path) -> None:
        with open(self._log, "wb") as log:
            run = subprocess.Popen(
                [release / LAUNCHER, "run", "--config", CONFIG], cwd=release,
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        self._pid.write_text(str(run.pid))

    def stop(self) -> None:
        while (pid := self.pid()) is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)
            time.sleep(0.02)

    def watch(self, limits: Limits) -> None:
        settle(self._is_ready, limits, "the service")

    def describe(self) -> str:
        return "stopped" if self.pid() is None else "active"

    def remove(self) -> None:
        self.stop()
        for path in (self._pid, self._log):
            path.unlink(missing_ok=True)

    def pid(self) -> int | None:
        """The process while it lives, and is no zombie of ours."""
        try:
            pid = int(self._pid.read_text())
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, ValueError):
            return None
        return None if state == "Z" else pid

    def _is_ready(self) -> bool:
        if self.pid() is None:
            raise UnhealthyError("the service ended")
        return "ready " in self._log.read_text()


def choose_process(way: str | None, root: Path, only_look: bool = False) -> NoService:
    """As `choose`, with a further way that is remembered like the others."""
    kept = root / "state" / "way"
    if way == "process" or (way is None and kept.exists() and kept.read_text() == "process"):
        return ProcessService(root)
    return choose(way, root, only_look)


if __name__ == "__main__":
    installer.WAYS = (*WAYS, "process")  # type: ignore[assignment]
    installer.choose = choose_process
    sys.exit(installer.main(sys.argv[1:]))
