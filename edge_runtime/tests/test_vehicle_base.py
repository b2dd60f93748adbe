"""The runner of a driver that raises, hangs or reports nonsense."""

import contextlib
import math
import time

import msgspec
import numpy as np
import pytest
from hil_tests.processes import wait_until
from hil_tests.tests.shared.messages import make_command
from hil_tests.tests.shared.policies import T
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.bounds import Bounds, Model
from edge_runtime.tests.rigs import BrokenVehicle
from edge_runtime.util import UserError
from edge_runtime.vehicles import base
from edge_runtime.vehicles.base import VehicleRunner, _Order
from edge_runtime.vehicles.plausibility import DEVIATES_S, LAG_S, Fault
from edge_runtime.wire import SAFE_STOP, encode

SILENT = Fault.SILENT.value
BUS_OFF = OSError("bus off")
RAISED = [BUS_OFF, SystemExit(3), KeyboardInterrupt(), GeneratorExit()]


class NotingRunner(VehicleRunner):
    def __init__(self, vehicle, names=("pedal",)):
        self.heard: list = []
        self.faults: list = []
        super().__init__(vehicle, names, self.heard.append)
        self.on_fault = lambda: self.faults.append(True)

    def now(self):
        return self.fault(time.monotonic())

    def wait_for_reports(self, count=1):
        end = len(self.heard) + count
        wait_until(lambda: len(self.heard) >= end, "feedback")


@pytest.fixture
def vehicle():
    return BrokenVehicle()


@pytest.fixture
def runner(vehicle):
    runner = NotingRunner(vehicle)
    runner.start()
    vehicle.asked.clear()
    yield runner
    vehicle.go_on()
    runner.close()


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("raises", {"feedback": SystemExit(3)}),
        ("odd", {"action": {"pedal": "full"}}),
        ("odd", {"action": {"steering": 0.0}}),  # whether it obeys, nobody could see
        ("odd", {"faults": 3}),
    ],
)
def test_a_driver_that_raises_or_reports_nonsense_is_silent_and_its_thread_lives_on(
    vehicle, runner, name, wrong
):
    runner.wait_for_reports()
    setattr(vehicle, name, wrong)
    wait_until(lambda: runner.faults, "the fault")
    assert runner.fault(runner.silent_at_s + 0.001) == SILENT
    runner.command(make_command(mode=SAFE_STOP))
    wait_until(lambda: vehicle.asked == ["brake"], "the brake")
    setattr(vehicle, name, {})
    runner.wait_for_reports()


def test_no_driver_is_given_more_than_the_bounds(vehicle):
    vehicle.model_limits = Model(6.0, 0.4, 0.4)
    vehicle.take_bounds(Bounds(max_speed_mps=0.5, max_steering_rad=0.1))
    runner = NotingRunner(vehicle, ["pedal", "steering"])
    given: list = []
    vehicle.command = lambda action, *_: given.append(action)
    for speed_mps, asked, expected in (
        (0.4, [1.0, 1.0], [1.0, 0.25]), (0.5, [1.0, -0.5], [0.0, -0.25]),
        (0.51, [-0.5, 0.1], [-0.5, 0.1]),
    ):  # fmt: skip
        vehicle.odd = {"speed_mps": speed_mps}
        runner._ask()
        runner._obey(_Order(make_command(action=asked), None, True, time.monotonic()))
        assert [*given[-1].values()] == pytest.approx(expected)


@pytest.mark.parametrize(
    "speeds", [(-1.0, None), (0.0, 1.0), (0.5, 1.0), (0.0, -1.0), (-1.0, math.nan)]
)
def test_only_enable_gives_a_new_leash(vehicle, speeds):
    """Odometry that says too little is not believed, where the driver tells what is asked."""
    vehicle.take_bounds(Bounds(leash_m=0.3))
    vehicle.odd = dict(zip(("speed_mps", "commanded_speed_mps"), speeds))
    runner = NotingRunner(vehicle)
    runner.start(armed=False)
    with contextlib.closing(runner):
        wait_until(lambda: runner.leash_is_used, "its end")
        assert runner.faults  # the watchdog is woken
        runner.command(make_command(mode=SAFE_STOP))
        runner.wait_for_reports(3)
        assert runner.leash_is_used
        vehicle.odd = {"speed_mps": 0.0}
        runner.wait_for_reports(3)
        runner.enable()
        assert not runner.leash_is_used  # at once: the next look must not stop it again
        wait_until(lambda: "enable" in vehicle.asked, "enable")
        runner.wait_for_reports(2)
        assert not runner.leash_is_used
        assert runner.leash.left_m > 0.2


def test_a_report_in_numbers_of_numpy_and_words_that_no_message_can_carry_is_one(vehicle, runner):
    odd, long = {"speed_mps": np.float32(0.5), "battery_v": np.float64(24.0)}, "x" * 1000
    vehicle.odd = {**odd, "faults": ["no port \udcff", long]}
    wait_until(lambda: runner.heard and runner.heard[-1].speed_mps == 0.5, "the report")
    last = runner.heard[-1]
    assert last.faults == ["no port \\udcff", long[:256]]
    encode(last)
    assert msgspec.json.decode(msgspec.json.encode(last))["battery_v"] == 24.0


@pytest.mark.parametrize(
    ("raises", "action", "asked"),
    [
        ({"command": BUS_OFF}, [0.5], ["command", "brake"]),
        ({}, [], ["brake"]),
        ({}, [0.5, 0.5], ["brake"]),  # more than the policy's actions
    ],
)
def test_a_command_not_taken_is_a_fault_until_one_is(vehicle, runner, raises, action, asked):
    vehicle.raises = raises
    runner.command(make_command(action=action))  # raises nothing here
    wait_until(lambda: runner.heard and runner.heard[-1].faults == [SILENT], "the fault")
    assert runner.faults
    # A stop is one whatever stands beside it.
    runner.command(make_command(1, mode=SAFE_STOP, action=action))
    wait_until(lambda: not runner.now(), "an end of the fault")
    assert vehicle.asked == asked


@pytest.mark.parametrize(("newest", "asked"), [(SAFE_STOP, ["brake"]), ("drive", [])])
def test_a_driver_that_hangs_holds_nobody_and_later_obeys_no_old_drive(
    vehicle, runner, newest, asked
):
    vehicle.hang()
    runner.command(make_command(mode=SAFE_STOP))
    runner.command(make_command(1, mode=newest))
    wait_until(lambda: runner.now() == SILENT, "the fault")
    time.sleep(2 * T)  # now the drive is too old
    vehicle.go_on()
    runner.wait_for_reports(2)
    assert vehicle.asked == asked
    runner.command(make_command(2), scenario_speed_mps=4.5)
    wait_until(lambda: vehicle.asked == [*asked, "command"], "a fresh one to be obeyed")
    assert vehicle.scenario_speed_mps == 4.5


def test_a_drivers_words_are_a_fault_until_it_is_enabled_again(vehicle, runner):
    words = "the remote control drives"
    vehicle.odd = {"faults": [words], "standing": [words]}
    wait_until(lambda: words in runner.now(), "the fault")
    assert runner.standing_fault(time.monotonic()) == words
    vehicle.odd = {"faults": [words]}
    wait_until(lambda: not runner.standing_fault(time.monotonic()), "the end of its cause")
    assert words in runner.now()
    vehicle.odd = {}
    runner.enable()
    assert runner.now() == ""  # at once: the vehicle shall have its chance


def test_a_stop_from_before_the_rearm_does_not_undo_it(vehicle, runner):
    vehicle.hang()
    runner.command(make_command(mode=SAFE_STOP))
    runner.enable()
    runner.command(make_command(1, mode=SAFE_STOP), latch=False)
    vehicle.go_on()
    wait_until(lambda: vehicle.asked == ["enable", "stand"], "the order of things")
    runner.command(make_command(mode=SAFE_STOP))
    wait_until(lambda: vehicle.asked == ["enable", "stand", "brake"], "a stop after it does")


def test_a_stop_brakes_whatever_number_is_the_policys(runner):
    end_s = time.monotonic() + LAG_S + DEVIATES_S + 0.2
    while time.monotonic() < end_s:
        runner.command(make_command(mode=SAFE_STOP, action=[1.0]))
        time.sleep(T / 2)
        assert runner.now() in ("", SILENT)  # a busy machine may pause; it is never stuck


def test_a_pedal_that_stays_in_a_stop_is_stuck_though_the_policy_has_none(vehicle):
    vehicle.odd = {"action": {"pedal": 1.0, "steering": 0.0}}
    runner = VehicleRunner(vehicle, ["steering"], lambda _: None)
    runner.start()

    def stops():
        runner.command(make_command(mode=SAFE_STOP, action=[0.0]))
        return runner.fault(time.monotonic()) == Fault.STUCK.value

    wait_until(stops, "the fault")
    assert runner.close()


def test_an_enable_that_fails_ends_the_start_and_is_a_fault_until_one_succeeds(vehicle, runner):
    vehicle.raises = {"enable": RuntimeError("no control of the gearbox")}
    with pytest.raises(UserError, match="vehicle mock cannot be enabled: no control"):
        NotingRunner(vehicle).start()
    runner.enable()
    wait_until(lambda: runner.faults and "no control" in runner.now(), "the fault")
    assert runner.standing_fault(time.monotonic()) == ""  # to try again is how it ends
    vehicle.raises = {}
    runner.enable()
    wait_until(lambda: not runner.now(), "an end of the fault")


calls = st.sampled_from(["enable", "command", "brake", "feedback"])
deeds = st.one_of(
    st.sampled_from(["enable", "drive", "stop", "report"]),
    st.tuples(calls, st.sampled_from([None, *RAISED])),
)


@settings(max_examples=200)
@given(st.lists(deeds, max_size=20))
def test_whatever_a_driver_raises_it_gets_no_drive_that_no_enable_has_allowed(story):
    vehicle = BrokenVehicle()
    runner = NotingRunner(vehicle)
    refused = False  # the newest enable
    for deed in story:
        vehicle.asked.clear()
        if isinstance(deed, tuple):
            vehicle.raises = {**vehicle.raises, deed[0]: deed[1]}
        elif deed == "enable":
            runner.enable()
            runner._enable()
            refused = vehicle.raises.get("enable") is not None
        elif deed == "report":
            runner._report()
        else:
            command = make_command(mode="drive" if deed == "drive" else SAFE_STOP)
            runner._obey(base._Order(command, None, True, time.monotonic()))
            wanted = "brake" if deed == "stop" else "command"
            assert vehicle.asked == ([] if refused and deed == "drive" else [wanted])
        assert runner.now() or not refused


def test_a_driver_that_hangs_is_left_in_time_and_braked_when_it_comes_back(
    monkeypatch, vehicle, runner
):
    monkeypatch.setattr(base, "_LEAVE_S", 0.3)
    vehicle.hang()
    begun_s = time.monotonic()
    assert not runner.close()
    assert time.monotonic() - begun_s < 5.0
    assert "close" not in vehicle.asked
    vehicle.go_on()
    wait_until(lambda: vehicle.asked == ["brake", "close"], "its end")


@pytest.mark.parametrize("started", [False, True])
def test_a_driver_is_closed_in_the_end_whatever_its_brake_raises(vehicle, started):
    runner = NotingRunner(vehicle)
    if started:
        runner.start(armed=False)  # an operator is to enable it
    vehicle.raises = {"brake": SystemExit(3)}
    assert runner.close()
    assert vehicle.asked == ["brake", "close"]
