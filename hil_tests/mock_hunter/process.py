"""``python -m hil_tests mock_hunter``: the mock as a process on a CAN bus.

The clock, the bus and the switches stand here, around what is pure in `hunter.py`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import can

from edge_runtime.cli import examples, seconds
from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter import MULTICAST_BUS, open_bus, parse_bus
from edge_runtime.vehicles.hunter.protocol import DEFAULT_PROFILE, PROFILES
from hil_tests.mock_hunter.chassis import FAULTS
from hil_tests.mock_hunter.hunter import MODELS, TUNABLE, MockHunter, make_parameters

Switch = tuple[str, bool]  # A fault's name, and whether it is switched on
_WORDS = {"on": True, "off": False}


def read_orders(
    lines: Iterable[str], obey: Callable[[Switch], None], complain: Callable[[str], None]
) -> None:
    """Read ``NAME on`` or ``NAME off``, line by line, in a thread so that nobody waits for them."""
    for line in lines:
        name, _, word = line.strip().partition(" ")
        if name in FAULTS and word in _WORDS:
            obey((name, _WORDS[word]))
        else:
            complain(f"error: {line.strip()!r} is no order: use NAME on, or NAME off")


class Server:
    """Runs a mock on a bus until `stop`; every change is told as one line with its time."""

    def __init__(self, hunter: MockHunter, bus: can.BusABC, tell: Callable[[str], None]) -> None:
        self.orders: queue.SimpleQueue[Switch] = queue.SimpleQueue()
        """Faults to switch next, from any thread."""
        self._hunter, self._bus, self._tell = hunter, bus, tell
        self._ending = threading.Event()
        self._said = ""
        self._fails = False

    def stop(self) -> None:
        """End `run`, from a signal handler or another thread."""
        self._ending.set()

    def run(self) -> None:
        while not self._ending.is_set():
            while not self.orders.empty():
                (name, on), now_s = self.orders.get(), time.monotonic()
                self._hunter.switch(name, on, now_s)
                self._tell(f"fault t={now_s:.6f} {name}={'on' if on else 'off'}")
            for frame, data in self._hunter.due(time.monotonic()):
                self._send(frame.can_id, data)
            words = self._hunter.describe()
            if words != self._said:
                self._said = words
                self._tell(f"chassis t={time.monotonic():.6f} {words}")
            self._listen()

    def _listen(self) -> None:
        """Take what comes until the next report is due: one frame, or none."""
        pause_s = max(0.0, self._hunter.next_s - time.monotonic())
        # What a socket cannot unpack is no frame.
        with contextlib.suppress(can.CanError):
            message = self._bus.recv(pause_s)
            if message is None:
                return
            # The chassis has data frames with an 11-bit identifier only.
            odd = message.is_extended_id or message.is_remote_frame or message.is_error_frame
            if not (odd or message.is_fd):
                data = bytes(message.data)
                self._hunter.receive(message.arbitration_id, data, time.monotonic())

    def _send(self, can_id: int, data: bytes) -> None:
        fails, frame = "", can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        try:
            self._bus.send(frame)
        except can.CanError as error:
            fails = str(error)
        if fails and not self._fails:
            self._tell(f"bus t={time.monotonic():.6f} not sent: {fails}")
        self._fails = bool(fails)


EXAMPLE = examples(
    "python -m hil_tests mock_hunter",
    "python -m hil_tests mock_hunter --bus socketcan:vcan0 --fault link_steer@20",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        f"{parser.description} "
        "Faults are switched while it runs by lines on its standard input: NAME on, NAME off."
        f" Known are {', '.join(FAULTS)}. Parameters: {', '.join(TUNABLE)}."
    )
    add, bits = parser.add_argument, "firmware's fault bits"
    add("--bus", default=MULTICAST_BUS, metavar="INTERFACE:CHANNEL", help="where it is")
    add("--model", default="hunter-2.0", choices=list(MODELS), help="which Hunter")
    add("--profile", default=DEFAULT_PROFILE, choices=list(PROFILES), help=bits)
    append: Any = {"action": "append", "default": []}
    add("--set", type=_setting, metavar="NAME=VALUE", help="a parameter's value", **append)
    add("--fault", type=_fault, metavar="NAME[@S]", help="from the start, or later", **append)


def run(arguments: argparse.Namespace) -> int:
    """Be a Hunter until a signal comes."""
    parameters = make_parameters(arguments.model, dict(arguments.set))
    name, tell = parse_bus(arguments.bus), partial(print, flush=True)
    if name.interface == "virtual":
        raise UserError(
            f"--bus {arguments.bus}: a virtual bus ends with its process, and nobody could reach"
            f" the mock; use {MULTICAST_BUS} or socketcan:vcan0"
        )
    with open_bus(name) as bus:
        hunter = MockHunter(parameters, time.monotonic(), arguments.profile)
        server = Server(hunter, bus, tell)
        for after_s, fault in arguments.fault:
            timer = threading.Timer(after_s, server.orders.put, ((fault, True),))
            timer.daemon = True
            timer.start()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: server.stop())
        if isinstance(sys.stdin, io.TextIOWrapper):
            # A byte that is no text is a wrong order, not the end of all orders.
            sys.stdin.reconfigure(errors="replace")
        complain = partial(print, file=sys.stderr, flush=True)
        reader = (sys.stdin or (), server.orders.put, complain)
        threading.Thread(target=read_orders, args=reader, daemon=True).start()
        tell(f"ready bus={arguments.bus} model={arguments.model}")
        server.run()
    return 0


def _setting(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not valid: use NAME=VALUE") from None


def _fault(text: str) -> tuple[float, str]:
    name, at, after_s = text.partition("@")
    if name not in FAULTS:
        raise argparse.ArgumentTypeError(f"no fault {name!r}; choose from {', '.join(FAULTS)}")
    return seconds(after_s) if at else 0.0, name
