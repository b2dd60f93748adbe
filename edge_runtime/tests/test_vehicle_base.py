"""The runner of a driver that raises or hangs, the watch over what it reports, and the mock."""

import math
import threading
import time

import msgspec
import numpy as np
import pytest
from hil_tests.processes import wait_until
from hil_tests.testing.messages import make_command
from hil_tests.testing.policies import T
from hil_tests.testing.vehicles import CAR, CARS, PEDAL, a_manifest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.controller import ActionLimit
from edge_runtime.util import UserError
from edge_runtime.vehicles import base, make_vehicle, plausibility
from edge_runtime.vehicles.base import VehicleRunner
from edge_runtime.vehicles.mock import MockParameters, MockVehicle
from edge_runtime.vehicles.plausibility import REASONS, Fault, VehicleWatch
from edge_runtime.wire import SAFE_STOP, encode


@pytest.fixture(scope="module", autouse=True)
def period():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MockVehicle, "control_period_s", T)
        yield


class BrokenVehicle(MockVehicle):
    """Fails where it is told to, and notes what it was asked."""

    def __init__(self):
        super().__init__()
        self.broken = ""
        self.asked: list = []
        self.says: list = []
        self.stands: list = []
        self.odd: dict = {}
        self.hanging, self.released = threading.Event(), threading.Event()

    def hang(self):
        self.broken = "hang"
        assert self.hanging.wait(10.0)

    def go_on(self):
        self.broken = ""
        self.released.set()

    def feedback(self, now_s):
        if self.broken == "feedback":
            raise OSError("no such device")
        if self.broken == "feedback exits":
            raise SystemExit
        if self.broken == "feedback interrupts":
            raise KeyboardInterrupt
        if self.broken == "hang":
            self.hanging.set()
            self.released.wait()
        report = super().feedback(now_s)
        return report._replace(faults=list(self.says), standing=list(self.stands), **self.odd)

    def enable(self, now_s):
        self._ask("enable")
        super().enable(now_s)

    def command(self, action, now_s, scenario_speed_mps=None):
        self._ask("command")
        self.scenario_speed_mps = scenario_speed_mps
        super().command(action, now_s, scenario_speed_mps)

    def brake(self, now_s, latch=True):
        self._ask("brake" if latch else "stand")
        super().brake(now_s, latch)

    def close(self):
        self.asked.append("close")
        super().close()

    def _ask(self, what):
        self.asked.append(what)
        if self.broken == "command":
            raise OSError("bus off")
        if self.broken == what == "enable":
            raise RuntimeError("no control of the gearbox")
        if self.broken == "exit":
            raise SystemExit


class NotingRunner(VehicleRunner):
    def __init__(self, vehicle):
        self.heard: list = []
        self.faults: list = []
        super().__init__(vehicle, ["pedal"], self.heard.append)
        self.on_fault = lambda: self.faults.append(True)


@pytest.fixture
def vehicle():
    return BrokenVehicle()


@pytest.fixture
def runner(vehicle):
    runner = NotingRunner(vehicle)
    runner.start()
    vehicle.asked.clear()
    yield runner
    vehicle.released.set()
    runner.close()


@pytest.mark.parametrize(
    ("name", "wrong", "right"),
    [
        ("broken", "feedback", ""),
        ("broken", "feedback exits", ""),
        ("broken", "feedback interrupts", ""),
        ("odd", {"speed_mps": None}, {}),
        ("odd", {"action": {"pedal": "full"}}, {}),
        ("odd", {"action": {"steering": 0.0}}, {}),  # whether it obeys, nobody could see
        ("odd", {"faults": 3}, {}),
    ],
)
def test_a_driver_that_raises_or_reports_nonsense_is_silent_and_its_thread_lives_on(
    vehicle, runner, name, wrong, right
):
    wait_until(lambda: runner.heard, "feedback")
    setattr(vehicle, name, wrong)
    wait_until(lambda: runner.faults, "the fault")
    assert runner.fault(runner.silent_at_s + 0.001) == REASONS[Fault.SILENT]
    runner.command(make_command(mode=SAFE_STOP))
    wait_until(lambda: vehicle.asked == ["brake"], "the brake")
    setattr(vehicle, name, right)
    count = len(runner.heard)
    wait_until(lambda: len(runner.heard) > count, "feedback again")


def test_a_driver_that_raises_at_a_re_arm_still_reports_and_brakes(vehicle, runner):
    vehicle.broken = "command"
    runner.enable()
    wait_until(lambda: vehicle.asked == ["enable"], "the attempt")
    count = len(runner.heard)
    wait_until(lambda: len(runner.heard) > count + 1, "feedback")
    vehicle.broken = ""
    runner.command(make_command(mode=SAFE_STOP))
    wait_until(lambda: vehicle.asked[-1] == "brake", "the brake")


def test_a_report_in_numbers_of_numpy_is_one(vehicle, runner):
    vehicle.odd = {"speed_mps": np.float32(1.5), "battery_v": np.float64(24.0)}
    wait_until(lambda: runner.heard and runner.heard[-1].speed_mps == 1.5, "the report")
    assert msgspec.json.decode(msgspec.json.encode(runner.heard[-1]))["battery_v"] == 24.0


def test_a_driver_that_cannot_be_enabled_at_the_start_gets_one_line(vehicle):
    vehicle.broken = "command"
    with pytest.raises(UserError, match="vehicle mock cannot be enabled: bus off"):
        NotingRunner(vehicle).start()


@pytest.mark.parametrize(
    ("broken", "action", "asked"),
    [
        ("command", [0.5], ["command", "brake"]),
        ("exit", [0.5], ["command", "brake"]),
        ("", [], ["brake"]),
        ("", [0.5, 0.5], ["brake"]),
    ],
    ids=["the driver raises", "the driver exits", "no action", "more than the policy's actions"],
)
def test_a_command_not_taken_is_a_fault_until_one_is(vehicle, runner, broken, action, asked):
    vehicle.broken = broken
    runner.command(make_command(action=action))  # raises nothing here
    wait_until(lambda: runner.faults, "the fault")
    assert runner.fault(time.monotonic())
    if broken:
        wait_until(
            lambda: runner.heard and runner.heard[-1].faults == [REASONS[Fault.SILENT]],
            "the feedback",
        )
    vehicle.broken = ""
    # A stop is one whatever stands beside it.
    runner.command(make_command(1, mode=SAFE_STOP, action=action))
    wait_until(lambda: not runner.fault(time.monotonic()), "an end of the fault")
    assert vehicle.asked == asked


def test_a_driver_that_hangs_holds_nobody_and_takes_the_newest_command_later(vehicle, runner):
    vehicle.hang()
    runner.command(make_command())
    runner.command(make_command(1, mode=SAFE_STOP))
    wait_until(lambda: runner.fault(time.monotonic()) == REASONS[Fault.SILENT], "the fault")
    assert vehicle.asked == []
    vehicle.go_on()
    wait_until(lambda: vehicle.asked == ["brake"], "the brake alone")


@pytest.mark.parametrize("broken", ["command", "exit"])
def test_a_driver_that_raises_at_the_end_is_closed_all_the_same(vehicle, runner, broken):
    vehicle.broken = broken
    assert runner.close()
    assert vehicle.asked == ["brake", "close"]


def test_a_drivers_words_are_a_fault_until_it_is_enabled_again(vehicle, runner):
    words, long = "the remote control drives", "x" * 1000
    vehicle.says, vehicle.stands = [words, long], [words]
    wait_until(lambda: words in runner.fault(time.monotonic()), "the fault")
    wait_until(lambda: runner.standing_fault(time.monotonic()), "its cause")
    vehicle.stands = []
    wait_until(lambda: not runner.standing_fault(time.monotonic()), "the end of its cause")
    assert words in runner.fault(time.monotonic())
    assert runner.heard[-1].faults == [words, long[:256]]  # as long as the wire takes them
    vehicle.says = []
    runner.enable()
    assert runner.fault(time.monotonic()) == ""  # at once: the vehicle shall have its chance
    wait_until(lambda: vehicle.asked == ["enable"], "the driver to be asked")


def test_a_stop_from_before_the_rearm_does_not_undo_it(vehicle, runner):
    vehicle.hang()
    runner.command(make_command(mode=SAFE_STOP))
    runner.enable()
    runner.command(make_command(1, mode=SAFE_STOP), latch=False)
    vehicle.go_on()
    wait_until(lambda: vehicle.asked == ["enable", "stand"], "the order of things")
    runner.command(make_command(mode=SAFE_STOP))
    wait_until(lambda: vehicle.asked == ["enable", "stand", "brake"], "a stop after it does")


def test_words_that_no_message_can_carry_are_written_as_escapes(vehicle, runner):
    vehicle.says = ["no port \udcff"]
    wait_until(lambda: ["no port \\udcff"] in [each.faults for each in runner.heard], "the fault")
    encode(runner.heard[-1])


@pytest.mark.parametrize("stop", [-1.0, 0.0, 1.0])
def test_a_stop_brakes_whatever_number_is_the_policys(runner, stop):
    end_s = time.monotonic() + plausibility.LAG_S + plausibility.DEVIATES_S + 0.4
    while time.monotonic() < end_s:
        runner.command(make_command(mode=SAFE_STOP, action=[stop]))
        time.sleep(T / 2)
        assert runner.fault(time.monotonic()) == ""


def test_a_command_that_waited_too_long_moves_nothing(vehicle, runner):
    vehicle.hang()
    runner.command(make_command())
    time.sleep(0.3)
    vehicle.go_on()
    count = len(runner.heard)
    wait_until(lambda: len(runner.heard) > count + 1, "feedback again")
    assert vehicle.asked == []
    runner.command(make_command(1), scenario_speed_mps=4.5)
    wait_until(lambda: vehicle.asked == ["command"], "a fresh one to be obeyed")
    assert vehicle.scenario_speed_mps == 4.5


@pytest.mark.parametrize("armed", [False, True])
def test_only_a_vehicle_that_is_armed_is_enabled(vehicle, armed):
    runner = NotingRunner(vehicle)
    runner.start(armed)
    wait_until(lambda: runner.heard, "feedback")
    assert vehicle.asked == ["enable"] * armed
    runner.close()


def test_a_failed_enable_is_a_fault_that_no_drive_passes_until_one_succeeds(vehicle, runner):
    vehicle.broken = "enable"
    runner.enable()
    wait_until(lambda: runner.faults, "the fault")
    assert "no control" in runner.fault(time.monotonic())
    assert runner.standing_fault(time.monotonic()) == ""  # to try again is how it ends
    runner.command(make_command())
    runner.command(make_command(1, mode=SAFE_STOP))
    wait_until(lambda: vehicle.asked[-1] == "brake", "the brake")
    assert "command" not in vehicle.asked
    vehicle.broken = ""
    runner.enable()
    wait_until(lambda: not runner.fault(time.monotonic()), "an end of the fault")
    runner.command(make_command(2))
    wait_until(lambda: vehicle.asked[-1] == "command", "the drive")


RAISED = [OSError("bus off"), SystemExit(3), KeyboardInterrupt(), GeneratorExit()]


class RaisingVehicle(BrokenVehicle):
    """Raises in the calls of `raises`, and moves only by commands that it takes."""

    def __init__(self):
        super().__init__()
        self.raises: dict = {}

    def _ask(self, what):
        super()._ask(what)
        if self.raises.get(what):
            raise self.raises[what]

    def feedback(self, now_s):
        if self.raises.get("feedback"):
            raise self.raises["feedback"]
        return super().feedback(now_s)


calls = st.sampled_from(["enable", "command", "brake", "feedback"])
deeds = st.one_of(
    st.sampled_from(["enable", "drive", "stop", "report"]),
    st.tuples(calls, st.sampled_from([None, *RAISED])),
)


@settings(max_examples=1000)
@given(st.lists(deeds, max_size=20))
def test_whatever_a_driver_raises_it_gets_no_drive_that_no_enable_has_allowed(story):
    vehicle = RaisingVehicle()
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
        assert runner.fault(time.monotonic()) or not refused


@pytest.mark.parametrize("call", ["feedback", "enable", "command", "brake", "close"])
def test_a_driver_that_hangs_anywhere_is_left_in_time_and_braked_when_it_comes_back(
    monkeypatch, call
):
    monkeypatch.setattr(base, "_LEAVE_S", 0.3)
    vehicle = BrokenVehicle()
    runner = NotingRunner(vehicle)
    runner.start()
    vehicle.asked.clear()
    real = getattr(vehicle, call)

    def hangs(*arguments, **options):
        vehicle.hanging.set()
        vehicle.released.wait()
        return real(*arguments, **options)

    setattr(vehicle, call, hangs)
    runner.enable()
    runner.command(make_command())
    if call in ("feedback", "enable", "command"):
        assert vehicle.hanging.wait(10.0)
    begun_s = time.monotonic()
    assert not runner.close()
    assert time.monotonic() - begun_s < 5.0
    assert "close" not in vehicle.asked
    vehicle.released.set()
    wait_until(lambda: vehicle.asked[-2:] == ["brake", "close"], "its end")


def test_a_driver_that_is_only_busy_at_the_end_is_braked_and_closed(vehicle, runner):
    vehicle.hang()
    threading.Timer(0.8, vehicle.go_on).start()
    assert runner.close()
    assert vehicle.asked == ["brake", "close"]


def test_a_driver_that_was_never_started_is_closed(vehicle):
    assert NotingRunner(vehicle).close()
    assert vehicle.asked == ["brake", "close"]


TICK_S = 0.05


def report(pedal=0.0, speed_mps=1.0, self_braking=False):
    return base.VehicleReport({"pedal": pedal}, speed_mps, self_braking, [])


def watched(asked=0.0, **reported):
    """A watch that has seen a steady drive; and the time."""
    watch = VehicleWatch(T, MockVehicle.limits)
    watch.begin(100.0)
    for tick in range(20):
        now_s = 100.0 + tick * TICK_S
        watch.command({"pedal": asked}, now_s)
        watch.report(report(**reported), now_s)
    return watch, now_s


@pytest.mark.parametrize(
    ("asked", "reported", "newest", "fault"),
    [
        (0.3, {"pedal": 0.3}, {}, None),
        (
            0.6,
            {"pedal": -1.0, "self_braking": True},
            {},
            Fault.SELF_BRAKING,
        ),  # though it is to drive
        (0.0, {}, {"speed_mps": 9.0}, Fault.LYING),
        (0.0, {}, {"speed_mps": math.nan}, Fault.LYING),
        (0.0, {}, {"pedal": 1.1}, Fault.LYING),
        (0.0, {}, {"pedal": math.inf}, Fault.LYING),
    ],
)
def test_what_a_vehicle_may_report(asked, reported, newest, fault):
    watch, now_s = watched(asked=asked, **reported)
    watch.report(report(**{**reported, **newest}), now_s + TICK_S)
    assert watch.fault(now_s + TICK_S) == fault


def test_one_that_brakes_by_itself_while_it_is_to_drive_is_at_fault_once_it_could_be_enabled():
    times = [round(tick * TICK_S, 3) for tick in range(60)]

    def live(braking, drives):
        watch, said = VehicleWatch(T, MockVehicle.limits), {}
        watch.enable(0.0)
        for now_s in times:
            watch.command({"pedal": 0.0}, now_s, drives)
            watch.report(report(self_braking=braking(now_s)), now_s)
            said[now_s] = watch.fault(now_s)
        return said

    said = live(lambda now_s: True, True)
    assert (said[1.2], said[1.25]) == (None, Fault.SELF_BRAKING)
    assert set(live(lambda now_s: True, False).values()) == {None}
    assert set(live(lambda now_s: now_s % 0.2 < 0.1, True).values()) == {None}


def test_silence_after_two_periods_also_before_the_first_report():
    watch = VehicleWatch(T, MockVehicle.limits)
    assert watch.fault(1e9) is None  # what was not begun owes nothing
    watch.begin(10.0)
    assert watch.fault(10.0 + 2 * T) is None
    assert watch.fault(10.001 + 2 * T) == Fault.SILENT
    watch.report(report(), 10.3)
    assert watch.fault(10.3) is None
    assert watch.silent_at_s == pytest.approx(10.3 + 2 * T)


def test_an_actuator_outside_of_all_that_was_asked_is_stuck_only_after_a_while():
    watch, now_s = watched(asked=0.6, pedal=0.6)
    watch.report(report(pedal=-1.0), now_s + TICK_S)
    assert watch.fault(now_s + TICK_S + plausibility.DEVIATES_S) is None
    assert watch.fault(now_s + TICK_S + plausibility.DEVIATES_S + 0.001) == Fault.STUCK
    watch.report(report(pedal=0.6), now_s + 2 * TICK_S)
    assert watch.fault(now_s + 2 * TICK_S) is None


REACHED = [(60.0, None), (45.1, None), (44.9, Fault.STUCK), (81.0, Fault.LYING)]


@pytest.mark.parametrize(("reached", "fault"), REACHED)
def test_what_is_far_from_what_was_asked_depends_on_the_actions_range(reached, fault):
    """An eighth of -40 to 80 is 15; a hundred revolutions are no lie of a wheel that makes them."""
    watch = VehicleWatch(T, {"left": ActionLimit(-40.0, 80.0)})
    watch.begin(0.0)
    for tick in range(20):
        watch.command({"left": 60.0}, tick * TICK_S)
        watch.report(base.VehicleReport({"left": reached}, 1.0, False, []), tick * TICK_S)
    assert watch.fault(19 * TICK_S) == fault


def test_a_leap_is_a_lie_until_that_speed_could_be_real():
    watch, now_s = watched(speed_mps=1.0)
    for after_s, words in (
        (0.2, Fault.LYING),
        (0.3, None),
    ):  # 0.5 m/s and 15 m/s2: up to 4.5, then 6.0
        watch.report(report(speed_mps=5.0), now_s + after_s)
        assert watch.fault(now_s + after_s) == words


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=30))
def test_the_mock_stays_within_its_limits_and_is_never_accused(pedals):
    """Whatever a policy asks at the control rate, reported at the feedback's."""
    vehicle, watch = MockVehicle(), VehicleWatch(T, MockVehicle.limits)
    vehicle.enable(0.0)
    watch.begin(0.0)
    for step, pedal in enumerate(pedals):
        for offset_s in (0.0, TICK_S):
            now_s = step * 0.1 + offset_s
            if offset_s == 0.0:
                for asked in (vehicle, watch):
                    asked.command({"pedal": pedal, "steering": 0.0}, now_s)
            report = vehicle.feedback(now_s)
            assert -1.0 - 1e-9 <= report.action["pedal"] <= 1.0 + 1e-9
            assert 0.0 <= report.speed_mps <= MockParameters().max_speed_mps
            watch.report(report, now_s)
            assert watch.fault(now_s) is None


# The mock.


def enabled(**parameters):
    vehicle = MockVehicle(MockParameters(**parameters))
    vehicle.enable(0.0)
    return vehicle


def test_lag_and_rate_limit_by_hand():
    """From full brake to full throttle in one time constant; and the speed, 5 ms by 5 ms."""
    vehicle = enabled(dead_time_s=0.0, time_constant_s=0.1, slew_per_s=1e9)
    vehicle.command({"pedal": 1.0, "steering": 1.0}, 0.0)
    after = vehicle.feedback(0.1)
    assert after.action["pedal"] == pytest.approx(1 - 2 * math.exp(-1))
    assert after.action["steering"] == pytest.approx(1 - math.exp(-1))
    pedals = [1 - 2 * math.exp(-0.05 * step) for step in range(1, 21)]
    assert after.speed_mps == pytest.approx(sum(max(0.0, 3.0 * pedal) for pedal in pedals) * 0.005)
    vehicle = enabled(dead_time_s=0.0, time_constant_s=1e-9, slew_per_s=2.0)
    vehicle.command(PEDAL, 0.0)
    assert vehicle.feedback(0.1).action["pedal"] == pytest.approx(-1.0 + 0.2)


@pytest.mark.parametrize(("manifests", "ours", "car"), [
    (CAR, None, CAR), (None, None, CARS["left_turn"]), (CARS["congestion"], CAR, CAR),
])  # fmt: skip
def test_it_is_no_quicker_than_the_policys_car_or_that_of_the_settings(manifests, ours, car):
    names = ("throttle_mps2", "brake_mps2", "max_speed_mps") if ours else ()
    settings = {name: getattr(ours, name) for name in names}
    vehicle = make_vehicle("mock", {"mock": settings}, a_manifest(manifests))
    vehicle.enable(0.0)
    speeds = []
    for tick in range(400):
        vehicle.command({"pedal": 1.0 if tick < 300 else -1.0}, tick * 0.1)
        speeds.append(vehicle.feedback(tick * 0.1).speed_mps)
    assert max(speeds) == car.max_speed_mps
    changes = [(after - before) / 0.1 for before, after in zip(speeds, speeds[1:])]
    assert max(changes) == pytest.approx(car.throttle_mps2, rel=0.01)
    assert min(changes) == pytest.approx(-car.brake_mps2, rel=0.01)


def test_it_follows_commands_and_brakes_by_itself_without_them():
    vehicle = enabled()
    for step in range(20):
        vehicle.command({"pedal": 1.0, "steering": 0.5}, step * 0.1)
    driving = vehicle.feedback(1.95)
    assert not driving.self_braking
    assert driving.speed_mps > 5.0
    assert driving.action["steering"] == pytest.approx(0.5, abs=1e-3)
    for after_s, brakes in ((0.2, False), (0.21, True)):
        assert vehicle.feedback(1.9 + after_s).self_braking == brakes
    vehicle.control_period_s = 0.5
    assert [vehicle.feedback(1.9 + late_s).self_braking for late_s in (0.99, 1.01)] == [False, True]
    vehicle.control_period_s = T
    stopped = vehicle.feedback(10.0)
    assert stopped.speed_mps == 0.0
    assert stopped.action == pytest.approx({"pedal": -1.0, "steering": 0.5}, abs=1e-3)


def test_the_dead_time_passes_before_anything_moves_and_a_brake_overtakes_it():
    for brakes in (False, True):
        vehicle = enabled(dead_time_s=0.1)
        vehicle.command(PEDAL, 0.0)
        if brakes:
            vehicle.brake(0.05)
        assert vehicle.feedback(0.09).action["pedal"] == -1.0
        assert (vehicle.feedback(0.19).action["pedal"] > -1.0) != brakes
        assert vehicle.feedback(1e6).speed_mps == 0.0  # a long gap is no long computation
