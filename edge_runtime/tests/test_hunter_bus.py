"""The driver on a real python-can bus within this process, its threads running."""

import contextlib
import sys
import threading
import time
from functools import partial
from typing import Any
from unittest.mock import Mock, call

import can
import pytest
from hil_tests.mock_hunter import MODELS, MockHunter, Orders, serve
from hil_tests.processes import wait_until

from edge_runtime import log
from edge_runtime.tests.rigs import LEFT_TURN, PEDAL
from edge_runtime.util import UserError
from edge_runtime.vehicles import hunter, streamed
from edge_runtime.vehicles.hunter import (
    DEFAULT_BUS,
    MULTICAST_BUS,
    HunterSettings,
    HunterVehicle,
    open_bus,
    parse_bus,
    protocol,
)
from edge_runtime.vehicles.streamed import VehicleState


@pytest.fixture
def channel(request):
    return request.node.name


@pytest.fixture
def heard(channel):
    """Every command on the bus, on which the mock chassis obeys."""
    found, ending = [], threading.Event()
    bus = partial(can.Bus, interface="virtual", channel=channel)

    def note(message):
        if message.arbitration_id in protocol.COMMAND_IDS:
            found.append((message.arbitration_id, bytes(message.data)))

    with bus() as chassis, bus() as monitor:
        hunter = MockHunter(MODELS["hunter-2.0"], time.monotonic())
        thread = threading.Thread(target=serve, args=(hunter, chassis, Orders(), ending))
        thread.start()
        notifier = can.Notifier(monitor, [note], timeout=0.05)
        yield found
        notifier.stop()
        ending.set()
        thread.join()


def last_speed_mps(heard):
    return next(protocol.decode(*frame).speed_mps for frame in heard[::-1] if frame[0] == 0x111)


@pytest.fixture
def vehicle(channel):
    settings = HunterSettings(bus=f"virtual:{channel}")
    with contextlib.closing(HunterVehicle(settings, LEFT_TURN)) as vehicle:
        vehicle.control_period_s = 0.1
        yield vehicle


def drive(heard, vehicle):
    def is_quick():
        report = vehicle.feedback(time.monotonic())
        if any("no command" in fault or "sends no" in fault for fault in report.faults):
            enable(vehicle)  # This process itself stood still for so long.
        vehicle.command(PEDAL, time.monotonic())
        return last_speed_mps(heard) > 0.2 and report.speed_mps > 0.1

    wait_until(is_quick, "speed")


def enable(vehicle):
    vehicle.enable(time.monotonic())
    wait_until(lambda: state_of(vehicle) is VehicleState.ENABLED, "the confirmation")


def state_of(vehicle):
    return vehicle._core.state


def test_it_enables_drives_brakes_and_parks(heard, vehicle):
    time.sleep(0.1)
    assert heard == []
    enable(vehicle)
    drive(heard, vehicle)
    wait_until(lambda: state_of(vehicle) is VehicleState.STOPPED, "its own stop")
    wait_until(lambda: last_speed_mps(heard) == 0.0, "a stand")
    enable(vehicle)
    drive(heard, vehicle)
    vehicle.close()
    wait_until(lambda: heard[-1] == (0x421, b"\x00"), "control given back")
    assert heard[-2] == (0x131, b"\x01")
    assert {can_id for can_id, _ in heard} <= {0x111, 0x131, 0x421}
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
    heard, vehicle, monkeypatch
):
    enable(vehicle)
    for kind in ("is_error_frame", "is_extended_id", "is_remote_frame", "is_fd"):
        foreign: Any = {"arbitration_id": 0x111, "is_extended_id": False, kind: True}
        vehicle._hear(can.Message(**foreign))
    vehicle._note_bus("one frame")
    assert state_of(vehicle) is VehicleState.ENABLED
    vehicle._hear(can.Message(arbitration_id=0x40, is_error_frame=True))
    assert vehicle.feedback(time.monotonic()).faults == ["the CAN bus fails: bus-off"]
    enable(vehicle)
    down = Mock(side_effect=OSError("Network is down"))
    with monkeypatch.context() as patch:
        patch.setattr(vehicle._bus, "recv", down)
        wait_until(lambda: state_of(vehicle) is VehicleState.STOPPED, "its stop")
        assert vehicle._listener.is_alive()
    monkeypatch.setattr(vehicle._bus, "send", down)
    monkeypatch.setattr(log, "event", events := Mock())
    vehicle.close()  # raises nothing, and leaves the bus
    assert events.mock_calls == [call("warning", "hunter_not_parked")]
    with pytest.raises(can.CanOperationError, match="closed"):
        vehicle._bus.recv(0.0)


@pytest.mark.parametrize(
    ("bus", "is_foreign"), [(DEFAULT_BUS, True), ("virtual:bus", True), (MULTICAST_BUS, False)]
)
def test_commands_of_others_stop_it_but_not_its_own_that_come_back(monkeypatch, bus, is_foreign):
    monkeypatch.setattr(hunter, "open_bus", lambda _: can.Bus(interface="virtual", channel=bus))
    monkeypatch.setattr(streamed, "STOP_TAKES_S", 0.0)
    monkeypatch.setattr(streamed, "PERIOD_S", 9.0)
    with contextlib.closing(HunterVehicle(HunterSettings(bus=bus), LEFT_TURN)) as vehicle:
        vehicle.enable(time.monotonic())
        assert vehicle._send_due()
        vehicle._wake = Mock(wraps=vehicle._wake)
        for _ in range(2):
            vehicle._hear(can.Message(arbitration_id=0x111, is_extended_id=False))
            assert vehicle._wake.set.call_count == is_foreign  # its zero does not wait
        assert (state_of(vehicle) is VehicleState.STOPPED) == is_foreign
        assert vehicle._listener.daemon


def test_only_commands_are_sent(channel, vehicle):
    with can.Bus(interface="virtual", channel=channel) as other:
        for frame in protocol.FEEDBACK:
            assert not vehicle._send([protocol.Sent(frame, bytes(frame.length))])
        assert other.recv(0.0) is None


def bus_name(interface, channel, options):
    return {"interface": interface, "channel": channel, **options}


ON_LOOPBACK = {"port": 7, "hop_limit": 0, "fd": False}
BUSES = {
    "socketcan:can0": bus_name("socketcan", "can0", {}),
    "slcan:/dev/ttyACM0": bus_name("slcan", "/dev/ttyACM0", {"bitrate": 500_000}),
    "slcan:tty:7": bus_name("slcan", "tty:7", {"bitrate": 500_000}),
    "virtual:tty:7": bus_name("virtual", "tty:7", {}),
    "udp_multicast:239.1.2.3:7": bus_name("udp_multicast", "239.1.2.3", ON_LOOPBACK),
    **dict.fromkeys(("can0", ":can0", "socketcan:", "udp_multicast:239.1.2.3")),
}


def test_buses_by_name_and_those_that_cannot_be_opened_are_one_line(caplog, monkeypatch):
    for text, name in BUSES.items():
        with contextlib.nullcontext() if name else pytest.raises(UserError, match="write it as"):
            assert parse_bus(text) == name
    for text in ("socketcan:can97", "nosuch:can0", "slcan:/dev/nothing"):
        with pytest.raises(UserError, match=f"^.*{text} cannot be opened.*$"):
            open_bus(parse_bus(text))
    assert caplog.records == []  # a line of a library would be a second one
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(UserError, match="pip install python-can"):
        open_bus(parse_bus(DEFAULT_BUS))
