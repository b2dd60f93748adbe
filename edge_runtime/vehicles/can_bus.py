"""Opens a CAN bus by its name in one piece: ``INTERFACE:CHANNEL``, as in ``socketcan:can0``.

``udp_multicast:[GROUP]:PORT`` is the bus between processes of one machine, for tests and the mock.
No frame of it leaves the machine, and none is let in: its group is of interface-local scope
(ff01::/16, RFC 4291 section 2.7), which the kernel neither sends to a network nor accepts from
one, and the hop limit is 0 besides. It needs no privilege, only a route for multicast, which any
machine with a network has. Buses need ports of their own: Linux hands a datagram for any joined
group to every socket of its port.
"""

from __future__ import annotations

import ipaddress
import re
from typing import TYPE_CHECKING, Any, Dict, NamedTuple

from edge_runtime.errors import UserError

if TYPE_CHECKING:
    import can  # imported below only where a bus is opened: other vehicles do without

INTERFACES = ("socketcan", "udp_multicast", "virtual")
DEFAULT_GROUP = "ff01::7068:696c"  # "phil"
DEFAULT_PORT = 43113
BITRATE = 500_000  # of the Hunter's bus; SocketCAN has it from `ip link`
_GROUP_AND_PORT = re.compile(r"([0-9a-fA-F:]+)|\[([0-9a-fA-F:]+)\](?::(\d+))?")


class BusName(NamedTuple):
    """What ``INTERFACE:CHANNEL`` says. ``port`` is 0 but for udp_multicast."""

    interface: str
    channel: str
    port: int = 0


def parse_bus(text: str) -> BusName:
    """Raises UserError for an interface that is not known, and for a group that leaves lo."""
    interface, _, channel = text.partition(":")
    if interface not in INTERFACES or not (channel or interface == "udp_multicast"):
        raise UserError(
            f"bus {text!r} is not valid: use socketcan:can0, virtual:NAME, or"
            f" udp_multicast:[{DEFAULT_GROUP}]:{DEFAULT_PORT}"
        )
    if interface != "udp_multicast":
        return BusName(interface, channel)
    found = _GROUP_AND_PORT.fullmatch(channel or DEFAULT_GROUP)
    group = (found[1] or found[2]) if found else ""
    if found is None or not _is_interface_local(group):
        raise UserError(
            f"bus {text!r} is not valid: a group in ff01::/16, which stays on this machine,"
            f" as in udp_multicast:[{DEFAULT_GROUP}]:{DEFAULT_PORT}"
        )
    port = int(found[3] or DEFAULT_PORT)
    if not 1 <= port <= 65535:
        raise UserError(f"bus {text!r} is not valid: port {port} is not from 1 to 65535")
    return BusName(interface, group, port)


def open_bus(text: str, **options: Any) -> can.BusABC:
    """Open the bus of that name. Raises UserError in one line for what the system says to it.

    `options` go to python-can, as `can_filters` does.
    """
    name = parse_bus(text)
    import can

    more: Dict[str, Any] = {}
    if name.interface == "udp_multicast":
        more = {"port": name.port, "hop_limit": 0, "fd": False}
    try:
        return can.Bus(channel=name.channel, interface=name.interface, **more, **options)
    except (can.CanError, OSError, ImportError) as error:
        raise UserError(
            f"cannot open the CAN bus {text}: {_reason(error)}{_HELP[name.interface]}"
        ) from None


_HELP = {
    "socketcan": f"; is it up? `ip link set can0 up type can bitrate {BITRATE}`",
    "udp_multicast": "; it needs msgpack and a route for multicast (ip -6 route)",
    "virtual": "",
}


def _reason(error: BaseException) -> str:
    cause = error.__cause__
    return f"{error} ({cause})" if cause else str(error)


def _is_interface_local(group: str) -> bool:
    try:
        return ipaddress.IPv6Address(group) in ipaddress.IPv6Network("ff01::/16")
    except ValueError:
        return False
