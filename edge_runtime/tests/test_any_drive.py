"""Any story of a simulator, an operator and an odometry that lies, told to the real loop, the
vehicle's runner and the Hunter's core, in one thread and made-up time.

Judged is what is true of the vehicle: its speed, its way, how old what it acts on is, and whether
somebody let it move in this episode.
"""

import itertools
import math
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hil_tests.tests.shared.messages import make_state
from hil_tests.tests.shared.policies import PEDAL, TASK, T
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test

from edge_runtime import loop as loop_module
from edge_runtime.bounds import Bounds
from edge_runtime.controller import Controller, ControllerConfig, shared_limits
from edge_runtime.loop import ControlLoop
from edge_runtime.manifest import Layout
from edge_runtime.service import Board
from edge_runtime.tests.rigs import STREAM_S, HunterRig
from edge_runtime.vehicles import base
from edge_runtime.vehicles.base import Vehicle, VehicleRunner
from edge_runtime.vehicles.hunter import protocol
from edge_runtime.wire import DRIVE, encode

CAPS_MPS, LEASHES_M = (0.3, 0.1), (0.3, 0.6, math.inf)
REACTS_S = 0.2  # reports, the loop and the stream, one after the other
OLDEST_S = 2.2 * T + STREAM_S
LIES: dict[str, Any] = {
    "nothing": lambda speed_mps, told_mps: speed_mps,
    "zero": lambda speed_mps, told_mps: 0.0,
    "half": lambda speed_mps, told_mps: speed_mps / 2,
    "double": lambda speed_mps, told_mps: 2 * speed_mps,
    "backwards": lambda speed_mps, told_mps: -speed_mps,
    "frozen": lambda speed_mps, told_mps: told_mps,
    "a leap": lambda speed_mps, told_mps: speed_mps + 0.4,
    "the impossible": lambda speed_mps, told_mps: 5.0,
}


class LyingRig(HunterRig):
    lie, told_mps = "nothing", 0.0

    def tell(self, frame, message):
        if frame is protocol.MOTION_STATUS:
            self.told_mps = LIES[self.lie](message.speed_mps, self.told_mps)
            message = message._replace(speed_mps=self.told_mps)
        super().tell(frame, message)


class CoreVehicle(Vehicle):
    """The Hunter's driver without threads and bus."""

    name = "hunter"

    def __init__(self, core):
        self.core = core
        self.limits, self.model_limits = core.similarity.limits(), core.similarity.model()

    def take_bounds(self, bounds):
        super().take_bounds(bounds)
        self.core.set_point.take_bounds(bounds)

    def enable(self, now_s):
        self.core.enable(now_s)

    def command(self, action, now_s, scenario_speed_mps=None):
        self.core.command(action, now_s, scenario_speed_mps)

    def brake(self, now_s, latch=True):
        self.core.brake(now_s, latch)

    def feedback(self, now_s):
        return self.core.report(now_s)

    def close(self):
        self.core.brake(0.0)


class AnyDrive(RuleBasedStateMachine):
    def __init__(self, patch: Any, scale: Any, each_episode: bool, ride_s: float) -> None:
        super().__init__()
        self.rig = LyingRig(scale=scale)
        self.each_episode, self.ride_s = each_episode, ride_s
        self.session, self.episode, self.steps = 0, 0, itertools.count()
        self.taken_s: dict[Any, float] = {}  # of each state
        self.begun_s = -math.inf  # when the newest episode began, for the loop
        self.place, self.permit, self.gone_m = "", "", 0.0
        self.letters: list[tuple[float, str, str, float]] = []  # re-arms on their way
        self.moved_s = -math.inf
        self.pedal, self.is_known = 1.0, False
        now = SimpleNamespace(
            monotonic=lambda: self.rig.now_s, time_ns=lambda: round(self.rig.now_s * 1e9)
        )
        patch.setattr(base, "time", now)
        patch.setattr(loop_module, "time", now)
        patch.setattr(loop_module, "BoardWatch", lambda: SimpleNamespace(last=Board()))
        patch.setattr(loop_module, "infer", lambda *_: (np.array([self.pedal], np.float32), 0))
        self.start(CAPS_MPS[0], LEASHES_M[0])

    def start(self, cap_mps: float, leash_m: float) -> None:
        """A runtime as `run` starts it, where a service is: unarmed."""
        vehicle = CoreVehicle(self.rig.core)
        vehicle.control_period_s, self.cap_mps, self.leash_m = T, cap_mps, leash_m
        vehicle.take_bounds(Bounds(max_speed_mps=cap_mps, leash_m=leash_m))
        rules = ControllerConfig(
            shared_limits([PEDAL], vehicle.allowed_limits), T, True, False,
            ride_s=self.ride_s, each_episode=self.each_episode,
        )  # fmt: skip
        self.controller = Controller(rules)
        self.runner = VehicleRunner(vehicle, ["pedal"], lambda feedback: None)
        self.runner._watch.begin(self.rig.now_s)
        self.report_s = self.rig.now_s
        made: Any = SimpleNamespace
        policy = made(manifest=made(control_period_s=T), layout=Layout(TASK), policy_id="p")
        link = made(send=self.sent, refusal=lambda now_s: None, vehicle_id="v", rivals=0)
        notifier = made(tell=lambda text: None)
        self.loop = ControlLoop(policy, self.controller, link, notifier, self.runner)
        self.permit = ""

    @rule(count=st.integers(1, 30), gap=st.sampled_from([0.5, 1.0, 1.0, 1.0, 1.9, 3.0, 8.0]))
    def states_come(self, count, gap):
        for _ in range(count):
            self.wait(gap * T)
            self.state()

    @rule(seconds=st.sampled_from([1.0, 3.0, 8.0]), pedal=st.sampled_from([1.0, 1.0, 0.2]))
    def it_is_re_armed_and_drives(self, seconds, pedal):
        self.pedal = pedal
        self.states_come(1, 1.0)
        self.rearm(*self.letter())
        self.states_come(round(seconds / T), 1.0)

    @rule(pedal=st.sampled_from([1.0, 0.2, 0.0, -1.0]))
    def the_policy_wants(self, pedal):
        self.pedal = pedal

    @rule(lie=st.sampled_from([*LIES, "nothing"]))
    def the_odometry_says(self, lie):
        self.rig.lie = lie

    @rule(talks=st.booleans())
    def the_chassis_talks(self, talks):
        self.rig.talks = talks

    @rule(says_so=st.booleans())
    def another_episode(self, says_so):
        if says_so:
            self.wait(T)
            self.state(final=True)
        self.episode += 1
        self.states_come(3, 1.0)

    @rule()
    def another_simulator(self):
        self.wait(3 * T)
        self.session, self.is_known = self.session + 1, False
        self.states_come(3, 1.0)

    @rule(after_s=st.lists(st.sampled_from([0.0, 0.3, 1.0, 3.0]), min_size=1, max_size=3))
    def the_operator_re_arms(self, after_s):
        """Once or again and again; it arrives at once, or when it stands for another reason."""
        self.states_come(1, 1.0)
        self.letters += [(self.rig.now_s + each_s, *self.letter()) for each_s in sorted(after_s)]
        self.states_come(10, 1.0)

    @rule(count=st.integers(1, 8), held_s=st.sampled_from([0.3, 1.0]))
    def a_link_holds_states_back(self, count, held_s):
        if not self.is_known:
            return  # the first state of a session shows no lag
        for _ in range(count):
            self.wait(T)
            self.state(held_s=held_s)

    @rule(cap_mps=st.sampled_from(CAPS_MPS), leash_m=st.sampled_from(LEASHES_M))
    def the_runtime_is_restarted_with_other_bounds(self, cap_mps, leash_m):
        self.rig.core.brake(self.rig.now_s)
        self.wait(0.5)
        scale = self.rig.core.similarity.scale
        self.rig.core = HunterRig(scale=scale).core
        self.rig.core.follow_period(T)
        self.letters.clear()  # those under way end with the process
        self.start(cap_mps, leash_m)

    def state(self, final: bool = False, held_s: float = 0.0) -> None:
        """A state arrives now; it was taken `held_s` ago."""
        step, session, now_s = next(self.steps), f"s{self.session}", self.rig.now_s
        self.taken_s[session, self.episode, step] = now_s - held_s
        sent = {"sent_ns": round((now_s - held_s) * 1e9), "final": final}
        before = self.loop._latest.accepted
        self.loop._on_state(encode(make_state(step, session=session, episode=self.episode, **sent)))
        if self.loop._latest.accepted == before:
            return
        self.is_known = True
        if (place := f"{session}/{self.episode}") != self.place:
            self.place, self.begun_s = place, now_s
        self.loop._answer_next()

    def sent(self, topic: str, message: Any) -> None:
        if topic == "command" and message.mode == DRIVE:
            taken_s = self.taken_s[message.session, message.episode, message.step]
            assert self.rig.now_s - taken_s <= OLDEST_S, "it drives on an old state"

    def letter(self) -> tuple[str, str, float]:
        """What an operator asks for now: by what stop, in which episode, and when."""
        stop = f"{self.place or 'None/None'}/{self.loop.health().safe_stops}"
        return stop, self.place, self.rig.now_s

    def rearm(self, stop: str, place: str, asked_s: float) -> None:
        if self.loop._rearm(stop) == "":
            self.permit, self.gone_m = place, 0.0
            assert self.moved_s <= asked_s + REACTS_S, "it was re-armed for an earlier stop"

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / STREAM_S)):
            self.tick()

    def tick(self) -> None:
        """20 ms of chassis and stream, of the vehicle's thread, of the watchdog; then judge."""
        self.rig.step()
        self.gone_m += abs(self.rig.speed_mps) * STREAM_S
        now_s, runner = self.rig.now_s, self.runner
        due = [letter for letter in self.letters if letter[0] <= now_s]
        self.letters = [letter for letter in self.letters if letter not in due]
        for letter in due:
            self.rearm(*letter[1:])
        enables, order, runner._next = runner._enable_due, runner._next, None
        if enables:
            runner._enable()
        if order is not None:
            runner._obey(order)
        if now_s >= self.report_s:
            self.report_s = now_s + runner._period_s
            runner._report()
        self.loop._look_at_vehicle(now_s)
        self.loop._send(self.controller.tick(now_s))
        self.judge(now_s)

    def judge(self, now_s: float) -> None:
        speed_mps = self.rig.speed_mps
        assert abs(speed_mps) <= 1.03 * self.cap_mps, "above its cap"
        if speed_mps == 0.0:
            return
        self.moved_s = now_s
        assert self.gone_m <= self.leash_m + self.cap_mps * REACTS_S, "beyond its leash"
        assert self.permit, "nobody let it move"
        if self.each_episode and now_s - self.begun_s > REACTS_S:
            assert self.permit == self.place, "it was let move in another episode"


@pytest.mark.parametrize("scale", [0.05, None])
@pytest.mark.parametrize(("each_episode", "ride_s"), [(True, 0.0), (True, 0.5), (False, 0.0)])
def test_any_drive(scale, each_episode, ride_s, monkeypatch):
    patient = settings(max_examples=15, stateful_step_count=12)
    make: Any = partial(AnyDrive, monkeypatch, scale, each_episode, ride_s)
    run_state_machine_as_test(make, settings=patient)
