"""The session that speaks to ROS 2: apart from our wire's, and in plain text."""

from __future__ import annotations

from typing import Optional

import zenoh

from edge_runtime.errors import UserError
from edge_runtime.tls import is_tls
from edge_runtime.transport import check_endpoint, open_session

# Beside our own 7447, where a bridge listens by default, too; and of this machine only.
DEFAULT_ROS2_ENDPOINT = "tcp/127.0.0.1:7448"


def check_ros2_endpoint(endpoint: Optional[str]) -> None:
    """Raise UserError for an endpoint (None is one that was not given) that cannot be used."""
    if endpoint is not None and is_tls(check_endpoint(endpoint)):
        raise UserError(
            f"endpoint {endpoint} is not for the ROS 2 side: it speaks plain text, as DDS does;"
            " use tcp/ or udp/ on one machine, or inside a tunnel"
        )


def open_ros2_session(
    listen: Optional[str], connect: Optional[str], option: str = "--ros2-listen"
) -> zenoh.Session:
    """Listen as a router (the default, on loopback), or go on connecting to a bridge as a peer.

    Raises UserError for a malformed endpoint and for a busy port; `option` is where the user has
    set `listen`.
    """
    check_ros2_endpoint(listen)
    check_ros2_endpoint(connect)
    if connect is not None:
        return open_session(connect=connect, mode="peer")
    try:
        return open_session(listen=listen or DEFAULT_ROS2_ENDPOINT, mode="router")
    except UserError as error:
        raise UserError(str(error).replace("--listen", option)) from None
