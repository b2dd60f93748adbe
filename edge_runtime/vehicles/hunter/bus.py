"""The CAN bus: opened with errors that help, and a gate that only lets our own frames out.

python-can is imported here and nowhere else in the runtime, and only when a bus is opened: a
board without a CAN vehicle need not have it.
"""

from __future__ import annotations

import logging
from typing import Any, Dict, NamedTuple, Optional

from edge_runtime.errors import UserError
from edge_runtime.vehicles.hunter import multicast
from edge_runtime.vehicles.hunter.frames import BITRATE, COMMANDS, Frame

DEFAULT_BUS = "socketcan:can0"
SYNTAX = "INTERFACE:CHANNEL or INTERFACE:CHANNEL:BITRATE, like socketcan:can0"
# Without a bit rate: the first has it from `ip link`, the others know none.
_WITHOUT_BITRATE = ("socketcan", "virtual")
# Pinned to the loopback device as well: no neighbour hears it either way.
_OPTIONS: Dict[str, Dict[str, Any]] = {"udp_multicast": {"hop_limit": 0, "fd": False}}
_ERROR_BUS_OFF = 0x40  # of SocketCAN's error frames (linux/can/error.h)


class BusName(NamedTuple):
    """What to open. `bitrate` is None where the interface has none to set."""

    interface: str
    channel: str
    bitrate: Optional[int]
    port: Optional[int] = None  # of udp_multicast

    @property
    def hears_itself(self) -> bool:
        """Whether our own frames come back: then a command need not be somebody else's."""
        return self.interface == "udp_multicast"


def parse_bus(text: str) -> BusName:
    """The bus of INTERFACE:CHANNEL[:BITRATE]. Raises UserError for anything else."""
    interface, _, channel = text.partition(":")
    if interface == "udp_multicast":
        return _parse_multicast(text, channel)
    if interface == "socketcan" and ":" in channel:
        raise UserError(
            f"bus {text!r} has its bit rate from `ip link`:"
            f" write {interface}:{channel.partition(':')[0]}"
        )
    if interface in _WITHOUT_BITRATE:
        if interface and channel:
            return BusName(interface, channel, None)
    elif interface and channel:
        channel, _, rate = channel.partition(":")
        if channel and (not rate or (rate.isdecimal() and int(rate) > 0)):
            return BusName(interface, channel, int(rate) if rate else BITRATE)
    raise UserError(f"bus {text!r} is no CAN bus: write it as {SYNTAX}")


def _parse_multicast(text: str, channel: str) -> BusName:
    found = multicast.parse_channel(channel)
    if found is None:
        raise UserError(
            f"bus {text!r} is no IPv4 multicast group and port: write it as {multicast.SYNTAX}"
        )
    return BusName("udp_multicast", found[0], None, found[1])


def open_bus(name: BusName) -> Any:
    """An open python-can bus; nothing is sent. Raises UserError, one line that says what to do."""
    can = import_can()
    options = dict(_OPTIONS.get(name.interface, {}))
    if name.bitrate is not None:
        options["bitrate"] = name.bitrate
    if name.port is not None:
        options["port"] = name.port
    try:
        bus = can.Bus(interface=name.interface, channel=name.channel, **options)
    except Exception as error:  # each backend raises what its library raises, NameError included
        raise UserError(_explain(name, error)) from None
    if name.interface == "udp_multicast":
        _pin(name, bus)
    return bus


def _pin(name: BusName, bus: Any) -> None:
    try:
        multicast.pin_to_loopback(bus, name.channel)
    except OSError as error:
        bus.shutdown()
        raise UserError(_explain(name, error)) from None


def import_can() -> Any:
    """The python-can package. Raises UserError where it is not installed."""
    # Its backends say on stderr what they miss; our error says it in its one line.
    logging.getLogger("can").setLevel(logging.CRITICAL)
    try:
        import can
    except ImportError:
        raise UserError(
            "the hunter needs python-can, which is not installed:"
            " pip install 'phil-edge-runtime[can]'"
        ) from None
    return can


def _explain(name: BusName, error: Exception) -> str:
    where = f"the CAN bus {name.interface}:{name.channel} cannot be opened"
    cause = " ".join(str(error).split()) or type(error).__name__
    number = getattr(error, "errno", None) or getattr(error, "error_code", None)
    if name.interface == "socketcan":
        if isinstance(error, PermissionError) or number == 1:
            return f"{where}: {cause}; this user may not open a CAN socket"
        if number == 97:
            return f"{where}: {cause}; this kernel has no SocketCAN (modprobe can_raw)"
        return (
            f"{where}: {cause}; bring it up with"
            f" `ip link set {name.channel} up type can bitrate {BITRATE}`, `ip link` lists them"
        )
    if "Unknown interface" in cause:
        can = import_can()
        return f"{where}: choose from {', '.join(sorted(can.VALID_INTERFACES))}"
    if name.interface == "udp_multicast":
        return f"{where}: {cause}; it needs msgpack, and a route for multicast (`ip route`)"
    return f"{where}: {cause}; python-can's manual says what its {name.interface} needs"


class Gate:
    """The only way out to the bus: closed until `open`, and then for our commands only."""

    def __init__(self, bus: Any) -> None:
        self._bus = bus
        self._can = import_can()
        self._is_open = False

    def open(self) -> None:
        """From now on our commands may pass."""
        self._is_open = True

    def send(self, frame: Frame, data: bytes) -> None:
        """Put a frame on the bus without waiting.

        Raises can.CanError or OSError where the bus does not take it, and RuntimeError, before
        anything is sent, for a frame that must not leave.
        """
        if not self._is_open:
            raise RuntimeError("nothing is sent before the vehicle is enabled")
        if frame not in COMMANDS or len(data) != frame.length:
            raise RuntimeError(
                f"0x{frame.can_id:x} with {len(data)} bytes is not on the allow-list"
            )
        message = self._can.Message(
            arbitration_id=frame.can_id, data=data, is_extended_id=False, check=True
        )
        # Not None: the virtual bus would then wait for ever where a receiver's queue is full.
        self._bus.send(message, timeout=0.0)


def is_bus_off(message: Any) -> bool:
    """Whether a received message is the controller's word that it has left the bus."""
    return bool(message.is_error_frame and message.arbitration_id & _ERROR_BUS_OFF)
