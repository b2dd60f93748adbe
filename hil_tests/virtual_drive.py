"""One episode with a vehicle in the loop in virtual time: as over the wire, without a wire.

The core of the Hunter's driver and the mock of its chassis exchange the very frames that they send
over CAN, 50 times a second each way; a frame takes no time, and there is no process and no clock.
The phases are fixed: in life the three clocks drift, and their mean is what stands here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bridge.environments import vehicle_action
from bridge.inbound import VehicleDecision
from bridge.report import TrackingLog
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.core import State
from edge_runtime.vehicles.hunter.core import HunterCore
from edge_runtime.vehicles.hunter.protocol import DEFAULT_PROFILE
from edge_runtime.vehicles.mapping import SPECS, car_of, similarity_to
from edge_runtime.wire import CONTROL_PERIOD_S, DRIVE, TOPICS, Command, Feedback
from hil_tests.mock_hunter.hunter import MockHunter, Parameters
from trainer.drivers import OnnxDriver

NAME, MODEL, SESSION = "hunter", "2.0", "virtual"
PERIOD_MS = round(1e3 * CONTROL_PERIOD_S)
STREAM_MS, STREAM_PHASE_MS = 20, 10
CHASSIS_MS = 20
FEEDBACK_MS = round(1000 / TOPICS["feedback"])
FEEDBACK_PHASE_MS = FEEDBACK_MS // 2
"""So the newest feedback at a tick is half a period old, as it is on average in life."""
STEP_MS = 5
READY_MS = 2000
ROUNDING_S = 1e-6
"""The mock adds its periods up: a time that is due may come out later by a rounding."""
REARM_MS = 700
"""From a stop until an operator has seen it and five fresh states have come: 0.25 s (half of what
`processes.operator` lets pass between two looks) and 0.5 s, in whole control periods."""


class Driven(NamedTuple):
    """What became of one episode."""

    seed: int
    outcome: str
    distance_m: float
    time_s: float
    stops: int  # How often the driver stopped the vehicle


class VirtualDrive:
    """A policy with a virtual Hunter in the loop; `tracking` joins all its episodes."""

    def __init__(self, env: Any, driver: OnnxDriver, parameters: Parameters) -> None:
        self.tracking = TrackingLog()
        self._env, self._driver, self._parameters = env, driver, parameters
        self.action_names = [action.name for action in driver.policy.manifest.action]
        self._apply = vehicle_action(self.action_names)

    def episode(self, seed: int) -> Driven:
        """Drive one episode from a stand."""
        hunter = VirtualHunter(self._env.scenario, self._parameters)
        hunter.enable()
        observation, info = self._env.reset(seed=seed, options={"standing": True})
        self.tracking.begin()
        step, stops, stopped_ms, ended = 0, 0, math.inf, False
        while not ended:
            # The runtime's limiter would change nothing: the driver turns its set-points as fast.
            action, mps = self._driver.act(observation).tolist(), info["speed_mps"]
            hunter.command(dict(zip(self.action_names, action, strict=True)), mps)
            command = Command(
                session=SESSION, episode=0, step=step, mode=DRIVE, action=action, policy_id="",
                received_ns=0, inference_ns=0, sent_ns=hunter.now_ms * 10**6,
            )  # fmt: skip
            self.tracking.command(command)
            newest = None
            for now_ms, report in hunter.run(PERIOD_MS):
                # As `edge_runtime/vehicles/base.py` makes it.
                newest = Feedback(
                    vehicle=NAME, session=SESSION, episode=0, step=step, mode=DRIVE,
                    action=[report.action.get(name, 0.0) for name in self.action_names],
                    speed_mps=report.speed_mps, self_braking=report.self_braking,
                    faults=report.faults, sent_ns=now_ms * 10**6,
                    scenario_speed_mps=report.scenario_speed_mps,
                    commanded_speed_mps=report.commanded_speed_mps,
                )  # fmt: skip
                self.tracking.feedback(newest)
            if hunter.core.state is not State.STOPPED:
                stopped_ms = math.inf
            elif stopped_ms == math.inf:
                stops, stopped_ms = stops + 1, hunter.now_ms
            elif hunter.now_ms - stopped_ms >= REARM_MS:
                hunter.core.enable(hunter.now_ms / 1e3)
            heard = VehicleDecision(
                command=None, fresh=True, brake_reason="", undriven_s=0.0, feedback=newest
            )
            observation, _, terminated, truncated, info = self._env.step(
                self._apply(self._env, heard)
            )
            step, ended = step + 1, terminated or truncated
        self.tracking.end()
        time_s = step * CONTROL_PERIOD_S
        return Driven(seed, info["outcome"], float(info["distance_m"]), time_s, stops)


class VirtualHunter:
    """The vehicle's side of the loop. Times are whole milliseconds from its switching on."""

    def __init__(self, scenario: str, parameters: Parameters) -> None:
        similarity = similarity_to(car_of(scenario, NAME), SPECS[MODEL])
        self.core = HunterCore(similarity, DEFAULT_PROFILE)
        self.mock = MockHunter(parameters, 0.0, DEFAULT_PROFILE)
        self.now_ms = 0

    def enable(self) -> None:
        """Take control; RuntimeError where the chassis does not confirm it (a fault of ours)."""
        self.core.enable(self.now_ms / 1e3)
        self.run(READY_MS)
        if self.core.state is not State.ENABLED:
            raise RuntimeError(f"not enabled: {self.core.report(self.now_ms / 1e3).faults}")

    def command(self, action: Mapping[str, float], scenario_speed_mps: float) -> None:
        """What the edge runtime asks now."""
        self.core.command(dict(action), self.now_ms / 1e3, scenario_speed_mps)

    def run(self, duration_ms: int) -> Sequence[tuple[int, VehicleReport]]:
        """Let time pass; the reports that go out as feedback meanwhile, each with its time."""
        reports = []
        for now_ms in range(self.now_ms, self.now_ms + duration_ms, STEP_MS):
            now_s = now_ms / 1e3 + ROUNDING_S
            if now_ms % CHASSIS_MS == 0:
                for wire in self.mock.due(now_s):
                    self.core.hear(wire.can_id, wire.data, now_s)
            if now_ms % STREAM_MS == STREAM_PHASE_MS:
                for sent in self.core.tick(now_s):
                    self.mock.receive(sent.frame.can_id, sent.data, now_s)
            if now_ms % FEEDBACK_MS == FEEDBACK_PHASE_MS:
                reports.append((now_ms, self.core.report(now_s)))
        self.now_ms += duration_ms
        return reports
