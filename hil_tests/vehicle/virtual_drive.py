"""One episode with a vehicle in the loop in virtual time: as over the wire, without a wire."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from bridge.episode import vehicle_action
from bridge.inbound import VehicleDecision
from bridge.tracking import TrackingLog
from edge_runtime.vehicles.base import VehicleReport
from edge_runtime.vehicles.core import State
from edge_runtime.wire import CONTROL_PERIOD_S, DRIVE, Command, Feedback
from hil_tests.mock_hunter.parameters import Parameters
from hil_tests.vehicle.virtual_hunter import VirtualHunter
from trainer.drivers import OnnxDriver

PERIOD_MS = round(1e3 * CONTROL_PERIOD_S)
REARM_MS = 700
"""From a stop until an operator has seen it and five fresh states have come: 0.25 s (half of what
`hil_tests/operator.py` lets pass between two looks) and 0.5 s, in whole control periods."""
VEHICLE, SESSION = "hunter", "virtual"


class Driven(NamedTuple):
    """What became of one episode."""

    seed: int
    outcome: str
    distance_m: float
    time_s: float
    stops: int
    """How often the driver stopped the vehicle."""


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
            self._command(hunter, step, self._driver.act(observation).tolist(), info["speed_mps"])
            newest = None
            for now_ms, report in hunter.run(PERIOD_MS):
                newest = _feedback(step, self.action_names, report, now_ms)
                self.tracking.feedback(newest)
            if hunter.core.state is not State.STOPPED:
                stopped_ms = math.inf
            elif stopped_ms == math.inf:
                stops, stopped_ms = stops + 1, hunter.now_ms
            elif hunter.now_ms - stopped_ms >= REARM_MS:
                hunter.core.enable(hunter.now_ms / 1e3)
            observation, _, terminated, truncated, info = self._env.step(
                self._apply(self._env, _decision(newest))
            )
            step, ended = step + 1, terminated or truncated
        self.tracking.end()
        time_s = step * CONTROL_PERIOD_S
        return Driven(seed, info["outcome"], float(info["distance_m"]), time_s, stops)

    def _command(self, hunter: VirtualHunter, step: int, action: list[float], mps: float) -> None:
        hunter.command(dict(zip(self.action_names, action, strict=True)), mps)
        self.tracking.command(
            Command(
                session=SESSION, episode=0, step=step, mode=DRIVE, action=action, policy_id="",
                received_ns=0, inference_ns=0, sent_ns=hunter.now_ms * 10**6,
            )
        )  # fmt: skip


def _feedback(step: int, names: list[str], report: VehicleReport, now_ms: int) -> Feedback:
    """As `edge_runtime/vehicles/base.py` makes it."""
    return Feedback(
        vehicle=VEHICLE, session=SESSION, episode=0, step=step, mode=DRIVE,
        action=[report.action.get(name, 0.0) for name in names], speed_mps=report.speed_mps,
        self_braking=report.self_braking, faults=report.faults, sent_ns=now_ms * 10**6,
        scenario_speed_mps=report.scenario_speed_mps,
        commanded_speed_mps=report.commanded_speed_mps,
    )  # fmt: skip


def _decision(feedback: Feedback | None) -> VehicleDecision:
    return VehicleDecision(
        command=None, fresh=True, brake_reason="", undriven_s=0.0, feedback=feedback
    )
