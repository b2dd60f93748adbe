"""The bus between processes: its name, and that no frame of it leaves the machine."""

import socket
import time
from pathlib import Path

import can
import pytest

from edge_runtime.errors import UserError
from edge_runtime.vehicles.hunter.bus import MULTICAST_GROUP, MULTICAST_PORT, open_bus, parse_bus


@pytest.mark.parametrize(
    ("text", "group", "port"),
    [
        ("udp_multicast:", MULTICAST_GROUP, MULTICAST_PORT),
        ("udp_multicast:ff01::1", "ff01::1", MULTICAST_PORT),
        ("udp_multicast:[ff01::1]", "ff01::1", MULTICAST_PORT),
        ("udp_multicast:[ff01::1]:5", "ff01::1", 5),
    ],
)
def test_a_group_and_a_port_are_read(text, group, port):
    name = parse_bus(text)
    assert (name.interface, name.channel, name.port) == ("udp_multicast", group, port)


@pytest.mark.parametrize(
    "channel",
    [
        "ff15::1", "239.74.163.2", "[ff01::1]:0", "[ff01::1]:70000", "[ff01::1", "ff01::zz",
        "[fe80::1]:1", "[ff01::1]:", "any",
    ],
)  # fmt: skip
def test_what_might_leave_the_machine_is_refused_in_one_line(channel):
    with pytest.raises(UserError, match="does not stay on this machine: use") as refused:
        parse_bus(f"udp_multicast:{channel}")
    assert "\n" not in str(refused.value)


def free_udp_port():
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as one:
        one.bind(("::", 0))
        return one.getsockname()[1]


def sent_packets():
    """Packets sent by each interface but the loopback's own."""
    lines = Path("/proc/net/dev").read_text().splitlines()[2:]
    fields = {line.split(":")[0].strip(): line.split(":")[1].split() for line in lines}
    return sum(int(values[9]) for name, values in fields.items() if name != "lo")


def test_frames_reach_the_other_end_and_no_network():
    name = f"udp_multicast:[{MULTICAST_GROUP}]:{free_udp_port()}"
    near, far = open_bus(parse_bus(name)), open_bus(parse_bus(name))
    count = 300
    try:
        before = sent_packets()
        for number in range(count):
            data = number.to_bytes(8, "big")
            near.send(can.Message(arbitration_id=0x111, data=data, is_extended_id=False))
            received = far.recv(1.0)
            assert received is not None
            assert (received.arbitration_id, bytes(received.data)) == (0x111, data)
        time.sleep(0.02)
        # The machine's own traffic goes on beside us; a frame each would be 300 and more.
        assert sent_packets() - before < count / 2
    finally:
        near.shutdown()
        far.shutdown()
