"""Drive one episode of an environment over the wire."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from bridge.clocks import Clock
from bridge.environments import Adapter, Environment, finite, offered
from bridge.messages import Origin, Scene
from bridge.outcomes import outcome_of
from bridge.report import ACCELERATIONS, EpisodeResult, SafeStopLog, of_known
from bridge.virtual_link import Decision
from edge_runtime.manifest import Task
from edge_runtime.safety import Event
from edge_runtime.util import UserError
from edge_runtime.wire import State

PEDAL = "pedal"
Apply = Callable[[Adapter, Decision], np.ndarray]
"""Returns the action of one tick, and presses or releases the brake."""
OnTick = Callable[[int, int, Decision], None]  # Takes episode, step and decision after every tick


def policy_action(adapter: Adapter, decision: Decision) -> np.ndarray:
    """Return the command's action, the safe stop's, or (before the first command) hands off."""
    adapter.press_brake(bool(decision.brake_reason))
    if decision.brake_reason:
        return adapter.stop()
    if decision.command is None:
        return adapter.hands_off
    return adapter.within(decision.command.action)


def vehicle_action(adapter: Adapter, decision: Decision) -> np.ndarray:
    """Return what the vehicle's actuators have reached; the safe stop without feedback.

    Where the vehicle reports the speed of the scenario's car and the environment knows which pedal
    leads to it (``pedal_for_speed``), that pedal takes the place of the reported one: it makes up
    for what the last step missed, while errors of pedals would add up.
    """
    adapter.press_brake(bool(decision.brake_reason))
    if decision.feedback is None:
        return adapter.stop()
    pedal_for_speed = offered(adapter.env, "pedal_for_speed")
    speed_mps, action = decision.feedback.scenario_speed_mps, list(decision.feedback.action)
    for place, row in enumerate(adapter.task.action):
        if row.name == PEDAL and speed_mps is not None and pedal_for_speed is not None:
            action[place] = float(pedal_for_speed(speed_mps))
    return adapter.within(action)


@dataclass
class EpisodeRunner:
    """Drives one environment through a clock and collects figures for the report."""

    environment: Environment
    clock: Clock
    publish_scene: Callable[[Any, Scene], None]
    """Called with the environment and the fields to add to its own scene."""
    on_tick: OnTick
    task: Task
    origin: Origin
    """Sent with every scene; each episode has a seed of its own."""
    apply: Apply = policy_action

    def __post_init__(self) -> None:
        self._period_s = self.task.control_period_s
        self.safe_stops = SafeStopLog(self._period_s)
        self._adapter = Adapter(self.environment, self.task)
        self.deadline_misses = 0
        self.command_ages_ms: list[float] = []
        """Of the command that the vehicle obeyed, for each tick in which it obeyed one."""
        self.ridden_steps = 0
        """Ticks in which an action of an earlier command's plan was done."""

    def show_task(self, seed: int) -> None:
        """Send one state, which is final, so that the edge runtime compares the task as well.

        It holds no observation: another policy's may be of another size.
        """
        self.clock.begin(0, seed)
        self.clock.finish(self._state(0, 0, None, {}, final=True))

    def run(self, episode: int, seed: int) -> EpisodeResult:
        """Drive one episode to its end; the seed decides the environment and the link.

        Where it is cut short (^C, a fault of the environment) a final state goes out as well, so
        that the edge runtime stands by instead of stopping for a link that seems to be lost.
        """
        self._under_way: State | None = None
        try:
            return self._drive(episode, seed)
        except BaseException:
            if (cut := self._under_way) is not None:
                self.clock.finish(msgspec.structs.replace(cut, step=cut.step + 1, final=True))
            raise

    def _drive(self, episode: int, seed: int) -> EpisodeResult:
        options = {"standing": True} if self.origin.standing else None
        observation, info = self.environment.reset(seed=seed, options=options)
        self.clock.begin(episode, seed)
        self._adapter.last = self._adapter.hands_off
        self.origin = msgspec.structs.replace(self.origin, seed=seed)
        result = EpisodeResult(seed, "", 0.0, 0.0, 0.0, None, None, 0)
        applied: dict[str, Any] = {}  # What the scene says of the step before
        felt, ended = [], False
        while not ended:
            state = self._state(episode, result.steps, observation, info)
            self._show(state, applied)
            self._under_way = state
            decision = self.clock.exchange(state)
            if decision.brake_reason == Event.OTHER_TASK.value:
                raise UserError(
                    "the edge runtime's policy is for another task than this environment"
                    f" ({self.task.text}); start it with a policy of this one"
                )
            action = self.apply(self._adapter, decision)
            observation, reward, terminated, truncated, info = self.environment.step(action)
            result.steps += 1
            result.actions.append([float(value) for value in action.ravel()])
            result.reward += finite("reward", reward)
            felt.append(accelerations(info))
            self._note(episode, state.step, decision, info)
            braked = bool(decision.brake_reason)
            applied = {"applied": result.actions[-1], "braked": braked, "ridden": decision.ridden}
            ended = bool(terminated or truncated)
        final = self._state(episode, result.steps, observation, info, final=True)
        self._show(final, applied)
        self.clock.finish(final)
        self._under_way = None
        result.outcome = outcome_of(info, only_truncated=not terminated)
        result.distance_m = _number(info, "distance_m") or 0.0
        result.time_s = round(result.steps * self._period_s, 6)
        result.lateral_acceleration_mps2, result.longitudinal_acceleration_mps2 = map(
            of_known, zip(*felt, strict=True)
        )
        return result

    def _note(self, episode: int, step: int, decision: Decision, info: dict[str, Any]) -> None:
        self.deadline_misses += not decision.fresh
        self.ridden_steps += decision.ridden > 0
        if decision.command_age_s is not None:
            self.command_ages_ms.append(decision.command_age_s * 1e3)
        self.safe_stops.observe(episode, step, decision, _number(info, "speed_mps") or 0.0)
        self.on_tick(episode, step, decision)

    def _state(
        self, episode: int, step: int, observation: Any, info: dict[str, Any], final: bool = False
    ) -> State:
        return State(
            session=self.origin.session,
            episode=episode,
            step=step,
            sim_time_s=round(step * self._period_s, 6),
            sent_ns=0,  # The clock stamps it when it sends it.
            observation={} if observation is None else self._adapter.pack(observation),
            speed_mps=_number(info, "speed_mps"),
            final=final,
            task=self.task.text,
        )

    def _show(self, state: State, applied: dict[str, Any]) -> None:
        step, round_trip_ms = self.clock.newest_answer() or (None, None)
        stamps = Scene(
            episode=state.episode, step=state.step, sim_time_s=state.sim_time_s,
            round_trip_ms=round_trip_ms, answered_step=step, rejected=dict(self.clock.rejected()),
            task=self.task, origin=self.origin, **applied,
        )  # fmt: skip
        self.publish_scene(self.environment, stamps)


def accelerations(info: Mapping[str, Any]) -> list[float | None]:
    """Return |a| of a step in the order of ACCELERATIONS; None where it is unknown."""
    values = (_number(info, name) for name in ACCELERATIONS)
    return [None if value is None else abs(value) for value in values]


def _number(info: Mapping[str, Any], name: str) -> float | None:
    value = info.get(name)
    return None if value is None else finite(name, value)
