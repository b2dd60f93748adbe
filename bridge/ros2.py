"""``python -m bridge ros2``: a listener of its own that shows the wire to ROS 2.

It has two sessions: one listens to our wire, as `view` does, the other one speaks to a
zenoh-bridge-ros2dds. So ROS 2 hears what we show it, and can say nothing on our wire.
"""

from __future__ import annotations

import contextlib
import functools
import time
from typing import Any

from bridge.arguments import add_connect, add_span, add_tls, add_vehicle_id
from bridge.feed import Feed, open_feed
from bridge.signals import sigterm_as_interrupt
from bridge.to_ros2.outlet import Outlet
from bridge.to_ros2.policies import Policies
from edge_runtime.cli import ArgumentParser, examples, number
from edge_runtime.commands import ask
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.tls import TlsFiles, tls_for
from edge_runtime.transport import check_endpoint
from edge_runtime.vehicles.ros2.names import (
    DEFAULT_ROS2_ENDPOINT,
    check_ros2_endpoint,
    check_ros_name,
    namespace_of,
    open_ros2_session,
)
from edge_runtime.vehicles.ros2.node import Ros2Node, open_node
from edge_runtime.wire import check_vehicle_id

POLL_S = 0.1
MAX_RATE_HZ = 20.0
_TOPICS = """

topics below the namespace: image_raw (sensor_msgs/Image), odom (nav_msgs/Odometry, dead reckoning),
command/ackermann (ackermann_msgs/AckermannDriveStamped), command/twist (geometry_msgs/Twist);
the last two show what is commanded: no driver listens there.
"""
EXAMPLE = (
    examples(
        "python -m bridge ros2 --vehicle-id hunter01\n"
        "    then on the same machine: zenoh-bridge-ros2dds -l tcp/127.0.0.1:7449"
        f" -e {DEFAULT_ROS2_ENDPOINT}\n"
        "    and in a ROS 2 shell:     ros2 topic echo /hunter01/odom",
        "python -m bridge ros2 --connect tls/10.0.0.2:7447 --tls certs/viewer --namespace /car",
        "python -m bridge ros2 --ros2-connect tcp/127.0.0.1:7449 --duration-s 60 --out ros2.json",
    )
    + _TOPICS
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_connect(parser)
    add_tls(parser)
    add_vehicle_id(parser, "the vehicle to show")
    side = parser.add_mutually_exclusive_group()
    side.add_argument(
        "--ros2-listen",
        metavar="PROTOCOL/HOST:PORT",
        help=f"where a zenoh-bridge-ros2dds connects to (default: {DEFAULT_ROS2_ENDPOINT})",
    )
    side.add_argument(
        "--ros2-connect",
        metavar="PROTOCOL/HOST:PORT",
        help="where a zenoh-bridge-ros2dds listens; it may come later",
    )
    parser.add_argument(
        "--namespace", metavar="NS", help="ROS namespace of the topics (default: /VEHICLE_ID)"
    )
    parser.add_argument(
        "--max-rate-hz",
        metavar="HZ",
        type=number("a rate above 0 and up to 1000 Hz", lambda rate_hz: 0.0 < rate_hz <= 1000.0),
        default=MAX_RATE_HZ,
        help="most messages a second on each topic; more are left out",
    )
    add_span(parser)
    parser.add_argument("--out", metavar="R.json", help="write the counts to this file at the end")


def run(arguments: Any) -> int:
    """Run the command until the simulator goes, the time is over, or somebody interrupts."""
    check_vehicle_id(arguments.vehicle_id)
    tls = tls_for(arguments.tls, check_endpoint(arguments.connect))
    for endpoint in (arguments.ros2_listen, arguments.ros2_connect):
        check_ros2_endpoint(endpoint)
    namespace = arguments.namespace
    if namespace is None:
        namespace = namespace_of(arguments.vehicle_id)
    check_ros_name(namespace, "namespace")
    if arguments.out is not None:
        check_writable(arguments.out)
    report = _run(arguments, namespace, tls)
    write_json_out(arguments.out, report)
    print(_summary(report))
    return 0


def _run(arguments: Any, namespace: str, tls: TlsFiles | None) -> dict[str, Any]:
    status = functools.partial(ask, arguments.connect, arguments.vehicle_id, "status", tls)
    with (
        sigterm_as_interrupt(),
        contextlib.closing(
            open_ros2_session(arguments.ros2_listen, arguments.ros2_connect)
        ) as session,
        open_feed(arguments.connect, arguments.vehicle_id, arguments.wait_s, tls) as feed,
        open_node(session, namespace) as node,
    ):
        outlet = Outlet(node, Policies(status), arguments.max_rate_hz)
        print(f"ready vehicle_id={arguments.vehicle_id} namespace={namespace}", flush=True)
        # Being interrupted is the ordinary way to end.
        with contextlib.suppress(KeyboardInterrupt):
            _show(feed, outlet, arguments.duration_s)
        return _report(feed, node, outlet)


def _show(feed: Feed, outlet: Outlet, duration_s: float | None) -> None:
    """Translate until the simulator has gone and the queue is empty, or the time is over."""
    end_s = None if duration_s is None else time.monotonic() + duration_s
    while end_s is None or time.monotonic() < end_s:
        heard = feed.next(POLL_S)
        if heard is not None:
            outlet.take(heard)
        elif feed.simulator_gone.is_set():
            return


def _report(feed: Feed, node: Ros2Node, outlet: Outlet) -> dict[str, Any]:
    return {
        "sent": node.sent,
        "rejected": dict(outlet.rejected),
        "skipped": outlet.skipped,
        "dropped": feed.dropped,
    }


def _summary(report: dict[str, Any]) -> str:
    parts = [f"{topic} {count}" for topic, count in report["sent"].items()]
    text = f"sent: {', '.join(parts)}"
    for what in ("rejected", "skipped"):
        if report[what]:
            counts = ", ".join(f"{name} {count}" for name, count in report[what].items())
            text += f"; {what}: {counts}"
    return text
