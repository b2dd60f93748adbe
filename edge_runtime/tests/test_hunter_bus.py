"""The driver on a real python-can bus within this process, its threads running."""

import contextlib
import sys
import threading
import time
from typing import Any
from unittest.mock import Mock

import can
import pytest
from hil_tests.processes import wait_until

from edge_runtime.reach import free_endpoint
from edge_runtime.tests.rigs import LEFT_TURN, PEDAL
from edge_runtime.util import UserError
from edge_runtime.vehicles.hunter import (
    DEFAULT_BUS,
    MULTICAST_GROUP,
    BusName,
    HunterSettings,
    HunterVehicle,
    open_bus,
    parse_bus,
    protocol,
)
from edge_runtime.vehicles.streamed import VehicleState


class ObedientChassis:
    """Answers as a chassis that obeys at once; keeps every frame that it heard."""

    def __init__(self, channel):
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.heard: list = []
        self.status = protocol.SystemStatus(0, protocol.STANDBY, 24.0, 0, 1, 0)
        self._notifier = can.Notifier(self.bus, [self._hear], timeout=0.05)

    def _hear(self, message):
        self.heard.append((message.arbitration_id, bytes(message.data)))
        told, can_id = protocol.decode(*self.heard[-1]), message.arbitration_id
        if can_id == 0x421:
            self.status = self.status._replace(mode=told.value)
        elif can_id == 0x131:
            self.status = self.status._replace(brake=told.value)
        elif can_id == 0x111:
            self.send(protocol.MOTION_STATUS, protocol.WheelMotion(*told))
            self.status = self.status._replace(counter=(self.status.counter + 1) % 256)
            self.send(protocol.SYSTEM_STATUS, self.status)

    def send(self, frame, message):
        data = protocol.encode(frame, message)
        message = can.Message(arbitration_id=frame.can_id, data=data, is_extended_id=False)
        self.bus.send(message, timeout=0.1)

    @property
    def speeds(self):
        return [protocol.decode(*heard).speed_mps for heard in [*self.heard] if heard[0] == 0x111]

    def close(self):
        self._notifier.stop()
        self.bus.shutdown()


@pytest.fixture
def channel(request):
    return request.node.name


@pytest.fixture
def chassis(channel):
    with contextlib.closing(ObedientChassis(channel)) as chassis:
        yield chassis


@pytest.fixture
def vehicle(channel):
    settings = HunterSettings(bus=f"virtual:{channel}")
    with contextlib.closing(HunterVehicle(settings, LEFT_TURN)) as vehicle:
        vehicle.control_period_s = 0.1
        yield vehicle


def drive(chassis, vehicle):
    def is_quick():
        if any("no command" in fault for fault in vehicle.feedback(time.monotonic()).faults):
            enable(vehicle)  # This process itself stood still for so long.
        vehicle.command(PEDAL, time.monotonic())
        return chassis.speeds[-1] > 0.2

    wait_until(is_quick, "speed")


def enable(vehicle):
    vehicle.enable(time.monotonic())
    wait_until(lambda: state_of(vehicle) is VehicleState.ENABLED, "the confirmation")


def state_of(vehicle):
    return vehicle._core.state


def test_it_enables_drives_brakes_and_parks(chassis, vehicle):
    time.sleep(0.1)
    assert chassis.heard == []
    enable(vehicle)
    drive(chassis, vehicle)
    assert vehicle.feedback(time.monotonic()).speed_mps > 0.1
    wait_until(lambda: state_of(vehicle) is VehicleState.STOPPED, "its own stop")
    wait_until(lambda: chassis.speeds[-1] == 0.0, "a stand")
    enable(vehicle)
    drive(chassis, vehicle)
    vehicle.close()
    wait_until(lambda: chassis.heard[-1] == (0x421, b"\x00"), "control given back")
    assert (0x131, b"\x01") in chassis.heard[-3:]
    assert {can_id for can_id, _ in chassis.heard} <= {0x111, 0x131, 0x421}
    assert not [t for t in threading.enumerate() if t.name.startswith("hunter-")]
    vehicle.close()


def test_a_bus_that_is_full_neither_blocks_nor_kills_the_stream(channel, vehicle):
    with can.Bus(interface="virtual", channel=channel, rx_queue_size=3) as crowd:
        vehicle.enable(time.monotonic())
        wait_until(lambda: state_of(vehicle) is VehicleState.STOPPED, "its stop")
        assert "the CAN bus fails" in vehicle.feedback(time.monotonic()).faults[0]
        began_s = time.monotonic()
        vehicle.command(PEDAL, time.monotonic())
        vehicle.brake(time.monotonic())
        assert time.monotonic() - began_s < 5.0  # a bus that is waited for is waited for for ever
        while crowd.recv(0.0) is not None:
            pass
        assert crowd.recv(5.0) is not None  # it sends as soon as it can


def test_foreign_frames_are_none_bus_off_stops_it_and_a_dead_bus_is_left(
    chassis, vehicle, monkeypatch
):
    enable(vehicle)
    for kind in ("is_error_frame", "is_extended_id", "is_remote_frame", "is_fd"):
        foreign: Any = {"arbitration_id": 0x111, "is_extended_id": False, kind: True}
        vehicle._hear(can.Message(**foreign))
    assert state_of(vehicle) is VehicleState.ENABLED
    vehicle._hear(can.Message(arbitration_id=0x40, is_error_frame=True))
    assert vehicle.feedback(time.monotonic()).faults == ["the CAN bus fails: bus-off"]
    enable(vehicle)
    down = Mock(side_effect=OSError("Network is down"))
    with monkeypatch.context() as patch:
        patch.setattr(vehicle._bus, "recv", down)
        wait_until(lambda: state_of(vehicle) is VehicleState.STOPPED, "its stop")
    monkeypatch.setattr(vehicle._bus, "send", down)
    vehicle.close()  # raises nothing, and leaves the bus
    with pytest.raises(can.CanOperationError, match="closed"):
        vehicle._bus.recv(0.0)


def test_only_commands_are_sent(chassis, vehicle):
    for frame in protocol.FEEDBACK:
        assert not vehicle._send([protocol.Sent(frame, bytes(frame.length))])
    assert chassis.heard == []


ON_LOOPBACK = {"port": 7, "hop_limit": 0, "fd": False}
BUSES = {
    "socketcan:can0": BusName("socketcan", "can0", {}),
    "slcan:/dev/ttyACM0": BusName("slcan", "/dev/ttyACM0", {"bitrate": 500_000}),
    "udp_multicast:239.1.2.3:7": BusName("udp_multicast", "239.1.2.3", ON_LOOPBACK),
    **dict.fromkeys(("can0", ":can0", "socketcan:", "udp_multicast:239.1.2.3")),
}


def test_buses_by_name_and_those_that_cannot_be_opened_are_one_line(caplog, monkeypatch):
    for text, name in BUSES.items():
        with contextlib.nullcontext() if name else pytest.raises(UserError, match="write it as"):
            assert parse_bus(text) == name
    for text in (
        "socketcan:can97",
        "nosuch:can0",
        "slcan:/dev/nothing",
        "udp_multicast:10.0.0.1:7",
    ):
        with pytest.raises(UserError, match=f"^.*{text[:20]}.* cannot be opened.*$"):
            open_bus(parse_bus(text))
    assert caplog.records == []  # a line of a library would be a second one
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(UserError, match="pip install python-can"):
        open_bus(parse_bus(DEFAULT_BUS))


def test_frames_reach_the_other_end_of_a_multicast_bus():
    port = int(free_endpoint("udp").rsplit(":", 1)[1])
    name = parse_bus(f"udp_multicast:{MULTICAST_GROUP}:{port}")
    frame = can.Message(arbitration_id=0x111, data=bytes(8), is_extended_id=False)
    with open_bus(name) as near, open_bus(name) as far:
        near.send(frame)
        received = far.recv(1.0)
        assert received is not None
        assert (received.arbitration_id, bytes(received.data)) == (0x111, bytes(8))
