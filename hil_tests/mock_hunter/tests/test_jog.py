"""`edge_runtime jog` against the mock in made-up time: each seeded fault by the step for it."""

import contextlib
import json
import math
import signal
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime import jog
from edge_runtime.__main__ import main
from edge_runtime.bounds import NO_BOUNDS, Bounds
from edge_runtime.cli import AGAIN_S
from edge_runtime.reach import free_endpoint
from edge_runtime.tests.rigs import CARS, LEFT_TURN, STREAM_S, BrokenVehicle, Ros2Rig
from edge_runtime.util import UserError
from edge_runtime.vehicles.base import Vehicle
from edge_runtime.vehicles.hunter import HunterCore, HunterVehicle, protocol
from edge_runtime.vehicles.mapping import SPECS, similarity_to
from edge_runtime.vehicles.mock import MockVehicle
from edge_runtime.vehicles.ros2 import Ros2Settings, Ros2Vehicle
from edge_runtime.vehicles.streamed import VehicleState
from hil_tests.mock_hunter import FAULTS, MODELS, Control, MockHunter, Orders, serve

NAMES = [name for name, *_ in jog.STEPS]
FASTEST_MPS = 2 * jog.CRAWL_MPS  # of the wheels, whatever is wrong: a stop takes its time


class Seeded(MockHunter):
    """`wheels`: what its wheels make of a speed and an angle that is asked; `says`: its 0x221."""

    seed, wheels, says = "", (1.0, 1.0), (1.0, 1.0)

    def receive(self, can_id, data, now_s):
        if can_id == protocol.MOTION_COMMAND.can_id:
            asked = protocol.decode(can_id, data)
            pair = protocol.WheelMotion(*(a * k for a, k in zip(asked, self.wheels, strict=True)))
            if self.seed == "brake_does_not_bite" and asked.speed_mps == 0.0 < self.speed_mps:
                pair = pair._replace(speed_mps=self.speed_mps)
            data = protocol.MOTION_COMMAND.sent(pair)[1]
        if can_id == protocol.BRAKE_COMMAND.can_id and self.seed == "brake_never_releases":
            return
        takes = can_id == protocol.MODE_COMMAND.can_id and data[0] == protocol.CAN_CONTROL
        if takes and self.seed == "bus_outranks_the_remote" and "remote" in self.faults:
            self.control = Control.CAN
        if takes and self.seed == "enabling_ends_the_emergency_stop":
            self.faults.discard("estop")
        super().receive(can_id, data, now_s)

    def switch(self, name, on, now_s):
        if self.seed != f"no_{name}":
            super().switch(name, on, now_s)

    def _report(self, now_s):
        moved = self.speed_mps, self.inner_rad
        self.speed_mps, self.inner_rad = (a * k for a, k in zip(moved, self.says, strict=True))
        if self.seed == "freezes_at_speed" and moved[0] > 0.1:
            self.faults.add("frozen")
        super()._report(now_s)
        self.speed_mps, self.inner_rad = moved


class MadeUp(Vehicle):
    """The Hunter's driver without threads: its ticks and the mock's frames, as time passes."""

    name = "hunter"
    outranked_by = HunterVehicle.outranked_by

    def __init__(self, chassis, scale=None, model="2.0"):
        self.core = HunterCore(similarity_to(CARS["left_turn"], SPECS[model], scale), "v2")
        self.limits, self.model_limits = self.core.similarity.limits(), self.core.similarity.model()
        self.chassis, self.now_s, self.is_mute, self.fastest_mps = chassis, 100.0, False, 0.0
        self.closed = False

    def take_bounds(self, bounds):
        super().take_bounds(bounds)
        self.core.set_point.take_bounds(bounds)

    def enable(self, now_s):
        self.core.follow_period(self.control_period_s)
        self.core.enable(now_s)

    def command(self, action, now_s, scenario_speed_mps=None):
        self.core.command(action, now_s, scenario_speed_mps)

    def brake(self, now_s, latch=True):
        self.is_mute = False
        self.core.brake(now_s, latch)

    def mute(self):
        self.is_mute = True

    def feedback(self, now_s):
        return self.core.report(now_s)

    def close(self):
        self.brake(self.now_s)
        self.sleep(2.0)
        self.closed = True

    def sleep(self, seconds):
        for _ in range(round(seconds / STREAM_S)):
            for frame, data in [] if self.is_mute else self.core.tick(self.now_s):
                self.chassis.receive(frame.can_id, data, self.now_s)
            for frame, data in self.chassis.due(self.now_s):
                self.core.hear(frame.can_id, data, self.now_s)
            self.now_s += STREAM_S
            self.fastest_mps = max(self.fastest_mps, abs(self.chassis.speed_mps))


class Operator:
    """Says yes, and uses remote control and emergency stop as it is told, until `ends_at`."""

    def __init__(self, switch, moves, ends_at=""):
        self.switch, self.moves, self.ends_at = switch, moves, ends_at
        self.asked, self.due = [], ""

    def __call__(self, name, text):
        if name == self.ends_at:
            raise KeyboardInterrupt
        self.asked.append(name)
        button = "remote" if name == "remote_control" else "estop"
        self.due = ""
        if self.asked.count(name) == 2:
            self.switch(button, False)
        elif name in ("remote_control", "emergency_stop", "rearm_refused"):
            self.due = button

    def look(self):
        """Press what is due: at once, or once the wheels turn."""
        if self.due and (self.moves() or self.asked[-1] != "rearm_refused"):
            self.switch(self.due, True)
            self.due = ""


def walked(vehicle, bounds=NO_BOUNDS, ends_at="", events=()):
    """Walk in made-up time; return the result of each step that was tried.

    `events`: after how many seconds which fault is switched on or off.
    """
    due = sorted(events)
    chassis = vehicle.chassis
    rows: list[dict[str, str]] = []
    chassis.next_s = chassis._now_s = vehicle.now_s - STREAM_S / 2
    operator = Operator(
        lambda name, on: chassis.switch(name, on, vehicle.now_s),
        lambda: chassis.speed_mps > 0.05,
        ends_at,
    )

    def ask(name, text):
        assert vehicle.core.state is not VehicleState.ENABLED  # whoever waits, waits in a stop
        assert chassis.stands
        operator(name, text)

    def sleep(seconds):
        vehicle.sleep(seconds)
        while due and due[0][0] <= vehicle.now_s - 100.0:
            chassis.switch(*due.pop(0)[1:], vehicle.now_s)
        if vehicle.core.state is VehicleState.ENABLED:
            operator.look()

    jog.walk(
        jog.Jog(
            vehicle,
            bounds,
            ask,
            clock=SimpleNamespace(monotonic=lambda: vehicle.now_s, sleep=sleep),
        ),
        rows,
    )
    assert [row["name"] for row in rows] == NAMES
    assert chassis.stands
    return {row["name"]: row["result"] for row in rows if row["result"] != "not_tried"}


def a_chassis(seed="", model="2.0", **changes):
    parameters = {k: v for k, v in changes.items() if hasattr(MODELS["hunter-2.0"], k)}
    chassis = Seeded(replace(MODELS[f"hunter-{model}"], **parameters), 0.0)
    chassis.seed = seed
    for name in ("wheels", "says"):
        setattr(chassis, name, changes.get(name, (1.0, 1.0)))
    return chassis


@pytest.mark.parametrize("model", SPECS)
@pytest.mark.parametrize("scale", [0.05, None, 3.0])
def test_a_healthy_hunter_passes_each_step(model, scale):
    vehicle = MadeUp(a_chassis(model=model), scale, model)
    assert walked(vehicle) == dict.fromkeys(NAMES, "passed")
    assert 0.15 < vehicle.fastest_mps < 1.1 * jog.CRAWL_MPS


@pytest.mark.parametrize(
    ("found_by", "seed", "changes"),
    [
        ("feedback", "silent", {}),
        ("feedback", "frozen", {}),
        ("feedback", "lying", {}),
        ("feedback", "brake_never_releases", {}),
        ("remote_control", "no_remote", {}),
        ("remote_control", "bus_outranks_the_remote", {}),
        ("emergency_stop", "no_estop", {}),
        ("emergency_stop", "enabling_ends_the_emergency_stop", {}),
        ("steering", "swapped", {"wheels": (1.0, -1.0)}),
        ("steering", "twice_the_angle", {"wheels": (1.0, 2.0)}),
        ("steering", "full_lock", {}),
        ("crawl", "backwards", {"wheels": (-1.0, 1.0)}),
        ("crawl", "ten_times_the_speed", {"wheels": (10.0, 1.0)}),
        ("crawl", "half_the_speed", {"wheels": (0.5, 1.0)}),
        ("crawl", "says_half_the_speed", {"says": (0.5, 1.0)}),
        ("crawl", "says_twice_the_speed", {"says": (2.0, 1.0)}),
        ("crawl", "freezes_at_speed", {}),
        ("brake", "brake_does_not_bite", {}),
        ("link_watchdog", "dead_watchdog", {"command_timeout_s": math.inf}),
    ],
)
def test_a_seeded_fault_is_found_by_the_step_for_it_and_ends_the_jog_with_a_stop(
    found_by, seed, changes
):
    vehicle = MadeUp(a_chassis(seed, **changes))
    if seed in ("silent", "frozen", "lying", "full_lock"):
        vehicle.chassis.faults.add(seed)
    before = dict.fromkeys(NAMES[: NAMES.index(found_by)], "passed")
    assert walked(vehicle) == {**before, found_by: "failed"}
    assert vehicle.closed
    assert vehicle.fastest_mps < FASTEST_MPS


@settings(max_examples=25)
@given(
    st.lists(st.tuples(st.floats(0, 30), st.sampled_from(sorted(FAULTS)), st.booleans())),
    st.tuples(st.sampled_from([-1.0, 0.5, 1.0, 1.0, 3.0]), st.sampled_from([-1.0, 1.0, 2.0])),
    st.sampled_from(["", *NAMES]),
)
def test_whatever_fails_whenever_it_is_never_fast_waits_in_a_stop_and_ends_at_a_stand(
    events, wheels, ends_at
):
    vehicle = MadeUp(a_chassis(wheels=wheels))
    results = walked(vehicle, ends_at=ends_at, events=events)
    if "late" not in [name for _, name, _ in events]:  # too late to tell that it is too fast
        assert vehicle.fastest_mps < FASTEST_MPS
    assert vehicle.closed == ("failed" in results.values())
    if wheels != (1.0, 1.0) or ends_at:
        assert vehicle.closed


def test_left_is_where_the_settings_car_has_it():
    ends = [jog.Jog(MadeUp(a_chassis()), NO_BOUNDS, print, left).turns for left in (1.0, -0.15)]
    assert ends[0] == ends[1][::-1]
    assert ends[0][0] > 0.0


@pytest.mark.parametrize("name", ["feedback", "steering", "crawl", "rearm_refused"])
def test_an_operator_who_interrupts_a_step_ends_the_jog_with_a_stop(name):
    vehicle = MadeUp(a_chassis())
    before = dict.fromkeys(NAMES[: NAMES.index(name)], "passed")
    assert walked(vehicle, ends_at=name) == {**before, name: "failed"}
    assert vehicle.closed


def test_the_operators_bounds_hold_where_they_are_below_its_own():
    vehicle = MadeUp(a_chassis())
    assert set(walked(vehicle, Bounds(max_speed_mps=0.1)).values()) == {"passed"}
    assert 0.07 < vehicle.fastest_mps < 0.11 + 0.02
    on_a_leash = MadeUp(a_chassis())
    assert walked(on_a_leash, Bounds(leash_m=0.2))["crawl"] == "failed"
    with pytest.raises(UserError, match="above the limit"):
        walked(MadeUp(a_chassis()), Bounds(max_speed_mps=2.0))


def test_a_step_that_a_driver_cannot_do_is_not_tried_and_the_rest_is():
    rows: list[dict[str, str]] = []
    now_s = [0.0]

    def sleep(seconds):
        now_s[0] += seconds

    vehicle, asked = MockVehicle(), []
    jogger = jog.Jog(
        vehicle,
        NO_BOUNDS,
        lambda *words: asked.append(words),
        clock=SimpleNamespace(monotonic=lambda: now_s[0], sleep=sleep),
    )
    jog.walk(jogger, rows)
    told = {row["name"]: row["result"] for row in rows}
    lacking = {"remote_control", "emergency_stop", "link_watchdog", "rearm_refused"}
    assert {name for name, result in told.items() if result == "not_tried"} == lacking
    assert {told[name] for name in told.keys() - lacking} == {"passed"}
    assert all(row["measured"] for row in rows)
    assert not {name for name, _ in asked} & lacking


class OverRos2(MadeUp):
    """The ROS 2 driver likewise; its odometry obeys at once and knows of no button."""

    name = "ros2"
    outranked_by: ClassVar[dict[str, str]] = {}
    mute = Vehicle.mute

    def __init__(self, **settings):
        self.rig = Ros2Rig(**settings)
        self.core, self.now_s, self.closed = self.rig.core, self.rig.now_s, False
        self.limits, self.model_limits = self.core.similarity.limits(), self.core.similarity.model()
        self.steers_at_a_stand = "odometry_angular" in settings

    def sleep(self, seconds):
        self.rig.step(round(seconds / STREAM_S))
        self.now_s = self.rig.now_s


@pytest.mark.parametrize("tells_angle", [True, False])
def test_a_ros_2_vehicle_is_tried_as_far_as_its_odometry_tells(tells_angle):
    vehicle = OverRos2(**({"odometry_angular": "steering"} if tells_angle else {}))
    vehicle.sleep(0.1)
    rows: list[dict[str, str]] = []
    clock = SimpleNamespace(monotonic=lambda: vehicle.now_s, sleep=vehicle.sleep)
    jog.walk(jog.Jog(vehicle, NO_BOUNDS, lambda *words: None, clock=clock), rows)
    tried = {row["name"]: row["result"] for row in rows if row["result"] != "not_tried"}
    names = ["feedback", *["steering"] * tells_angle, "crawl", "brake", "watchdog"]
    assert tried == dict.fromkeys(names, "passed")


@pytest.mark.parametrize("angular", ["yaw_rate", "steering"])
def test_only_two_angles_let_the_ros_2_driver_steer_at_a_stand(angular):
    settings = Ros2Settings(
        listen=free_endpoint(), twist_angular="steering", odometry_angular=angular
    )
    with contextlib.closing(Ros2Vehicle(settings, LEFT_TURN)) as vehicle:
        assert vehicle.steers_at_a_stand == (angular == "steering")


@pytest.mark.parametrize("error", [OSError("gone"), SystemExit("gone")])
def test_a_driver_that_raises_is_a_step_that_failed(error):
    vehicle = BrokenVehicle()
    rows: list[dict[str, str]] = []
    vehicle.raises["feedback"] = error
    jog.walk(jog.Jog(vehicle, NO_BOUNDS, lambda *words: None), rows)
    assert (rows[0]["result"], rows[0]["measured"]) == ("failed", "gone")
    assert vehicle.asked[-1] == "close"


class Terminal:
    """Stands for stdin: the operator's lines, then its end."""

    def __init__(self, *lines):
        self.lines = list(lines)

    def isatty(self):
        return False

    def readline(self):
        return self.lines.pop(0) if self.lines else ""


@pytest.mark.parametrize("lines", [(), ("\n",), ("\n", "q\n"), (" stop\n",)])
def test_the_end_of_input_or_any_word_ends_it_with_a_report(lines, monkeypatch, tmp_path):
    monkeypatch.setattr(jog, "SOON_S", 0.05)
    monkeypatch.setattr(jog.sys, "stdin", Terminal(*lines))
    out = tmp_path / "jog.json"
    assert main(["jog", "--vehicle", "mock", "--out", str(out)]) == 1
    report = json.loads(out.read_text())
    assert report["result"] == "failed"
    assert [row["name"] for row in report["steps"]] == NAMES
    assert [row["result"] for row in report["steps"]].count("failed") == 1
    assert all(row.keys() == {"name", "expected", "measured", "result"} for row in report["steps"])


def test_a_signal_ends_it_with_a_report_and_a_second_one_does_not_break_that(monkeypatch, tmp_path):
    def close(vehicle):
        time.sleep(AGAIN_S)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(jog, "ask", lambda *words: signal.raise_signal(signal.SIGINT))
    monkeypatch.setattr(jog, "close_in_time", close)
    out = tmp_path / "jog.json"
    assert main(["jog", "--vehicle", "mock", "--out", str(out)]) == 1
    assert json.loads(out.read_text())["steps"][0]["result"] == "failed"


@pytest.mark.parametrize(
    "flags", [[], ["--vehicle", "none"], ["--vehicle", "mock", "--out", "/"], ["--config", "no"]]
)
def test_bad_input_leaves_no_report(flags):
    with pytest.raises(UserError):
        main(["jog", *flags])


def test_the_real_driver_on_a_bus_crawls_falls_silent_and_is_refused(monkeypatch, tmp_path):
    """In real time: the stream's own thread falls silent. The other steps need no thread."""
    names = ("feedback", "link_watchdog", "rearm_refused")
    monkeypatch.setattr(jog, "STEPS", [step for step in jog.STEPS if step[0] in names])
    orders, ending = Orders(), threading.Event()
    chassis = a_chassis()
    chassis.next_s = chassis._now_s = time.monotonic()
    operator = Operator(lambda name, on: orders.put((name, on)), lambda: chassis.speed_mps > 0.05)
    feedback = HunterVehicle.feedback

    def look(vehicle, now_s):
        report = feedback(vehicle, now_s)
        if not report.self_braking:
            operator.look()
        return report

    monkeypatch.setattr(HunterVehicle, "feedback", look)
    monkeypatch.setattr(jog, "ask", operator)
    out, config = tmp_path / "jog.json", tmp_path / "edge.toml"
    config.write_text(
        '[vehicle]\ndriver = "hunter"\nmax_speed_mps = 0.3\n[vehicle.hunter]\nbus = "virtual:jog"\n'
    )
    with can.Bus(interface="virtual", channel="jog") as bus:
        thread = threading.Thread(target=serve, args=(chassis, bus, orders, ending))
        thread.start()
        try:
            status = main(["jog", "--config", str(config), "--out", str(out)])
        finally:
            ending.set()
            thread.join()
    report = json.loads(out.read_text())
    assert (status, report["result"]) == (0, "passed"), report
    assert {row["result"] for row in report["steps"]} == {"passed"}
    assert chassis.stands
    assert chassis.brake_locked
