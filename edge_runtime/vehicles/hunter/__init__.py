"""AgileX Hunter 2.0 and SE: the CAN bus, the gate that lets our own frames out only, the driver.

python-can is imported here and nowhere else in the runtime, and only when a bus is opened: a board
without a CAN vehicle need not have it. Two threads are around the core (core.py):

- The stream's thread sends what `tick` gives, 50 times a second at absolute deadlines, and at
  once when somebody brakes, no command came in time, or the chassis says what stops it. It is
  the only one that sends, until `close` has joined it.
- The listener's thread hands every frame to `hear`.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import logging
import os
import re
import socket
import struct
import threading
import time
from typing import Any, ClassVar, Dict, NamedTuple, Optional, Type

from edge_runtime import log
from edge_runtime.config import check_choice
from edge_runtime.util import UserError
from edge_runtime.vehicles.core import VehicleState
from edge_runtime.vehicles.hunter.core import HunterCore
from edge_runtime.vehicles.hunter.protocol import (
    BITRATE,
    COMMAND_IDS,
    COMMANDS,
    DEFAULT_PROFILE,
    PROFILES,
    Frame,
)
from edge_runtime.vehicles.mapping import RobotSettings, Similarity
from edge_runtime.vehicles.stream import PERIOD_S, StreamedVehicle

_LISTEN_S = 0.1
_JOIN_S = 0.5

DEFAULT_BUS = "socketcan:can0"
UDP = "udp_multicast"
GROUP, PORT = "239.74.163.2", 43113  # python-can's own
# Two buses need two ports: Linux hands what comes for any group to every socket of its port.
MULTICAST_BUS = f"{UDP}:{GROUP}:{PORT}"
_LOOPBACK = "lo"
_ERROR_BUS_OFF = 0x40  # of SocketCAN's error frames (linux/can/error.h)
_SYNTAX = {
    "socketcan": f"{DEFAULT_BUS}; its bit rate is set by `ip link`",
    UDP: MULTICAST_BUS,
    "": "INTERFACE:CHANNEL or INTERFACE:CHANNEL:BITRATE, like socketcan:can0",
}
_ADVICE = {
    "socketcan": "bring it up with `ip link set CHANNEL up type can bitrate 500000`",
    UDP: "it needs msgpack, and a route for multicast (`ip route`)",
    "": "see python-can's manual for what this interface needs",
}


class BusName(NamedTuple):
    """What to open. `bitrate` is None where the interface has none to set."""

    interface: str
    channel: str
    bitrate: Optional[int]
    port: Optional[int] = None  # of udp_multicast


def parse_bus(text: str) -> BusName:
    """Parse INTERFACE:CHANNEL[:BITRATE], udp_multicast:GROUP[:PORT] too. Raises UserError."""
    interface, _, channel = text.partition(":")
    name, colon, number = channel.partition(":")
    count = int(number) if re.fullmatch("[0-9]{1,9}", number) else 0
    if interface == "virtual" and channel:
        return BusName(interface, channel, None)
    if interface == UDP:
        port, group = count if colon else PORT, name or GROUP
        with contextlib.suppress(ValueError):  # no address
            if ipaddress.IPv4Address(group).is_multicast and 1 <= port <= 65535:
                return BusName(interface, group, None, port)
    elif interface and name and not colon:
        return BusName(interface, name, None if interface == "socketcan" else BITRATE)
    elif interface != "socketcan" and interface and name and count:
        return BusName(interface, name, count)
    syntax = _SYNTAX.get(interface, _SYNTAX[""])
    kind = "IPv4 multicast group and port" if interface == UDP else "CAN bus"
    raise UserError(f"bus {text!r} is no {kind}: write it as {syntax}")


def open_bus(name: BusName) -> Any:
    """Open a python-can bus; send nothing. Raises UserError."""
    can = import_can()
    options: Dict[str, Any] = {} if name.bitrate is None else {"bitrate": name.bitrate}
    if name.port is not None:  # pinned to the loopback device as well: no neighbour hears it
        options = {"port": name.port, "hop_limit": 0, "fd": False}
    bus = None
    try:
        bus = can.Bus(interface=name.interface, channel=name.channel, **options)
        if name.port is not None:
            pin_to_loopback(bus, name.channel)
    except Exception as error:  # each backend raises what its library raises, NameError included
        if bus is not None:
            bus.shutdown()
        where, cause = f"{name.interface}:{name.channel}", str(error) or type(error).__name__
        advice = _ADVICE.get(name.interface, _ADVICE[""])
        raise UserError(f"the CAN bus {where} cannot be opened: {cause}; {advice}") from None
    return bus


def pin_to_loopback(bus: Any, group: str) -> None:
    """Let the python-can bus speak and hear on the loopback device only. Raises OSError.

    It sends to whatever network the machine has. Pinned, no frame leaves the machine and none comes
    in from outside, whoever sends it to the group or to the port; that needs no privilege (Linux
    5.7 or newer), only a route for multicast, which any machine with a network has.
    """
    device = socket.if_nametoindex(_LOOPBACK)
    member = struct.pack("=4s4xi", socket.inet_aton(group), device)  # struct ip_mreqn
    sender = struct.pack("=8xi", device)
    with socket.socket(fileno=os.dup(bus.fileno())) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _LOOPBACK.encode() + b"\0")
        try:
            same.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:  # python-can joined there: it is the only device
                raise
        same.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, sender)
    while bus.recv(0.0) is not None:
        pass  # from before


def import_can() -> Any:
    """Return the python-can package. Raises UserError where it is not installed."""
    # Its backends say on stderr what they miss; our error says it in its one line.
    logging.getLogger("can").setLevel(logging.CRITICAL)
    try:
        import can
    except ImportError:
        words = "the hunter needs python-can, which is not installed: pip install python-can"
        raise UserError(words) from None
    return can


class Gate:
    """The only way out to the bus: closed until `is_open`, and then for our commands only."""

    def __init__(self, bus: Any) -> None:
        self.is_open = False
        self._bus, self._can = bus, import_can()

    def send(self, frame: Frame, data: bytes) -> None:
        """Put a frame on the bus without waiting.

        Raises can.CanError or OSError where the bus does not take it, and RuntimeError, before
        anything is sent, for a frame that must not leave.
        """
        if not self.is_open:
            raise RuntimeError("nothing is sent before the vehicle is enabled")
        can_id, length = frame.can_id, len(data)
        if frame not in COMMANDS or length != frame.length:
            raise RuntimeError(f"0x{can_id:x} with {length} bytes is not on the allow-list")
        message = self._can.Message(
            arbitration_id=can_id, data=data, is_extended_id=False, check=True
        )
        # Not None: the virtual bus would then wait for ever where a receiver's queue is full.
        self._bus.send(message, timeout=0.0)


class HunterSettings(RobotSettings, frozen=True, kw_only=True):
    """[vehicle.hunter]: its bus, and a row of protocol.PROFILES."""

    bus: str = DEFAULT_BUS
    profile: str = DEFAULT_PROFILE

    def __post_init__(self) -> None:
        parse_bus(self.bus)
        check_choice("vehicle.hunter.profile", self.profile, tuple(PROFILES))


class HunterVehicle(StreamedVehicle):
    """Opens its bus when made (UserError where it cannot), and sends nothing before `enable`."""

    name: ClassVar[str] = "hunter"
    settings_type: ClassVar[Type[RobotSettings]] = HunterSettings

    def __init__(self, settings: HunterSettings, similarity: Similarity) -> None:
        bus = parse_bus(settings.bus)
        self._bus: Any = open_bus(bus)
        self._gate = Gate(self._bus)
        # Our own frames come back there: a command need not be somebody else's.
        self._ignores_commands = bus.interface == UDP
        self._core: HunterCore
        super().__init__(HunterCore(similarity, settings.profile))
        self._stopping = False
        self._listener = threading.Thread(target=self._listen, name="hunter-listener", daemon=True)
        self._stream.start()
        self._listener.start()

    def enable(self, now_s: float) -> None:
        """Ask the chassis for control; `feedback` tells whether it came. Nothing once closed."""
        self._gate.is_open = True  # the core gives no frame before it is enabled
        super().enable(now_s)

    def _leave(self) -> None:
        """Lock the brake, give control back, and leave the bus."""
        self._stopping = True
        self._listener.join(_JOIN_S)
        with self._lock:
            parts = self._core.close(time.monotonic())
        try:
            for part in parts:
                self._gate.send(*part)
        except Exception as error:  # the chassis stops by itself, and the bus must be freed
            log.event("warning", "hunter_not_parked", detail=error)
        self._bus.shutdown()

    def _send_due(self) -> bool:
        with self._lock:
            parts = self._core.tick(time.monotonic())
        try:
            for part in parts:
                self._gate.send(*part)
        except Exception as error:  # CanError, OSError, or what else a backend raises
            self._note_bus(error)
            return False
        if parts:
            with self._lock:
                self._core.bus_works()
        return bool(parts)

    def _listen(self) -> None:
        while not self._stopping:
            try:
                message = self._bus.recv(_LISTEN_S)
            except Exception as error:  # as in _send_due; it may raise at once, again and again
                self._note_bus(error)
                time.sleep(PERIOD_S)
                continue
            if message is not None:
                self._hear(message)

    def _hear(self, message: Any) -> None:
        if message.is_error_frame:
            if message.arbitration_id & _ERROR_BUS_OFF:
                self._note_bus("bus-off", fatal=True)
            return
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            return  # no frame of this protocol
        if self._ignores_commands and message.arbitration_id in COMMAND_IDS:
            return
        with self._lock:
            was = self._core.state
            self._core.hear(message.arbitration_id, bytes(message.data), time.monotonic())
            stopped = self._core.state is VehicleState.STOPPED and was is not VehicleState.STOPPED
        if stopped:
            self._stream.wake()

    def _note_bus(self, error: object, fatal: bool = False) -> None:
        words = " ".join(str(error).split()) or type(error).__name__
        with self._lock:
            self._core.bus_failed(words, time.monotonic(), fatal)
