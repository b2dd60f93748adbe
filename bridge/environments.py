"""Finding the environment to serve, and driving one episode of it over the wire.

The bridge knows environments only by name: it is given a gymnasium id and imports nothing of the
trainer itself. An episode is: state out, decision back, one step of the environment, again. What
the environment is stepped with is the policy's command, or what a vehicle made of it.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium.envs.registration import namespace
from gymnasium.spaces import Box

from bridge.clocks import Clock
from bridge.inbound import VehicleDecision
from bridge.messages import Stamps
from bridge.report import EpisodeResult, SafeStopLog
from bridge.virtual_link import Decision
from edge_runtime.policy import Manifest, task_text
from edge_runtime.safety import Event
from edge_runtime.util import UserError
from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE, State

SCENARIOS = {"left_turn": "phil/LeftTurn-v0", "congestion": "phil/Congestion-v0"}
"""Scenario word on the command line and in the report -> gymnasium id."""
NOMINAL = "nominal"
CONDITIONS = {
    NOMINAL: "the scene that is trained in",
    "variant": "more vehicles, and other types of them",
    "dense": "closer and less even traffic",
}
"""Scenes that can be served, with what they are."""

PLUGIN_GROUP, ROOT = "gymnasium.envs", "__root__"

HINT = f"use {', '.join(SCENARIOS)}, a gymnasium id, or module:id"
_NAME = re.compile(r"(?:\w+(?:\.\w+)*:)?[^:\s]+")


def make_environment(name: str, condition: str = NOMINAL) -> gymnasium.Env[Any, Any]:
    """Make the environment of a scenario word, a gymnasium id or ``module:id``.

    Another condition than the nominal one is asked for by the keyword ``scene``.

    Raises UserError for an unknown name, a module that does not import, or an environment whose
    observation or action space the wire cannot carry.
    """
    environment_id = SCENARIOS.get(name, name)
    if environment_id.startswith("phil/"):
        environment_id = f"trainer.scenarios:{environment_id}"  # the module that registers it
    if not _NAME.fullmatch(environment_id):
        raise UserError(f"{name!r} names no environment; {HINT}")
    try:
        load_plugin(environment_id)
        options: dict[str, Any] = {} if condition == NOMINAL else {"scene": condition}
        environment = gymnasium.make(environment_id, **options)
    except (Exception, SystemExit) as error:  # A module may raise anything when it is imported.
        first_line = (str(error).splitlines() or [""])[0]
        what = f"{type(error).__name__}: {first_line}" if first_line else type(error).__name__
        raise UserError(f"no environment {name!r}: {what} ({HINT})") from error
    _check_spaces(environment, name)
    return environment


def scenario_of(name: str) -> str:
    """Return the scenario word for any form of an environment's name; the name if it has none."""
    words = {environment_id: word for word, environment_id in SCENARIOS.items()}
    return words.get(name.rpartition(":")[2], name)


def task_of(
    environment: gymnasium.Env[Any, Any], name: str, manifest: Manifest | None = None
) -> str:
    """Return what the environment is for, as a policy's manifest says it of itself.

    The scenario is known by its word or id, the actions' names of an environment that has
    ``action_names``, their ranges always. What is not known is taken from ``manifest``; without
    one the answer is empty then.
    """
    scenario = scenario_of(name)
    names = list(getattr(environment.unwrapped, "action_names", ()))
    if manifest is not None:
        scenario = scenario if scenario in SCENARIOS else manifest.scenario
        names = names or [action.name for action in manifest.action]
    elif scenario not in SCENARIOS or not names:
        return ""
    space = environment.action_space
    assert isinstance(space, Box)
    names += ["an action"] * (len(space.low) - len(names))
    return task_text(scenario, list(zip(names, space.low, space.high, strict=False)))


def load_plugin(environment_id: str) -> None:
    """Let an installed package register the id, as Gymnasium did by itself before 1.0.

    Such a package declares an entry point of the group ``gymnasium.envs``: its name is the
    namespace of its ids (ROOT: none), its value a function that registers them. Only what the id
    needs is imported.
    """
    if ":" in environment_id or environment_id in gymnasium.registry:
        return
    wanted = environment_id.rpartition("/")[0]
    for plugin in importlib.metadata.entry_points(group=PLUGIN_GROUP, name=wanted or ROOT):
        register = plugin.load()
        with namespace(wanted) if wanted else contextlib.nullcontext():
            if callable(register):  # A module has registered them by being imported.
                register()


def _check_spaces(environment: gymnasium.Env[Any, Any], name: str) -> None:
    observation, action = environment.observation_space, environment.action_space
    frames = isinstance(observation, Box) and observation.shape == FRAMES_SHAPE
    if not frames or observation.dtype != np.uint8:
        raise UserError(
            f"environment {name!r} observes {observation}; the wire carries uint8 {FRAMES_SHAPE}"
        )
    bounded = isinstance(action, Box) and np.all(action.low == -1) and np.all(action.high == 1)
    if not bounded or len(action.shape or ()) != 1:
        raise UserError(f"environment {name!r} acts in {action}; the wire carries Box(-1, 1, (n,))")


def brake_action(environment: gymnasium.Env[Any, Any]) -> np.ndarray:
    """Return the action of a safe stop, float32 [n]: the environment's own, or -1 throughout.

    An environment whose action brakes gives full brake here; one that is steered gives the last
    steering, and brakes by ``press_brake``.
    """
    own = getattr(environment.unwrapped, "brake_action", None)
    if own is not None:
        return np.asarray(own, dtype=np.float32)
    return np.full(environment.action_space.shape or (1,), -1.0, dtype=np.float32)


def press_brake(environment: gymnasium.Env[Any, Any], pressed: bool) -> None:
    """Press or release the brake of an environment whose action only steers; others have none."""
    press = getattr(environment.unwrapped, "press_brake", None)
    if callable(press):
        press(pressed)


def scene_of(environment: gymnasium.Env[Any, Any]) -> dict[str, Any] | None:
    """Return the picture seen from above, for viewers only; None if there is none."""
    scene = getattr(environment.unwrapped, "scene", None)
    return scene() if callable(scene) else None


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
    ``action_names`` are those of the policy's actions, in order.
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


@dataclass
class EpisodeRunner:
    """Drives one environment through a clock and keeps what the report needs."""

    environment: Environment
    clock: Clock
    session: str
    publish_scene: PublishScene
    on_tick: OnTick
    apply: Apply = policy_action
    standing: bool = False
    rejected: Callable[[], Mapping[str, int]] = dict
    task: str = ""

    def __post_init__(self) -> None:
        self.safe_stops = SafeStopLog(CONTROL_PERIOD_S)
        self.deadline_misses = 0
        self.command_ages_ms: list[float] = []
        """Of the command that the vehicle obeyed, for each tick in which it obeyed one."""
        self._under_way: State | None = None
        self._options = {"standing": True} if self.standing else None

    def show_task(self, seed: int) -> None:
        """Send one state, the final one already, so that the edge runtime compares it as well."""
        observation, info = self.environment.reset(seed=seed, options=self._options)
        self.clock.begin(0, seed)
        self.clock.finish(self._state(0, 0, observation, info, final=True))

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
        result = EpisodeResult(seed, "", 0.0, 0.0, 0.0, 0.0, 0.0, 0)
        lateral_mps2: list[float] = []
        longitudinal_mps2: list[float] = []
        ended = False
        while not ended:
            state = self._state(episode, result.steps, observation, info)
            self._show(state)
            self._under_way = state
            decision = self.clock.exchange(state)
            if decision.brake_reason == Event.OTHER_TASK.value:
                raise UserError(
                    "the edge runtime's policy is for another task than this environment"
                    f" ({self.task}); start it with a policy of this one"
                )
            action = self.apply(self.environment, decision)
            observation, reward, terminated, truncated, info = self.environment.step(action)
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
        self.clock.finish(final)
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
            session=self.session,
            episode=episode,
            step=step,
            sim_time_s=round(step * CONTROL_PERIOD_S, 6),
            sent_ns=0,  # The clock stamps it when it sends it.
            frames=np.ascontiguousarray(observation, dtype=np.uint8).tobytes(),
            speed_mps=_speed_mps(info),
            final=final,
            task=self.task or msgspec.UNSET,
        )

    def _show(self, state: State) -> None:
        step, round_trip_ms = self.clock.newest_answer() or (None, None)
        stamps = Stamps(
            state.episode, state.step, state.sim_time_s, round_trip_ms, step, self.rejected()
        )
        self.publish_scene(self.environment, stamps)

    def _note(self, state: State, decision: Decision, speed_mps: float) -> None:
        self.deadline_misses += not decision.fresh
        if decision.command_age_s is not None:
            self.command_ages_ms.append(decision.command_age_s * 1e3)
        self.safe_stops.observe(state.episode, state.step, decision, speed_mps)
        self.on_tick(state.episode, state.step, decision)


def _speed_mps(info: dict[str, Any]) -> float:
    if "speed_mps" not in info:
        raise UserError("the environment's info holds no speed_mps, which every state needs")
    return _number(info, "speed_mps")


def _number(info: dict[str, Any], name: str) -> float:
    return _finite(name, info.get(name, 0.0))


def _finite(name: str, value: Any) -> float:
    """Return the number; the wire and the report can carry no other than finite ones."""
    number = float(value)
    if not math.isfinite(number):
        raise UserError(f"the environment's {name} is {number}, not a finite number")
    return number
