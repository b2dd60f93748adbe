"""The bus between processes: its name, and that no frame of it leaves the machine."""

import socket
import time
from pathlib import Path

import can
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from edge_runtime.errors import UserError
from edge_runtime.vehicles.hunter.bus import open_bus, parse_bus
from edge_runtime.vehicles.hunter.multicast import GROUP, PORT


@pytest.mark.parametrize(
    ("channel", "group", "port"),
    [("", GROUP, PORT), ("239.1.2.3", "239.1.2.3", PORT), ("239.1.2.3:7", "239.1.2.3", 7)],
)
def test_a_group_and_a_port_are_read(channel, group, port):
    name = parse_bus(f"udp_multicast:{channel}")
    assert (name.interface, name.channel, name.port) == ("udp_multicast", group, port)


@pytest.mark.parametrize(
    "channel",
    ["10.0.0.1", "239.1.2.3:0", "239.1.2.3:70000", "239.1.2:3", "ff15::1", "any", "239.1.2.3:"],
)
def test_what_is_no_group_is_refused_in_one_line(channel):
    with pytest.raises(UserError, match="write it as udp_multicast:239") as refused:
        parse_bus(f"udp_multicast:{channel}")
    assert "\n" not in str(refused.value)


def free_udp_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("", 0))
        return one.getsockname()[1]


def sent_packets():
    """Packets sent by each interface but the loopback's own."""
    lines = Path("/proc/net/dev").read_text().splitlines()[2:]
    fields = {line.split(":")[0].strip(): line.split(":")[1].split() for line in lines}
    return sum(int(values[9]) for name, values in fields.items() if name != "lo")


def test_frames_reach_the_other_end_and_no_network():
    name = f"udp_multicast:{GROUP}:{free_udp_port()}"
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


def address_on_a_network():
    """Ours on a network, by what the kernel would take for a datagram; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.connect(("192.0.2.1", 9))
        return one.getsockname()[0]


def test_what_is_sent_through_a_networks_device_is_not_heard():
    """As a neighbour's frames come: the kernel loops them back from the device they leave by."""
    port = free_udp_port()
    far = open_bus(parse_bus(f"udp_multicast:{GROUP}:{port}"))
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            device = socket.inet_aton(address_on_a_network())
            stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, device)
            frame = can.Message(arbitration_id=0x111, data=bytes(8), is_extended_id=False)
            stranger.sendto(pack_message(frame), (GROUP, port))
        assert far.recv(0.2) is None
    finally:
        far.shutdown()
