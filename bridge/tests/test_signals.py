"""SIGTERM ends a command whichever thread the kernel hands it to."""

from __future__ import annotations

import subprocess
import sys

_ANOTHER_THREAD_TAKES_IT = """
import signal, threading, time
from bridge.signals import sigterm_as_interrupt, wait_to_be_told
with sigterm_as_interrupt():
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        print("ready", flush=True)
        wait_to_be_told()
    except KeyboardInterrupt:
        print("told")
"""


def test_a_signal_that_another_thread_takes_ends_the_wait():
    command = [sys.executable, "-c", _ANOTHER_THREAD_TAKES_IT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            process.terminate()
            output, _ = process.communicate(timeout=20)
        finally:
            process.kill()
    assert output == "told\n"
    assert process.returncode == 0
