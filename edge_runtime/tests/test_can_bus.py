"""Names of CAN buses; and that the bus between processes stays on this machine."""

import socket
import time
from pathlib import Path

import can
import pytest

from edge_runtime.errors import UserError
from edge_runtime.vehicles.can_bus import DEFAULT_GROUP, DEFAULT_PORT, BusName, open_bus, parse_bus


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("socketcan:can0", BusName("socketcan", "can0")),
        ("virtual:test", BusName("virtual", "test")),
        ("udp_multicast:", BusName("udp_multicast", DEFAULT_GROUP, DEFAULT_PORT)),
        ("udp_multicast:ff01::1", BusName("udp_multicast", "ff01::1", DEFAULT_PORT)),
        ("udp_multicast:[ff01::1]", BusName("udp_multicast", "ff01::1", DEFAULT_PORT)),
        ("udp_multicast:[ff01::1]:5", BusName("udp_multicast", "ff01::1", 5)),
    ],
)
def test_a_name_is_read(text, name):
    assert parse_bus(text) == name


@pytest.mark.parametrize(
    "text",
    [
        "", "can0", "socketcan", "socketcan:", "pcan:1", "udp_multicast:ff15::1",
        "udp_multicast:239.74.163.2", "udp_multicast:[ff01::1]:0", "udp_multicast:[ff01::1]:70000",
        "udp_multicast:[ff01::1", "udp_multicast:ff01::zz", "udp_multicast:[fe80::1]:1",
    ],
)  # fmt: skip
def test_another_one_is_refused_in_one_line(text):
    with pytest.raises(UserError, match="is not valid") as refused:
        parse_bus(text)
    assert "\n" not in str(refused.value)


def test_what_is_not_there_is_refused_in_one_line():
    with pytest.raises(UserError, match="ip link set"):
        open_bus("socketcan:no_such_bus")


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
    name = f"udp_multicast:[{DEFAULT_GROUP}]:{free_udp_port()}"
    near, far = open_bus(name), open_bus(name)
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
