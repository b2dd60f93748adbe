"""`install.pyz supervise`: keeps the runtime of `current` running where there is no systemd.

It does what the unit file asks of systemd: hears READY=1 and WATCHDOG=1, kills what is silent,
starts again what has ended, and gives up after too many starts. For containers and tests.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from deploy.installer.apart import before_exec
from deploy.installer.layout import CONFIG, LAUNCHER, Layout
from deploy.installer.notify import NotifySocket
from deploy.installer.verify import UserError

WATCHDOG_S = 3.0
RESTART_PAUSE_S = 0.5
MAX_STARTS, IN_S = 5, 60.0
_START_LIMIT_S = 30.0
_END_LIMIT_S = 5.0
# Its own death kills the runtime (apart.py), and a vehicle in mid-drive is to be stopped instead:
# so each signal that ends a process stops it first. Of those left out, the first six cannot be
# caught, or would only be raised again; the others end nothing.
_ENDS = signal.valid_signals() - {
    *(signal.SIGKILL, signal.SIGSTOP),
    *(signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL),
    *(signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH),
    *(signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU),
}


def supervise(layout: Layout) -> int:
    """Run until a signal. Raises UserError where another one runs, or nothing is installed."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(_single(layout))
        place = stack.enter_context(tempfile.TemporaryDirectory(prefix="phil-service-"))
        notify = stack.enter_context(NotifySocket(Path(place)))
        return _Supervisor(layout, notify).run()


class _Supervisor:
    def __init__(self, layout: Layout, notify: NotifySocket) -> None:
        self._layout = layout
        self._notify = notify
        self._stopping = False
        self._starts: list[float] = []
        self._process: subprocess.Popen | None = None
        for number in _ENDS:
            # SIGHUP under nohup is ignored, and SIGPIPE by Python itself.
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._stop)

    def run(self) -> int:
        while not self._stopping:
            self._start()
            self._watch()
            self._end()
            now_s = time.monotonic()
            self._starts = [s for s in self._starts if now_s - s < IN_S]
            if not self._stopping and len(self._starts) >= MAX_STARTS:
                print(f"gave up: {MAX_STARTS} starts in {IN_S:.0f} s", file=sys.stderr)
                return 1
            self._say(ready=False)
            time.sleep(0 if self._stopping else RESTART_PAUSE_S)
        return 0

    def _start(self) -> None:
        version = self._layout.linked("current")
        if version is None:
            raise UserError(f"nothing is installed in {self._layout.root}")
        folder = self._layout.release(version)
        self._notify.forget()
        self._starts.append(time.monotonic())
        self._process = subprocess.Popen(
            [str(folder / LAUNCHER), "run", "--config", CONFIG],
            cwd=str(folder),
            env={**os.environ, **self._notify.environment(WATCHDOG_S)},
            preexec_fn=before_exec(isolated=False, account=None),
        )

    def _watch(self) -> None:
        assert self._process is not None
        was_ready = False
        while self._process.poll() is None and not self._stopping:
            self._notify.receive(0.1)
            if self._notify.ready != was_ready:
                was_ready = self._notify.ready
                self._say(ready=was_ready)
            silent_s = time.monotonic() - self._notify.last_ping_s
            if silent_s > (WATCHDOG_S if was_ready else _START_LIMIT_S):
                print(f"silent for {silent_s:.1f} s: killed", file=sys.stderr)
                self._process.kill()
                self._process.wait()

    def _end(self) -> None:
        assert self._process is not None
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(timeout=_END_LIMIT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _say(self, ready: bool) -> None:
        assert self._process is not None
        restarts = len(self._starts) - (1 if self._process.poll() is None else 0)
        value = {"pid": self._process.pid, "ready": ready, "restarts": restarts}
        path = self._layout.state / "service.json"
        draft = path.with_name(".service.json")
        draft.write_text(json.dumps(value))
        os.replace(str(draft), str(path))

    def _stop(self, number: int, frame: Any) -> None:
        self._stopping = True


@contextlib.contextmanager
def _single(layout: Layout) -> Any:
    """Hold the lock that says that a supervisor lives, with its process id inside."""
    if not layout.state.is_dir():
        raise UserError(f"nothing is installed in {layout.root}")
    with open(str(layout.state / "supervisor.pid"), "a+") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(f"a supervisor runs already in {layout.root}") from None
        stream.truncate(0)
        stream.write(str(os.getpid()))
        stream.flush()
        yield
