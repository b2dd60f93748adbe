"""The mock as a process on a bus."""

import time

import can

from edge_runtime.vehicles.hunter import open_bus, parse_bus
from hil_tests.faults.rig import ChassisProcess, free_bus


def shows(bus, byte, value, patience_s=5.0):
    """Whether a 0x211 with that byte comes."""
    end_s = time.monotonic() + patience_s
    while time.monotonic() < end_s:
        message = bus.recv(0.1)
        if message and message.arbitration_id == 0x211 and message.data[byte] == value:
            return True
    return False


def test_as_a_process_it_obeys_switches_and_ends_on_a_signal(monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "utf-8:strict")  # as in a desktop's locale
    name = free_bus()
    chassis = ChassisProcess(name)
    with chassis.process, open_bus(parse_bus(name)) as bus:
        chassis.switch("estop", True)
        assert shows(bus, 0, 1)
        chassis.switch("estop", False)
        assert shows(bus, 0, 0)
        chassis.process.tell("\udcff")  # no UTF-8
        chassis.process.wait_for_line("is no order")
        chassis.process.tell("meteor on")
        chassis.process.wait_for_line("'meteor on' is no order")
        bus.send(can.Message(arbitration_id=0x131, data=b"\0", is_extended_id=True))
        assert shows(bus, 6, 1)  # that was no frame of its own: the brake is locked
        chassis.switch("remote", True)
        assert shows(bus, 1, 2)
        chassis.process.wait_for_line("control=remote ")
    assert chassis.process.end() == 0
