"""``python -m hil_tests mock_hunter``: a Hunter on a CAN bus, as a process of its own."""

from __future__ import annotations

import argparse
import io
import signal
import sys
import time
from typing import Any

from edge_runtime.cli import examples, seconds
from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter import bus as multicast
from edge_runtime.vehicles.hunter.bus import BusName, open_bus, parse_bus
from edge_runtime.vehicles.hunter.protocol import DEFAULT_PROFILE, PROFILES
from hil_tests.mock_hunter.faults import FAULTS, check_fault
from hil_tests.mock_hunter.hunter import MockHunter
from hil_tests.mock_hunter.parameters import MODELS, SOURCES, make_parameters, read_changes
from hil_tests.mock_hunter.process import Orders, Server


class _AfterFault(argparse.Action):
    """``--after-s`` belongs to the ``--fault`` before it."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        if not namespace.fault or namespace.fault[-1][0]:
            parser.error("--after-s follows a --fault")
        namespace.fault[-1] = (values, namespace.fault[-1][1])


EXAMPLE = examples(
    "python -m hil_tests mock_hunter",
    "python -m hil_tests mock_hunter --bus socketcan:vcan0 --fault link_steer --after-s 20",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.description = (
        f"{parser.description}. "
        "Faults are switched while it runs by lines on its standard input: NAME on, NAME off."
        f" Known are {', '.join(FAULTS)}. Parameters: {', '.join(SOURCES)}."
    )
    parser.add_argument(
        "--bus", default=multicast.MULTICAST_BUS, metavar="INTERFACE:CHANNEL", help="where it is"
    )
    parser.add_argument("--model", default="hunter-2.0", choices=list(MODELS))
    parser.add_argument(
        "--profile", default=DEFAULT_PROFILE, choices=list(PROFILES), help="firmware's fault bits"
    )
    parser.add_argument("--set", action="append", metavar="NAME=VALUE", help="a parameter's value")
    parser.add_argument(
        "--fault", action="append", type=_fault, metavar="NAME", help="from the start"
    )
    parser.add_argument(
        "--after-s", action=_AfterFault, type=seconds, metavar="S", help="that fault comes later"
    )


def run(arguments: argparse.Namespace) -> int:
    """Be a Hunter until a signal comes."""
    parameters = make_parameters(arguments.model, read_changes(arguments.set or []))
    bus = open_bus(_check_reachable(arguments.bus))
    try:
        hunter = MockHunter(parameters, time.monotonic(), arguments.profile)
        server = Server(hunter, bus, _tell, arguments.fault or ())
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: server.stop())
        if isinstance(sys.stdin, io.TextIOWrapper):
            # A byte that is no text is a wrong order, not the end of all orders.
            sys.stdin.reconfigure(errors="replace")
        orders = Orders(sys.stdin, lambda line: print(line, file=sys.stderr, flush=True))
        _tell(f"ready bus={arguments.bus} model={arguments.model}")
        server.run(orders.newest)
    finally:
        bus.shutdown()
    return 0


def _check_reachable(text: str) -> BusName:
    bus = parse_bus(text)
    if bus.interface == "virtual":
        raise UserError(
            f"--bus {text}: a virtual bus ends with its process, and nobody could reach the mock;"
            f" use {multicast.MULTICAST_BUS} or socketcan:vcan0"
        )
    return bus


def _tell(line: str) -> None:
    print(line, flush=True)


def _fault(text: str) -> tuple[float, str]:
    try:
        return 0.0, check_fault(text)
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
