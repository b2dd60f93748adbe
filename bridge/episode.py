"""One episode over the wire: state out, decision back, one step of the environment, again.

What the environment is stepped with is the policy's command, or what a vehicle made of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import msgspec
import numpy as np

from bridge.clocks import Clock
from bridge.environments import brake_action, press_brake
from bridge.inbound import VehicleDecision
from bridge.messages import Stamps
from bridge.report import EpisodeResult, SafeStopLog
from bridge.virtual_link import Decision
from edge_runtime.safety import Event
from edge_runtime.util import UserError
from edge_runtime.wire import CONTROL_PERIOD_S, State

Environment = gymnasium.Env[Any, Any]
Apply = Callable[[Environment, Decision], np.ndarray]
"""Returns the action of one tick, float32 [n], and presses or releases the brake."""
PEDAL = "pedal"


def policy_action(environment: Environment, decision: Decision) -> np.ndarray:
    """The command's action, the safe stop's, or (before the first command) hands off: zeros."""
    press_brake(environment, bool(decision.brake_reason))
    if decision.brake_reason:
        return brake_action(environment)
    if decision.command is None:
        return np.zeros(environment.action_space.shape or (1,), dtype=np.float32)
    return np.asarray(decision.command.action, dtype=np.float32)


def vehicle_action(action_names: Sequence[str]) -> Apply:
    """Return what applies what the vehicle's actuators have reached.

    Where the vehicle tells the speed of the scenario's car and the environment knows which pedal
    leads to it (``pedal_for_speed``), that pedal takes the place of the reported one: it makes up
    for what the last step missed, while errors of pedals would add up. Without feedback the car
    brakes fully; an environment that is only steered does so whenever the vehicle brakes.

    Args:
        action_names: of the policy's actions, in order.
    """

    def apply(environment: Environment, decision: Decision) -> np.ndarray:
        assert isinstance(decision, VehicleDecision)
        press_brake(environment, bool(decision.brake_reason))
        if decision.feedback is None:
            return brake_action(environment)
        action = np.clip(np.asarray(decision.feedback.action, dtype=np.float32), -1.0, 1.0)
        speed_mps = decision.feedback.scenario_speed_mps
        pedal_for_speed = getattr(environment.unwrapped, "pedal_for_speed", None)
        if speed_mps is not None and callable(pedal_for_speed) and PEDAL in action_names:
            action[list(action_names).index(PEDAL)] = float(pedal_for_speed(speed_mps))
        return action

    return apply


PublishScene = Callable[[Any, Stamps], None]
"""Called with the environment and what is to stand beside its scene."""
OnTick = Callable[[int, int, Decision], None]
"""Called with episode, step, decision after every tick."""


class EpisodeRunner:
    """Drives one environment through a clock and keeps what the report needs."""

    def __init__(
        self,
        environment: gymnasium.Env[Any, Any],
        clock: Clock,
        session: str,
        publish_scene: PublishScene,
        on_tick: OnTick,
        apply: Apply = policy_action,
        standing: bool = False,
        rejected: Callable[[], Mapping[str, int]] = dict,
        task: str = "",
    ) -> None:
        self.safe_stops = SafeStopLog(CONTROL_PERIOD_S)
        self.deadline_misses = 0
        self.command_ages_ms: list[float] = []
        """Of the command that the vehicle obeyed, for each tick in which it obeyed one."""
        self._under_way: State | None = None
        self._environment = environment
        self._clock = clock
        self._session = session
        self._publish_scene = publish_scene
        self._on_tick = on_tick
        self._apply = apply
        self._rejected = rejected
        self._task = task or msgspec.UNSET
        self._options = {"standing": True} if standing else None

    def show_task(self, seed: int) -> None:
        """Send one state, the final one already, so that the edge runtime compares it as well."""
        observation, info = self._environment.reset(seed=seed, options=self._options)
        self._clock.begin(0, seed)
        self._clock.finish(self._state(0, 0, observation, info, final=True))

    def run(self, episode: int, seed: int) -> EpisodeResult:
        """Drive one episode to its end; the seed decides the environment and the link.

        Where it is cut short (^C, a fault of the environment) a final state goes out as well, so
        that the edge runtime stands by instead of stopping for a link that seems to be lost.
        """
        self._under_way = None
        try:
            return self._drive(episode, seed)
        except BaseException:
            if self._under_way is not None:
                cut = self._under_way
                final = msgspec.structs.replace(cut, step=cut.step + 1, final=True)
                self._clock.finish(final)
            raise

    def _drive(self, episode: int, seed: int) -> EpisodeResult:
        observation, info = self._environment.reset(seed=seed, options=self._options)
        self._clock.begin(episode, seed)
        result = EpisodeResult(seed, "", 0.0, 0.0, 0.0, 0.0, 0.0, 0)
        lateral_mps2: list[float] = []
        longitudinal_mps2: list[float] = []
        ended = False
        while not ended:
            state = self._state(episode, result.steps, observation, info)
            self._show(state)
            self._under_way = state
            decision = self._clock.exchange(state)
            if decision.brake_reason == Event.OTHER_TASK.value:
                raise UserError(
                    "the edge runtime's policy is for another task than this environment"
                    f" ({self._task}); start it with a policy of this one"
                )
            action = self._apply(self._environment, decision)
            observation, reward, terminated, truncated, info = self._environment.step(action)
            result.steps += 1
            result.actions.append([float(value) for value in action])
            result.reward += _finite("reward", reward)
            # An environment need not report accelerations; then they count as zero.
            lateral_mps2.append(abs(_number(info, "lateral_acceleration_mps2")))
            longitudinal_mps2.append(abs(_number(info, "longitudinal_acceleration_mps2")))
            self._note(state, decision, _speed_mps(info))
            ended = bool(terminated or truncated)
        final = self._state(episode, result.steps, observation, info, final=True)
        self._show(final)
        self._clock.finish(final)
        self._under_way = None
        result.outcome = str(info.get("outcome") or "ended")
        result.distance_m = _number(info, "distance_m")
        result.time_s = round(result.steps * CONTROL_PERIOD_S, 6)
        result.lateral_acceleration_mps2 = float(np.mean(lateral_mps2))
        result.longitudinal_acceleration_mps2 = float(np.mean(longitudinal_mps2))
        return result

    def _state(
        self,
        episode: int,
        step: int,
        observation: np.ndarray,
        info: dict[str, Any],
        final: bool = False,
    ) -> State:
        return State(
            session=self._session,
            episode=episode,
            step=step,
            sim_time_s=round(step * CONTROL_PERIOD_S, 6),
            sent_ns=0,  # The clock stamps it when it sends it.
            frames=np.ascontiguousarray(observation, dtype=np.uint8).tobytes(),
            speed_mps=_speed_mps(info),
            final=final,
            task=self._task,
        )

    def _show(self, state: State) -> None:
        step, round_trip_ms = self._clock.newest_answer() or (None, None)
        stamps = Stamps(
            state.episode, state.step, state.sim_time_s, round_trip_ms, step, self._rejected()
        )
        self._publish_scene(self._environment, stamps)

    def _note(self, state: State, decision: Decision, speed_mps: float) -> None:
        self.deadline_misses += not decision.fresh
        if decision.command_age_s is not None:
            self.command_ages_ms.append(decision.command_age_s * 1e3)
        self.safe_stops.observe(state.episode, state.step, decision, speed_mps)
        self._on_tick(state.episode, state.step, decision)


def _speed_mps(info: dict[str, Any]) -> float:
    try:
        return _finite("speed_mps", info["speed_mps"])
    except KeyError:
        raise UserError(
            "the environment's info holds no speed_mps, which every state needs"
        ) from None


def _number(info: dict[str, Any], name: str) -> float:
    return _finite(name, info.get(name, 0.0))


def _finite(name: str, value: Any) -> float:
    """Return the number; the wire and the report can carry no other than finite ones."""
    number = float(value)
    if not math.isfinite(number):
        raise UserError(f"the environment's {name} is {number}, not a finite number")
    return number
