"""``python -m hil_tests.faults.router LISTEN CONNECT``: a Zenoh router to be killed."""

from __future__ import annotations

import signal
import sys
import threading

from edge_runtime.transport import open_session


def main(listen: str, connect: str) -> None:
    """Route until SIGTERM."""
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    session = open_session(listen=listen, connect=connect, mode="router")
    print("ready", flush=True)
    end.wait()
    session.close()


if __name__ == "__main__":
    main(*sys.argv[1:3])
