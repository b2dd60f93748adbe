"""``python -m hil_tests.benches.can_floor BUS PRIORITY``: the least that could stream at 50 Hz.

One frame at each absolute deadline, and nothing else: no chassis to hear, no policy, no lock. What
its gaps are is the machine's, the interpreter's and python-can's doing.
"""

from __future__ import annotations

import signal
import sys
import threading
import time

import can

from edge_runtime import realtime
from edge_runtime.vehicles.hunter.bus import open_bus, parse_bus

PERIOD_S = 0.02
CAN_ID = 0x111


def main(name: str, priority: int) -> None:
    """Stream until SIGTERM; a priority other than 0 is one of SCHED_FIFO."""
    realtime.configure(priority, [], lock_memory=False)
    end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: end.set())
    bus = open_bus(parse_bus(name))
    frame = can.Message(arbitration_id=CAN_ID, data=bytes(8), is_extended_id=False)
    print("ready", flush=True)
    next_s = time.monotonic()
    while not end.wait(max(0.0, next_s - time.monotonic())):
        bus.send(frame)
        missed = max(0, int((time.monotonic() - next_s) / PERIOD_S))
        next_s += (missed + 1) * PERIOD_S
    bus.shutdown()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
