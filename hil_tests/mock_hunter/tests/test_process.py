"""The mock on a real bus: within this process, and as one of its own."""

import threading
import time
from functools import partial

import can
import pytest

from edge_runtime.vehicles.hunter import open_bus, parse_bus
from hil_tests.faults.rig import ChassisProcess, free_bus
from hil_tests.mock_hunter.hunter import MODELS, MockHunter
from hil_tests.mock_hunter.process import Server, read_orders
from hil_tests.processes import wait_until


def frame(can_id, data, **options):
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **options})


def shows(bus, byte, value, patience_s=5.0):
    """Whether a 0x211 with that byte comes."""
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        message = bus.recv(0.1)
        if message and message.arbitration_id == 0x211 and message.data[byte] == value:
            return True
    return False


@pytest.fixture
def served():
    """A bus with a mock at its other end, that end, and what the mock says."""
    said: list[str] = []
    one = partial(can.Bus, interface="virtual", channel="test_process")
    with one() as near, one() as far:
        server = Server(MockHunter(MODELS["hunter-2.0"], time.monotonic()), far, said.append)
        thread = threading.Thread(target=server.run)
        thread.start()
        yield near, far, said
        server.stop()
        thread.join()


def test_inside_a_process_it_answers_and_says_once_that_a_bus_takes_nothing(served, monkeypatch):
    near, far, said = served
    for odd in ({"is_extended_id": True}, {"is_remote_frame": True, "data": None}, {"is_fd": True}):
        near.send(frame(0x421, **{"data": b"\x01", **odd}))
    near.send(frame(0x131, b"\x00"))
    assert shows(near, 6, 0)  # the brake is released
    assert not any("control=can" in line for line in said)  # the odd ones were no frames
    near.send(frame(0x421, b"\x01"))
    assert shows(near, 1, 1)
    assert any("control=can condition=ok brake=released motion=stands" in line for line in said)
    tries = []

    def deaf(message, timeout=None):
        tries.append(message)
        raise can.CanOperationError("no buffer space")

    monkeypatch.setattr(far, "send", deaf)
    wait_until(lambda: len(tries) > 20, "some frames")
    assert sum("not sent: no buffer space" in line for line in said) == 1


def test_as_a_process_it_obeys_switches_and_ends_on_a_signal(monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "utf-8:strict")  # as in a desktop's locale
    name = free_bus()
    chassis = ChassisProcess(name, "--fault", "estop@0.3")
    with chassis.process, open_bus(parse_bus(name)) as bus:
        assert shows(bus, 0, 1)  # the fault of the command line
        chassis.switch("estop", False)
        assert shows(bus, 0, 0)
        chassis.process.tell("\udcff")  # no UTF-8
        chassis.process.wait_for_line("is no order")
        chassis.switch("remote", True)
        assert shows(bus, 1, 2)
        chassis.process.wait_for_line("control=remote ")
    assert chassis.process.end() == 0


def test_orders_come_in_turn_and_those_that_are_none_are_told():
    found: list[tuple[str, bool]] = []
    told: list[str] = []
    bad = ["remote", "remote yes", "", "meteor on", "on remote"]
    read_orders(["remote on\n", *bad, "remote off\n"], found.append, told.append)
    assert found == [("remote", True), ("remote", False)]
    assert len(told) == len(bad)
