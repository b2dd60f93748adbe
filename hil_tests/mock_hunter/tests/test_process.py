"""The mock on a bus: inside one process on `virtual`, and as a process of its own."""

import contextlib
import threading
import time

import can
import pytest

from edge_runtime.vehicles.hunter import open_bus, parse_bus
from hil_tests.faults.rig import ChassisProcess, free_bus
from hil_tests.mock_hunter.hunter import MODELS, MockHunter
from hil_tests.mock_hunter.process import Server, read_orders
from hil_tests.processes import wait_until

PATIENCE_S = 5.0


def frame(can_id, data, **options):
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **options})


def status_after(bus, wanted, patience_s=PATIENCE_S):
    """The first 0x211 for which it holds; None where none comes."""
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        message = bus.recv(0.1)
        if message and message.arbitration_id == 0x211 and wanted(message.data):
            return bytes(message.data)
    return None


@contextlib.contextmanager
def serving(bus):
    """A mock on a bus; what it says."""
    said: list[str] = []
    server = Server(MockHunter(MODELS["hunter-2.0"], time.monotonic()), bus, said.append)
    thread = threading.Thread(target=server.run)
    thread.start()
    yield said
    server.stop()
    thread.join()


@pytest.fixture
def served():
    """A bus with a mock at its other end, and what that says."""
    near, far = (can.Bus(interface="virtual", channel="test_process") for _ in range(2))
    with serving(far) as said:
        yield near, said
    near.shutdown()
    far.shutdown()


def test_inside_a_process_it_answers_on_a_virtual_bus(served):
    near, said = served
    near.send(frame(0x421, b"\x01"))
    near.send(frame(0x131, b"\x00"))
    assert status_after(near, lambda data: data[1] == 1 and data[6] == 0)
    assert any("control=can condition=ok brake=released motion=stands" in line for line in said)


@pytest.mark.parametrize(
    "odd", [{"is_extended_id": True}, {"is_remote_frame": True, "data": None}, {"is_fd": True}]
)
def test_frames_of_another_kind_are_not_the_chassis(served, odd):
    near, _ = served
    near.send(frame(0x421, **{"data": b"\x01", **odd}))
    assert status_after(near, lambda data: data[1] == 1, patience_s=0.3) is None


class DeafBus(can.BusABC):
    """A bus that takes nothing."""

    def __init__(self):
        self.channel_info, self.tries = "deaf", 0
        super().__init__("deaf")

    def send(self, msg, timeout=None):
        self.tries += 1
        raise can.CanOperationError("no buffer space")

    def _recv_internal(self, timeout):
        time.sleep(timeout or 0.0)
        return None, False


def test_a_bus_that_takes_nothing_is_said_once():
    bus = DeafBus()
    with serving(bus) as said:
        wait_until(lambda: bus.tries > 20, "some frames")
    bus.shutdown()
    assert sum("not sent: no buffer space" in line for line in said) == 1


def test_as_a_process_it_obeys_switches_and_ends_on_a_signal(monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "utf-8:strict")  # as in a desktop's locale
    name = free_bus()
    chassis = ChassisProcess(name, "--fault", "estop@0.3")
    bus = open_bus(parse_bus(name))
    try:
        assert status_after(bus, lambda data: data[0] == 1)  # the fault of the command line
        chassis.switch("estop", False)
        assert status_after(bus, lambda data: data[0] == 0)
        chassis.process.tell("\udcff")  # no UTF-8
        chassis.process.wait_for_line("is no order")
        chassis.process.tell("estop maybe")
        chassis.process.wait_for_line("'estop maybe' is no order")
        chassis.switch("remote", True)
        assert status_after(bus, lambda data: data[1] == 2)
        assert chassis.truth[-1].control == "remote"
    finally:
        bus.shutdown()
        assert chassis.process.end() == 0


def test_orders_come_in_turn_and_those_that_are_none_are_told():
    found: list[tuple[str, bool]] = []
    told: list[str] = []
    bad = ["remote", "remote yes", "", "meteor on", "on remote"]
    read_orders(["remote on\n", *bad, "remote off\n"], found.append, told.append)
    assert found == [("remote", True), ("remote", False)]
    assert len(told) == len(bad)
