"""Driving one episode of an environment over the wire.

An episode is: state out, decision back, one step of the environment, again. What the environment is
stepped with is the policy's command, or what a vehicle made of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from bridge.clocks import Clock
from bridge.environments import Environment, entry_name, finite, offered
from bridge.messages import Origin, Scene
from bridge.outcomes import outcome_of
from bridge.report import ACCELERATIONS, EpisodeResult, SafeStopLog, of_known
from bridge.virtual_link import Decision
from edge_runtime.manifest import Action, Layout, Task
from edge_runtime.safety import Event
from edge_runtime.util import UserError
from edge_runtime.wire import Feedback, State

PEDAL = "pedal"


class Actuators:
    """Applies actions to an environment; ``actions`` are the policy's, with their safe stops.

    An environment's own ``brake_action`` and ``press_brake`` come before those.
    """

    def __init__(self, environment: Environment, actions: Sequence[Action]) -> None:
        self._environment, self._actions = environment, actions
        space: Any = environment.action_space
        self._space, self._shape = space, space.shape
        self.hands_off: np.ndarray = np.clip(0.0, space.low, space.high).astype(space.dtype)
        """Zero, or the nearest in range: what is done before the first command."""
        self.last = self.hands_off

    def brake(self, pressed: bool) -> None:
        """Press or release the brake of an environment that has one: its action only steers."""
        press = offered(self._environment, "press_brake")
        if callable(press):
            press(pressed)

    def stop(self) -> np.ndarray:
        """The action of a safe stop, in the environment's shape."""
        own = offered(self._environment, "brake_action")
        if own is not None:
            return self.within(own)
        pairs = zip(self._actions, self.last.ravel().tolist(), strict=True)
        return self.within([last if row.stop is None else row.stop for row, last in pairs])

    def reached(self, feedback: Feedback) -> np.ndarray:
        """What a vehicle's actuators have reached.

        Where it tells the speed of the scenario's car and the environment knows which pedal leads
        to it (``pedal_for_speed``), that pedal takes the place of the reported one: it makes up
        for what the last step missed, while errors of pedals would add up.
        """
        pedal_for_speed = offered(self._environment, "pedal_for_speed")
        speed_mps, action = feedback.scenario_speed_mps, list(feedback.action)
        for place, row in enumerate(self._actions):
            if row.name == PEDAL and speed_mps is not None and pedal_for_speed is not None:
                action[place] = float(pedal_for_speed(speed_mps))
        return self.within(action)

    def within(self, action: Any) -> np.ndarray:
        """The numbers as an action of the environment, within its range."""
        values = np.asarray(action, self._space.dtype).reshape(self._shape)
        self.last = np.clip(values, self._space.low, self._space.high)
        return self.last


Apply = Callable[[Actuators, Decision], np.ndarray]
"""Returns the action of one tick, and presses or releases the brake."""


def policy_action(actuators: Actuators, decision: Decision) -> np.ndarray:
    """The command's action, the safe stop's, or (before the first command) hands off."""
    actuators.brake(bool(decision.brake_reason))
    if decision.brake_reason:
        return actuators.stop()
    if decision.command is None:
        return actuators.hands_off
    return actuators.within(decision.command.action)


def vehicle_action(actuators: Actuators, decision: Decision) -> np.ndarray:
    """What the vehicle's actuators have reached.

    Without feedback the car brakes fully; an environment that is only steered does so whenever the
    vehicle brakes.
    """
    actuators.brake(bool(decision.brake_reason))
    return actuators.reached(decision.feedback) if decision.feedback else actuators.stop()


@dataclass
class EpisodeRunner:
    """Drives one environment through a clock and keeps what the report needs."""

    environment: Environment
    clock: Clock
    publish_scene: Callable[[Any, Scene], None]
    """Called with the environment and what is to stand beside its own scene."""
    on_tick: Callable[[int, int, Decision], None]
    """Called with episode, step, decision after every tick."""
    task: Task
    origin: Origin
    """Of the drive, to be told with every scene; each episode has a seed of its own."""
    apply: Apply = policy_action

    def __post_init__(self) -> None:
        self._layout, self._period_s = Layout(self.task), self.task.control_period_s
        self.safe_stops = SafeStopLog(self._period_s)
        self._actuators = Actuators(self.environment, self.task.action)
        self.deadline_misses = 0
        self.command_ages_ms: list[float] = []
        """Of the command that the vehicle obeyed, for each tick in which it obeyed one."""
        self.ridden_steps = 0
        """Ticks in which an action of an earlier command's plan was done."""
        self._ridden = 0  # `Decision.ridden` of the tick before
        self._under_way: State | None = None
        self._applied: tuple[list[float] | None, bool] = (None, False)
        self._options = {"standing": True} if self.origin.standing else None

    def show_task(self, seed: int) -> None:
        """Send one state, the final one already, so that the edge runtime compares it as well.

        It shows nothing: what another policy observes may be of another size.
        """
        self.clock.begin(0, seed)
        self.clock.finish(self._state(0, 0, None, {}, final=True))

    def run(self, episode: int, seed: int) -> EpisodeResult:
        """Drive one episode to its end; the seed decides the environment and the link.

        Where it is cut short (^C, a fault of the environment) a final state goes out as well, so
        that the edge runtime stands by instead of stopping for a link that seems to be lost.
        """
        self._under_way = None
        try:
            return self._drive(episode, seed)
        except BaseException:
            if (cut := self._under_way) is not None:
                self.clock.finish(msgspec.structs.replace(cut, step=cut.step + 1, final=True))
            raise

    def _drive(self, episode: int, seed: int) -> EpisodeResult:
        observation, info = self.environment.reset(seed=seed, options=self._options)
        self.clock.begin(episode, seed)
        self._actuators.last = self._actuators.hands_off
        self._ridden = 0
        self.origin = msgspec.structs.replace(self.origin, seed=seed)
        self._applied = (None, False)
        result = EpisodeResult(seed, "", 0.0, 0.0, 0.0, None, None, 0)
        felt, ended = [], False
        while not ended:
            state = self._state(episode, result.steps, observation, info)
            self._show(state)
            self._under_way = state
            decision = self.clock.exchange(state)
            if decision.brake_reason == Event.OTHER_TASK.value:
                raise UserError(
                    "the edge runtime's policy is for another task than this environment"
                    f" ({self.task.text}); start it with a policy of this one"
                )
            action = self.apply(self._actuators, decision)
            observation, reward, terminated, truncated, info = self.environment.step(action)
            result.steps += 1
            applied = [float(value) for value in action.ravel()]
            result.actions.append(applied)
            self._applied = (applied, bool(decision.brake_reason))
            result.reward += finite("reward", reward)
            felt.append(accelerations(info))
            self.deadline_misses += not decision.fresh
            self._ridden = decision.ridden
            self.ridden_steps += decision.ridden > 0
            if decision.command_age_s is not None:
                self.command_ages_ms.append(decision.command_age_s * 1e3)
            self.safe_stops.observe(episode, state.step, decision, _speed_mps(info) or 0.0)
            self.on_tick(episode, state.step, decision)
            ended = bool(terminated or truncated)
        final = self._state(episode, result.steps, observation, info, final=True)
        self._show(final)
        self.clock.finish(final)
        self._under_way = None
        result.outcome = outcome_of(info, only_truncated=not terminated)
        result.distance_m = _number(info, "distance_m")
        result.time_s = round(result.steps * self._period_s, 6)
        result.lateral_acceleration_mps2, result.longitudinal_acceleration_mps2 = map(
            of_known, zip(*felt, strict=True)
        )
        return result

    def _state(
        self, episode: int, step: int, observation: Any, info: dict[str, Any], final: bool = False
    ) -> State:
        packed = {}
        if observation is not None:
            packed = pack(self._layout, self.environment, observation)
        return State(
            session=self.origin.session,
            episode=episode,
            step=step,
            sim_time_s=round(step * self._period_s, 6),
            sent_ns=0,  # The clock stamps it when it sends it.
            observation=packed,
            speed_mps=_speed_mps(info),
            final=final,
            task=self.task.text,
        )

    def _show(self, state: State) -> None:
        step, round_trip_ms = self.clock.newest_answer() or (None, None)
        applied, braked = self._applied
        stamps = Scene(
            episode=state.episode, step=state.step, sim_time_s=state.sim_time_s,
            round_trip_ms=round_trip_ms, answered_step=step, rejected=dict(self.clock.rejected()),
            task=self.task, origin=self.origin, applied=applied, braked=braked,
            ridden=self._ridden,
        )  # fmt: skip
        self.publish_scene(self.environment, stamps)


def pack(layout: Layout, environment: Environment, observation: Any) -> dict[str, bytes]:
    """An environment's observation as a state carries it. Raises UserError for another shape."""
    if not isinstance(observation, Mapping):
        observation = {entry_name(environment): observation}
    packed = {}
    for name, dtype, shape, _ in layout.parts:
        packed[name] = array_of(observation, name, dtype, shape).tobytes()
    return packed


def array_of(
    observation: Mapping[str, Any], name: str, dtype: np.dtype[Any], shape: tuple[int, ...]
) -> np.ndarray:
    """An entry of an observation as its task has it. Raises UserError where it does not fit."""
    try:
        given = np.asarray(observation[name])
        array = np.asarray(given, dtype)
    except (LookupError, TypeError, ValueError) as error:
        raise UserError(f"the observation {name}: {type(error).__name__}: {error}") from None
    if array.shape != shape:
        raise UserError(f"the observation {name} is {array.shape}, not {shape}")
    # A float may come as any number; of whole numbers none may change.
    if dtype.kind != "f" and not (given.dtype.kind in "iub" and np.array_equal(array, given)):
        value = given.ravel()[np.argmax(array != given)]
        raise UserError(
            f"the observation {name} holds {value} ({given.dtype}); it is to be {dtype}"
        )
    return array


def accelerations(info: Mapping[str, Any]) -> list[float | None]:
    """|a| of a step in the order of ACCELERATIONS; None where the environment does not say."""
    return [None if info.get(n) is None else abs(finite(n, info[n])) for n in ACCELERATIONS]


def _speed_mps(info: dict[str, Any]) -> float | None:
    return None if info.get("speed_mps") is None else _number(info, "speed_mps")


def _number(info: dict[str, Any], name: str) -> float:
    value = info.get(name)
    return 0.0 if value is None else finite(name, value)
