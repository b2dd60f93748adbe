"""The driver on a real python-can bus within this process, its threads running."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from pathlib import Path

import can
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from edge_runtime.config import DEFAULT_BUS, Config, SimilaritySettings
from edge_runtime.tests.harness import wait_until
from edge_runtime.tests.rigs import CAR, LEFT_TURN, PEDAL
from edge_runtime.util import UserError
from edge_runtime.vehicles import make_vehicle, stream, vehicle_limits
from edge_runtime.vehicles.core import State
from edge_runtime.vehicles.hunter import (
    GROUP,
    PORT,
    BusName,
    Gate,
    HunterVehicle,
    open_bus,
    parse_bus,
    protocol,
)

_numbers = itertools.count()


class Chassis:
    """Answers as a chassis that obeys at once; keeps every frame that it heard."""

    def __init__(self, channel):
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.heard: list = []
        self.answers = True
        self.status = protocol.SystemStatus(0, protocol.STANDBY, 24.0, 0, 1, 0)
        self._stopping = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while not self._stopping:
            message = self.bus.recv(0.05)
            if message is None:
                continue
            self.heard.append((message.arbitration_id, bytes(message.data)))
            told = protocol.decode(*self.heard[-1])
            if isinstance(told, protocol.ModeCommand):
                self.status = self.status._replace(mode=told.mode)
            elif isinstance(told, protocol.BrakeCommand):
                self.status = self.status._replace(brake=told.locked)
            elif isinstance(told, protocol.MotionCommand) and self.answers:
                self.send(protocol.MOTION_STATUS, protocol.MotionStatus(*told))
                self.status = self.status._replace(counter=(self.status.counter + 1) % 256)
                self.send(protocol.SYSTEM_STATUS, self.status)

    def send(self, frame, message):
        data = protocol.encode(frame, message)
        message = can.Message(arbitration_id=frame.can_id, data=data, is_extended_id=False)
        self.bus.send(message, timeout=0.1)

    @property
    def speeds(self):
        return [
            protocol.decode(*heard).speed_mps for heard in list(self.heard) if heard[0] == 0x111
        ]

    def close(self):
        self._stopping = True
        self._thread.join(5.0)
        self.bus.shutdown()


@pytest.fixture
def channel():
    return f"hunter-{next(_numbers)}"


@pytest.fixture
def chassis(channel):
    chassis = Chassis(channel)
    yield chassis
    chassis.close()


@pytest.fixture
def vehicle(channel):
    vehicle = HunterVehicle(BusName("virtual", channel, None), LEFT_TURN, "v2")
    yield vehicle
    vehicle.close()


@pytest.fixture
def enabled(chassis, vehicle):
    enable(vehicle)
    return vehicle


@pytest.fixture
def driving(chassis, enabled):
    drive(enabled, lambda: chassis.speeds[-1] > 0.2, "speed")
    return enabled


def drive(vehicle, until, what):
    """Full throttle at 10 Hz until something holds."""

    def step():
        vehicle.command(PEDAL, time.monotonic())
        return until()

    wait_until(step, what)


def enable(vehicle):
    vehicle.enable(time.monotonic())
    wait_until(lambda: vehicle.state is State.ENABLED, "the confirmation")


def test_the_stream_keeps_the_manuals_period():
    assert protocol.MOTION_COMMAND.period_s == stream.PERIOD_S


def test_it_enables_drives_brakes_and_parks(chassis, vehicle):
    time.sleep(0.1)
    assert chassis.heard == []
    enable(vehicle)
    drive(vehicle, lambda: chassis.speeds[-1] > 0.2, "speed")
    report = vehicle.feedback(time.monotonic())
    assert report.speed_mps > 0.1
    assert report.scenario_speed_mps == pytest.approx(4 * report.speed_mps)
    vehicle.brake(time.monotonic())
    wait_until(lambda: chassis.speeds[-1] == 0.0, "a stand")
    vehicle.command(PEDAL, time.monotonic())
    count = len(chassis.speeds)
    wait_until(lambda: len(chassis.speeds) > count + 5, "the stream going on")
    assert set(chassis.speeds[count:]) == {0.0}
    enable(vehicle)
    drive(vehicle, lambda: chassis.speeds[-1] > 0.2, "speed again")
    vehicle.close()
    wait_until(lambda: chassis.heard[-1] == (0x421, b"\x00"), "control given back")
    assert (0x131, b"\x01") in chassis.heard[-3:]
    assert {can_id for can_id, _ in chassis.heard} <= {0x111, 0x131, 0x421}
    assert not [t for t in threading.enumerate() if t.name.startswith("hunter-")]
    vehicle.close()


def test_commands_that_cease_end_in_a_latched_stop(chassis, driving):
    wait_until(lambda: driving.state is State.STOPPED, "its own stop")
    assert driving.feedback(time.monotonic()).faults == ["no command for 0.24 s"]
    wait_until(lambda: chassis.speeds[-1] == 0.0, "a stand")


def test_its_own_stop_does_not_wait_for_the_next_period(chassis, driving, monkeypatch):
    monkeypatch.setattr(stream, "PERIOD_S", 3.0)
    time.sleep(0.05)  # one more period of before
    commanded_s = time.monotonic()
    driving.command(PEDAL, commanded_s)
    wait_until(lambda: chassis.speeds[-1] == 0.0, "its own stop")
    assert time.monotonic() - commanded_s < 1.5


def test_a_frame_that_was_held_up_is_followed_at_once_by_one_of_now(driving, monkeypatch):
    sent: list = []
    send = driving._bus.send

    def stopped_in_between(message, timeout=None):
        if not sent and driving.state is State.ENABLED:
            monkeypatch.setattr(stream, "PERIOD_S", 0.4)
            time.sleep(0.5)  # the whole process, as far as the frame can tell
        send(message, timeout=timeout)
        told = protocol.decode(message.arbitration_id, message.data)
        sent.append((time.monotonic(), told.speed_mps))

    monkeypatch.setattr(driving._bus, "send", stopped_in_between)
    wait_until(lambda: len(sent) > 1, "the next frame")
    (held_s, held_mps), (next_s, next_mps) = sent[:2]
    assert held_mps > 0.2
    assert next_mps == 0.0
    assert next_s - held_s < 0.15


def test_a_bus_that_is_full_neither_blocks_nor_kills_the_stream(channel, vehicle):
    with can.Bus(interface="virtual", channel=channel, rx_queue_size=3) as crowd:
        vehicle.enable(time.monotonic())
        wait_until(lambda: vehicle.state is State.STOPPED, "its stop")
        assert "the CAN bus fails: Could not send" in vehicle.feedback(time.monotonic()).faults[0]
        assert vehicle.feedback(time.monotonic()).standing
        began_s = time.monotonic()
        vehicle.command(PEDAL, time.monotonic())
        vehicle.brake(time.monotonic())
        assert time.monotonic() - began_s < 5.0  # a bus that is waited for is waited for for ever
        while crowd.recv(0.0) is not None:
            pass
        assert crowd.recv(5.0) is not None  # it sends as soon as it can


def test_what_waited_before_it_listened_is_not_taken_for_fresh(chassis, vehicle):
    for _ in range(100):
        chassis.send(protocol.MOTION_STATUS, protocol.MotionStatus(1.0, 0.0))
    vehicle.feedback(time.monotonic())  # from now on it listens
    time.sleep(0.2)
    assert vehicle.feedback(time.monotonic()).speed_mps == 0.0
    chassis.send(protocol.MOTION_STATUS, protocol.MotionStatus(0.5, 0.0))
    wait_until(lambda: vehicle.feedback(time.monotonic()).speed_mps == 0.5, "what comes now")


def test_random_frames_on_the_bus_never_move_it(chassis, enabled):
    with can.Bus(interface="virtual", channel=chassis.bus.channel_id) as junk:
        for number in range(2000):
            message = can.Message(
                arbitration_id=number * 7919 % 0x800,
                data=(number * 2654435761 % 2**64).to_bytes(8, "big")[: number % 9],
                is_extended_id=number % 5 == 0,
            )
            junk.send(message, timeout=0.1)
    assert len(enabled.feedback(time.monotonic()).faults) <= 3
    assert enabled._stream._thread.is_alive()
    assert enabled._listener.is_alive()
    assert set(chassis.speeds) == {0.0}


def test_nothing_passes_the_gate_before_it_is_opened_and_then_only_our_frames(channel):
    with can.Bus(interface="virtual", channel=channel) as receiver, can.Bus(
        interface="virtual", channel=channel
    ) as sender:
        gate = Gate(sender)
        with pytest.raises(RuntimeError, match="before the vehicle is enabled"):
            gate.send(protocol.MOTION_COMMAND, bytes(8))
        gate.open()
        for frame in protocol.FEEDBACK:
            with pytest.raises(RuntimeError, match="allow-list"):
                gate.send(frame, bytes(frame.length))
        with pytest.raises(RuntimeError, match="allow-list"):
            gate.send(protocol.MOTION_COMMAND, bytes(7))
        assert receiver.recv(0.0) is None
        for frame in protocol.COMMANDS:
            gate.send(frame, bytes(frame.length))
            message = receiver.recv(1.0)
            assert message is not None
            assert (message.arbitration_id, message.is_extended_id) == (frame.can_id, False)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("socketcan:can0", BusName("socketcan", "can0", None)),
        ("udp_multicast:239.1.2.3:7", BusName("udp_multicast", "239.1.2.3", None, 7)),
        ("slcan:/dev/ttyACM0", BusName("slcan", "/dev/ttyACM0", 500_000)),
        ("slcan:/dev/ttyACM0:250000", BusName("slcan", "/dev/ttyACM0", 250_000)),
        ("udp_multicast:", BusName("udp_multicast", GROUP, None, PORT)),
        ("udp_multicast:239.1.2.3", BusName("udp_multicast", "239.1.2.3", None, PORT)),
    ],
)
def test_names_of_buses(text, name):
    assert parse_bus(text) == name


NO_BUS = "write it as INTERFACE:CHANNEL"
NO_GROUP = "write it as udp_multicast:239"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *(
            (text, NO_BUS)
            for text in ("", "can0", "socketcan:", ":can0", "slcan:a:fast", "slcan:a:0")
        ),
        ("socketcan:can0:500000", "'socketcan:can0:500000'.*ip link.*write socketcan:can0$"),
        *(
            (f"udp_multicast:{channel}", NO_GROUP)
            for channel in (
                "10.0.0.1", "239.1.2.3:0", "239.1.2.3:70000", "239.1.2:3", "ff15::1", "any",
                "239.1.2.3:",
            )
        ),
    ],
)  # fmt: skip
def test_what_is_no_name_of_a_bus_is_refused_in_one_line(text, words):
    with pytest.raises(UserError, match=words) as refused:
        parse_bus(text)
    assert "\n" not in str(refused.value)


def test_buses_that_cannot_be_opened_are_one_line(caplog):
    for text, words in (
        ("socketcan:can97", "bus socketcan:can97 cannot be opened"),
        ("nosuch:can0", "choose from .*socketcan"),
        ("slcan:/dev/nothing", "/dev/nothing.*manual says what its slcan needs"),
        ("kvaser:0", "bus kvaser:0 cannot be opened"),
    ):
        with pytest.raises(UserError, match=words) as caught:
            open_bus(parse_bus(text))
        assert "\n" not in str(caught.value)
    assert caplog.records == []  # a line of a library would be a second one


def test_python_can_is_asked_for_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "can", None)
    with pytest.raises(UserError, match=r"pip install 'phil-edge-runtime\[can\]'"):
        open_bus(parse_bus(DEFAULT_BUS))


def test_the_registry_makes_it_for_a_known_scenario_only(channel):
    bus = f"virtual:{channel}"
    vehicle = make_vehicle("hunter", Config(bus=bus), "left_turn")
    assert isinstance(vehicle, HunterVehicle)
    vehicle.close()
    assert vehicle.limits == vehicle_limits("hunter", Config(), "left_turn")
    for make in (make_vehicle, vehicle_limits):
        with pytest.raises(UserError, match="parking"):
            make("hunter", Config(bus=bus), "parking")
    config = Config(bus=bus, similarity=SimilaritySettings(scale=0.1, car=CAR))
    vehicle = make_vehicle("hunter", config, "parking")
    assert isinstance(vehicle, HunterVehicle)
    assert vehicle._core.similarity.scale == 0.1
    vehicle.close()


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
    count = 300
    with open_bus(parse_bus(name)) as near, open_bus(parse_bus(name)) as far:
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


def test_what_is_sent_through_a_networks_device_is_not_heard():
    """As a neighbour's frames come: the kernel loops them back from the device they leave by."""
    port = free_udp_port()
    with open_bus(parse_bus(f"udp_multicast:{GROUP}:{port}")) as far, socket.socket(
        socket.AF_INET, socket.SOCK_DGRAM
    ) as stranger, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        asked.connect(("192.0.2.1", 9))  # our address on a network; nothing is sent
        device = socket.inet_aton(asked.getsockname()[0])
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, device)
        frame = can.Message(arbitration_id=0x111, data=bytes(8), is_extended_id=False)
        stranger.sendto(pack_message(frame), (GROUP, port))
        assert far.recv(0.2) is None
