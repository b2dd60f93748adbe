"""A cable between two namespaces, in user space: two TUN devices and the latency model.

``python -m hil_tests.network.tun_bridge``: reads the IP packets of one device, asks the model when
each comes out, and writes it to the other device then. So the kernel's own TCP and UDP meet the
same network as a simulation in virtual time. Per packet, not per message: a state of 7.3 kB is
five packets at an MTU of 1500. Time 0 of outages is the first packet.

The devices live as long as this process: nothing is left to remove.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import select
import struct
import sys
import time
from typing import NamedTuple

from bridge.network import EventHeap, LatencyModel, make_link, parse_spec
from edge_runtime.cli import ArgumentParser, examples, run_cli, sigterm_as_interrupt
from hil_tests.network.namespaces import TUN_DEVICE, ip

SIMULATOR_ADDRESS, EDGE_ADDRESS = "10.77.0.1", "10.77.0.2"
MAX_PACKET_BYTES = 65_535
_TUNSETIFF = 0x400454CA
_IFF_TUN_NO_PI = 0x0001 | 0x1000
READY = "ready"


class Port(NamedTuple):
    """One end of the cable: what comes in here goes through the model and out at the other."""

    device: int
    model: LatencyModel
    counts: dict[str, int]


def open_device(name: str, namespace: str, address: str, peer: str, mtu: int) -> int:
    """Make a TUN device inside a namespace; its file descriptor.

    The descriptor stays with the device when that moves to another namespace.
    """
    device = os.open(TUN_DEVICE, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH14x", name.encode(), _IFF_TUN_NO_PI))
    ip("link", "set", name, "netns", namespace)
    inside = ("-netns", namespace)
    # No IPv6: its announcements would be packets that nobody sent.
    ip(*inside, "link", "set", name, "mtu", str(mtu), "addrgenmode", "none")
    ip(*inside, "address", "add", address, "peer", peer, "dev", name)
    ip(*inside, "link", "set", name, "up")
    return device


def carry(ports: dict[int, Port], ends: dict[int, int]) -> None:
    """Move packets until interrupted. ``ends``: where a device's packets come out."""
    under_way: EventHeap[tuple[int, bytes]] = EventHeap()
    first_s: float | None = None
    poll = select.poll()
    for device in ports:
        poll.register(device, select.POLLIN)
    while True:
        next_s = under_way.next_arrival_s()
        wait_ms = None if next_s is None else max(0.0, (next_s - time.monotonic()) * 1e3)
        for device, _ in poll.poll(wait_ms):
            now_s = time.monotonic()
            first_s = now_s if first_s is None else first_s
            _take(ports[device], ends[device], under_way, now_s, first_s)
        while due := under_way.pop_due(time.monotonic()):
            _write(*due[1])


def _take(
    port: Port,
    end: int,
    under_way: EventHeap[tuple[int, bytes]],
    now_s: float,
    first_s: float,
) -> None:
    packet = os.read(port.device, MAX_PACKET_BYTES)
    arrivals = port.model.arrivals(now_s - first_s, len(packet))
    port.counts["packets"] += 1
    port.counts["bytes"] += len(packet)
    port.counts["lost"] += not arrivals
    for arrival_s in arrivals:
        under_way.push(first_s + arrival_s, (end, packet))


def _write(device: int, packet: bytes) -> None:
    try:
        os.write(device, packet)
    except BlockingIOError:
        return  # As a full network card does; at these rates it never is.


def main(argv: list[str]) -> int:
    """Run the bridge; prints its counts as JSON at the end."""
    parser = ArgumentParser(
        prog="python -m hil_tests.network.tun_bridge",
        description=__doc__,
        epilog=examples("python -m hil_tests.network.tun_bridge --simulator ns1 --edge ns2"),
    )
    parser.add_argument("--simulator", required=True, help="namespace of the simulator")
    parser.add_argument("--edge", required=True, help="namespace of the edge runtime")
    parser.add_argument("--latency", default="none", help="as of bridge simulate")
    parser.add_argument("--seed", type=int, default=0, help="of delays and losses")
    parser.add_argument("--mtu", type=int, default=1500, help="largest packet, bytes")
    return _run(parser.parse_args(argv))


def _run(arguments: argparse.Namespace) -> int:
    link = make_link(parse_spec(arguments.latency), arguments.seed)
    names = (f"phs{os.getpid()}", f"phe{os.getpid()}")
    here, there = SIMULATOR_ADDRESS, EDGE_ADDRESS
    near = open_device(names[0], arguments.simulator, here, there, arguments.mtu)
    far = open_device(names[1], arguments.edge, there, here, arguments.mtu)
    counts = {side: dict.fromkeys(("packets", "bytes", "lost"), 0) for side in ("up", "down")}
    ports = {near: Port(near, link.up, counts["up"]), far: Port(far, link.down, counts["down"])}
    with sigterm_as_interrupt():
        try:
            print(READY, flush=True)
            carry(ports, {near: far, far: near})
        except KeyboardInterrupt:
            pass
    print(json.dumps(counts), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
