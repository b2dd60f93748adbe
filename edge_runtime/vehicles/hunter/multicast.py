"""The CAN bus between processes of one machine: UDP multicast, pinned to the loopback device.

python-can sends to whatever network the machine has. Pinned, no frame leaves the machine and none
comes in from outside, whoever sends it to the group or to the port; that needs no privilege (Linux
5.7 or newer), only a route for multicast, which any machine with a network has.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import re
import socket
import struct
from typing import Any, Optional, Tuple

GROUP, PORT = "239.74.163.2", 43113  # python-can's own
# Two buses need two ports: Linux hands what comes for any group to every socket of its port.
SYNTAX = f"udp_multicast:{GROUP}:{PORT}"
_LOOPBACK = "lo"
_ANY = bytes(4)
_GROUP_AND_PORT = re.compile(r"([0-9.]+)(?::([0-9]{1,5}))?")


def parse_channel(channel: str) -> Optional[Tuple[str, int]]:
    """GROUP and PORT of an IPv4 group, GROUP:PORT or nothing; None for what is neither."""
    found = _GROUP_AND_PORT.fullmatch(channel or GROUP)
    if found is None:
        return None
    group, port = found[1], int(found[2] or PORT)
    return (group, port) if _is_group(group) and 1 <= port <= 65535 else None


def pin_to_loopback(bus: Any, group: str) -> None:
    """Let the python-can bus speak and hear on the loopback device only. Raises OSError."""
    device = socket.if_nametoindex(_LOOPBACK)
    member = struct.pack("=4s4si", socket.inet_aton(group), _ANY, device)  # struct ip_mreqn
    sender = struct.pack("=4s4si", _ANY, _ANY, device)
    with socket.socket(fileno=os.dup(bus.fileno())) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _LOOPBACK.encode() + b"\0")
        _join(same, member)
        same.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, sender)
    while bus.recv(0.0) is not None:
        pass  # from before


def _join(bus_socket: socket.socket, member: bytes) -> None:
    try:
        bus_socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:  # python-can joined there: it is the only device
            raise


def _is_group(text: str) -> bool:
    try:
        return ipaddress.IPv4Address(text).is_multicast
    except ValueError:
        return False
