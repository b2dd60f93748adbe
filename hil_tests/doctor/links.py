"""Probes: what the wire and the vehicle's bus need."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import threading
from collections.abc import Callable
from pathlib import Path

from edge_runtime.errors import UserError
from hil_tests.doctor.check import MissingError, output_of

ARRIVAL_S = 5.0
LOOPBACK = "127.0.0.1"
_CAN_DEVICE = "280"
"""ARPHRD_CAN of linux/if_arp.h."""


def zenoh_loopback() -> str:
    """A message from one Zenoh session to another, over TCP on loopback."""
    from edge_runtime.transport import free_endpoint, open_session

    came = threading.Event()
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        router = open_session(listen=endpoint, mode="router")
        stack.callback(router.close)
        client = open_session(connect=endpoint, mode="client")
        stack.callback(client.close)
        subscriber = router.declare_subscriber("phil/doctor", lambda _: came.set())
        stack.callback(subscriber.undeclare)
        client.put("phil/doctor", b"doctor")
        if not came.wait(ARRIVAL_S):
            raise MissingError(f"no message within {ARRIVAL_S:.0f} s over {endpoint}")
    return f"a message went over {endpoint}"


def port(number: int) -> Callable[[], str]:
    """A probe: the port is free on loopback."""

    def probe() -> str:
        with socket.socket() as listener:
            # As a server does: links of one that has just ended are no bar.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind((LOOPBACK, number))
                listener.listen()
            except OSError as error:
                raise MissingError(f"{LOOPBACK}:{number}: {error.strerror}") from None
        return f"{LOOPBACK}:{number} is free"

    return probe


def multicast_can() -> str:
    """A CAN frame from one bus to another on a group and port of their own."""
    import can

    from edge_runtime.vehicles.hunter.bus import open_bus, parse_bus

    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        number = probe.getsockname()[1]
    name = parse_bus(f"udp_multicast:239.74.163.9:{number}")
    try:
        with open_bus(name) as sender, open_bus(name) as receiver:
            sender.send(can.Message(arbitration_id=0x111, data=b"doctor", is_extended_id=False))
            heard = receiver.recv(ARRIVAL_S)
    except UserError as error:
        raise MissingError(str(error)) from None
    if heard is None or bytes(heard.data) != b"doctor":
        raise MissingError("a frame did not arrive on loopback")
    return "a frame went through UDP multicast on loopback"


def can_interface() -> str:
    """SocketCAN's sockets open, and there is an interface to bind them to."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        raise MissingError(f"this kernel opens no CAN socket: {error.strerror}") from None
    kinds = {path.parent.name: path.read_text() for path in Path("/sys/class/net").glob("*/type")}
    found = sorted(name for name, kind in kinds.items() if kind.strip() == _CAN_DEVICE)
    if not found:
        raise MissingError("there is no CAN interface")
    return ", ".join(found)


def virtual_can() -> str:
    """The kernel makes a vcan device, in a network namespace that goes with the command."""
    words = ("ip", "link", "add", "dev", "doctor0", "type", "vcan")
    output_of(*throwaway_namespace(), *words, name="ip link add type vcan")
    return "a vcan device could be made"


def throwaway_namespace() -> tuple[str, ...]:
    """The words to put before a command that needs a network of its own, and rights in it."""
    if shutil.which("unshare") is None:
        raise MissingError("unshare (package util-linux) is not installed")
    mine = () if os.geteuid() == 0 else ("--user", "--map-root-user")
    return ("unshare", *mine, "--net")
