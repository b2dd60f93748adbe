"""``python -m hil_tests mock_hunter``: the mock as a process on a CAN bus."""

from __future__ import annotations

import argparse
import contextlib
import queue
import signal
import sys
import threading
import time
from functools import partial

import can

from edge_runtime.cli import examples
from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter import MULTICAST_BUS, open_bus, parse_bus
from hil_tests.mock_hunter import FAULTS, MODELS, TUNABLE, MockHunter, make_parameters

EXAMPLE = examples(
    "python -m hil_tests mock_hunter",
    "python -m hil_tests mock_hunter --bus socketcan:vcan0 --set dead_time_s=0.1",
)
_tell = partial(print, flush=True)
Orders = queue.SimpleQueue[tuple[str, bool]]  # a fault's name, and whether it is switched on


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        f"{parser.description} "
        "Faults are switched while it runs by lines on its standard input: NAME on, NAME off."
        f" Known are {', '.join(FAULTS)}. Parameters: {', '.join(TUNABLE)}."
    )
    add = parser.add_argument
    add("--bus", default=MULTICAST_BUS, metavar="INTERFACE:CHANNEL", help="where it is")
    add("--model", default="hunter-2.0", choices=list(MODELS), help="which Hunter")
    text = "a parameter's value"
    add("--set", type=setting, action="append", default=[], metavar="NAME=VALUE", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Be a Hunter until a signal comes."""
    parameters = make_parameters(arguments.model, dict(arguments.set))
    name = parse_bus(arguments.bus)
    if name.interface == "virtual":
        raise UserError(f"a virtual bus ends with its process: use {MULTICAST_BUS}")
    ending, orders = threading.Event(), Orders()
    with open_bus(name) as bus:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: ending.set())
        threading.Thread(target=_read_orders, args=(orders,), daemon=True).start()
        _tell(f"ready bus={arguments.bus} model={arguments.model}")
        serve(MockHunter(parameters, time.monotonic()), bus, orders, ending)
    return 0


def serve(hunter: MockHunter, bus: can.BusABC, orders: Orders, ending: threading.Event) -> None:
    """Run a mock on a bus; print every change as one line with its time (monotonic)."""
    said = ""
    while not ending.is_set():
        while not orders.empty():
            (name, on), now_s = orders.get(), time.monotonic()
            hunter.switch(name, on, now_s)
            _tell(f"fault t={now_s:.6f} {name}={'on' if on else 'off'}")
        for frame, data in hunter.due(time.monotonic()):
            message = can.Message(arbitration_id=frame.can_id, data=data, is_extended_id=False)
            with contextlib.suppress(can.CanError):  # the driver notices
                bus.send(message)
        if (words := hunter.describe()) != said:
            said = words
            _tell(f"chassis t={time.monotonic():.6f} {words}")
        with contextlib.suppress(can.CanError):  # what a socket cannot unpack is no frame
            heard = bus.recv(max(0.0, hunter.next_s - time.monotonic()))
            if heard is None or heard.is_extended_id or heard.is_remote_frame or heard.is_fd:
                continue  # the chassis has data frames with an 11-bit identifier only
            if not heard.is_error_frame:
                hunter.receive(heard.arbitration_id, bytes(heard.data), time.monotonic())


def _read_orders(orders: Orders) -> None:
    """Read `NAME on` or `NAME off`, line by line, from standard input."""
    with open(0, errors="replace", closefd=False) as lines:
        for line in lines:
            name, _, word = line.strip().partition(" ")
            if name in FAULTS and word in ("on", "off"):
                orders.put((name, word == "on"))
            else:
                message = f"error: {line.strip()!r} is no order: use NAME on, or NAME off"
                print(message, file=sys.stderr, flush=True)


def setting(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    return name, float(value)
