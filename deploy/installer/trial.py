"""The health check of a release that the vehicle cannot hear.

The release's own runtime runs with its own policy, certificates and settings, but with no vehicle,
towards a port where nobody listens, and, where the kernel permits, in a network namespace of its
own: no CAN, no network. Whatever is wrong with it, the vehicle gets no command from it. Healthy is:
within the limit it says READY=1 and the policy's id, and it goes on to say that it works
(WATCHDOG=1). `current` is changed only after that.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TextIO

from deploy.installer.apart import Account, before_exec, can_isolate
from deploy.installer.layout import CONFIG, LAUNCHER, TLS, last_line
from deploy.installer.notify import NotifySocket
from deploy.installer.systemd import Limits, settle
from deploy.installer.verify import UnhealthyError

WATCHDOG_S = 1.0
"""The runtime says that it works twice in this time."""
_NOWHERE = "127.0.0.1:9"
"""The discard port: nobody listens there, and in a namespace of its own nobody can."""
_END_LIMIT_S = 3.0


def try_release(
    folder: Path,
    policy_id: str,
    account: Account | None,
    limits: Limits,
) -> str:
    """Return how it was kept apart. Raises UnhealthyError with the reason."""
    isolated = can_isolate()
    with contextlib.ExitStack() as stack:
        place = stack.enter_context(tempfile.TemporaryDirectory(prefix="phil-trial-"))
        notify = stack.enter_context(NotifySocket(Path(place), account.uid if account else None))
        log = stack.enter_context(open(os.path.join(place, "log"), "w+"))
        process = _start(folder, isolated, account, notify.environment(WATCHDOG_S), log)
        try:
            _watch(process, notify, limits)
        except UnhealthyError as error:
            said = _read(log)
            raise UnhealthyError(f"{error}: {last_line(said, 0)}" if said else str(error)) from None
        finally:
            _end(process)
        if f"policy_id={policy_id}" not in _read(log):
            raise UnhealthyError("it does not say that it has loaded this policy")
    return "in a network of its own" if isolated else "by its settings only"


def _start(
    folder: Path,
    isolated: bool,
    account: Account | None,
    notify: dict[str, str],
    log: TextIO,
) -> subprocess.Popen:
    protocol = "tls" if (folder / TLS).is_dir() else "tcp"
    command = [
        str(folder / LAUNCHER), "run", "--config", CONFIG, "--vehicle", "none",
        "--connect", f"{protocol}/{_NOWHERE}", "--log-level", "warning",
    ]  # fmt: skip
    return subprocess.Popen(
        command,
        cwd=str(folder),
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        env={**os.environ, **notify},
        preexec_fn=before_exec(isolated, account),
        start_new_session=True,
    )


def _watch(process: subprocess.Popen, notify: NotifySocket, limits: Limits) -> None:
    def looks_well() -> bool:
        notify.receive(0.0)
        if process.poll() is not None:
            raise UnhealthyError(f"it ended with status {process.returncode}")
        silent_s = time.monotonic() - notify.last_ping_s
        if notify.pings and silent_s > WATCHDOG_S:
            raise UnhealthyError(f"it has not said for {silent_s:.1f} s that it works")
        return notify.ready and notify.pings > 0

    settle(looks_well, limits, "it")


def _end(process: subprocess.Popen) -> None:
    """End it and all that it started."""
    if process.poll() is None:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_END_LIMIT_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _read(log: TextIO) -> str:
    log.seek(0)
    return log.read().strip()
