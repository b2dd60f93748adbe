"""``python -m hil_tests.board.witness CONNECT TLS VEHICLE``: says when the first command came."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

from edge_runtime import wire
from edge_runtime.tls import load_tls
from edge_runtime.transport import open_session
from edge_runtime.util import UserError

_RETRY_S = 0.05
_PATIENCE_S = 120.0


def main(connect: str, tls: str, vehicle_id: str) -> int:
    """Print `first SECONDS` (of the epoch) once, for the first command that drives."""
    came, end_s = threading.Event(), time.monotonic() + _PATIENCE_S

    def hear(sample: Any) -> None:
        command = wire.decode_command(bytes(sample.payload))
        if isinstance(command, wire.Command) and command.mode == wire.DRIVE and not came.is_set():
            print(f"first {time.time():.3f}", flush=True)
            came.set()

    while True:
        try:
            session = open_session(connect=connect, mode="client", tls=load_tls(tls))
            break
        except UserError:  # the simulator does not listen yet
            if time.monotonic() > end_s:
                raise
            time.sleep(_RETRY_S)
    subscriber = session.declare_subscriber(wire.key(vehicle_id, "command"), hear)
    print("listening", flush=True)
    came.wait(_PATIENCE_S)
    subscriber.undeclare()
    session.close()
    return 0 if came.is_set() else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:4]))
