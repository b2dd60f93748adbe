"""Environments by name: the two scenarios, and any other environment adapted to look like them.

An observation is one array (a structured one for several entries), an action is float32 [n] in
[-1, 1]; `outer` and `inner` alone scale it. A step's ``info`` holds position, speed and, in the
last step, the outcome.
"""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray

from bridge import environments as bridge
from bridge.inbound import ROUNDING_S
from bridge.network import COMMAND_WINDOW, LatencySpec, VirtualLink
from bridge.outcomes import UNKNOWN, outcome_of
from edge_runtime.manifest import Task
from edge_runtime.util import UserError, load_named
from edge_runtime.wire import DRIVE, Command
from trainer.human.guide import Action, Expert, Reason
from trainer.learner.replay import Observation, ReplayLayout
from trainer.scenarios import SCENARIOS, Scene
from trainer.util import PERIOD_S

COMMAND_NOISE = 0.05 * 2.0
"""Standard deviation of the noise condition: 5 % of the whole control domain (section VII-D)."""
MOST_STEPS = 1000  # Episode limit where the environment has none
BEYOND = "an action beyond its range, or a number that is not finite"
BEARABLE = 1e4  # Larger observed numbers get a warning: networks learn from numbers near 1


Judge = Callable[[Any, Mapping[str, Any], float], bool | None]
"""Takes the last observation, its info and the episode's return; None: not known."""


class Condition(NamedTuple):
    """The scene and the command noise of test episodes."""

    scene: Scene
    noise_std: float  # Standard deviation of the Gaussian noise on the command
    meaning: str


NOISY = "Gaussian noise of 5 % of the control domain on the command"
CONDITIONS = {
    "nominal": Condition("nominal", 0.0, bridge.CONDITIONS["nominal"]),
    "noise": Condition("nominal", COMMAND_NOISE, NOISY),
    "variant": Condition("variant", 0.0, bridge.CONDITIONS["variant"]),
    "dense": Condition("dense", 0.0, bridge.CONDITIONS["dense"]),
}
"""Training and validation use only the first."""


def make_environment(
    name: str,
    condition: str = "nominal",
    printed_reward: bool = False,
    period_s: float | None = None,
    success: str = "",
) -> Any:
    """Make an environment by its name: one of our scenarios, a gymnasium id or ``module:id``.

    Our scenarios come unwrapped, in the scene of a test condition; any other is `Adapted`. With
    ``printed_reward`` they use eq. 31 or 32 as printed, without their own weight. The control
    period is ``period_s``, else the environment's, else 0.1 s, with a notice. ``success`` is a
    ``module:function`` that judges episodes where the environment does not. Raises UserError.
    """
    name, scene = scenario_of(name), CONDITIONS[condition].scene
    if name not in SCENARIOS:
        if printed_reward:
            raise UserError(f"printed_reward is for the paper's scenarios, not for {name}")
        judge = load_named(success, "function") if success else None
        return Adapted(bridge.make_environment(name, scene), name, period_s, judge)
    if success:
        raise UserError(f"success is not for {name}, which itself says how an episode ended")
    scenario: Any = gymnasium.make(SCENARIOS[name], scene=scene).unwrapped
    if printed_reward:
        scenario.config = replace(scenario.config, **{scenario.config.scaled: 1.0})
    scenario.control_period_s = bridge.describe(scenario, period_s).control_period_s
    return scenario


def scenario_of(name: str) -> str:
    """Return the short name of a scenario given by its gymnasium id; any other name unchanged."""
    short_names = {environment_id: short for short, environment_id in SCENARIOS.items()}
    return short_names.get(name.rpartition(":")[2], name)


def check_trained_in(env: Any, policy: Path, scenario: str) -> None:
    """Raise UserError unless a policy was trained in this environment; no file selects it."""
    if scenario != env.scenario:
        raise UserError(f"{policy} was trained in {scenario}, not in {env.scenario}")


def entries_of(observations: NDArray[Any], plain: str) -> dict[str, NDArray[Any]]:
    """Return observations by the entry names of a policy file; a single entry is ``plain``."""
    names = observations.dtype.names
    return {name: observations[name] for name in names} if names else {plain: observations}


def as_array(layout: ReplayLayout, entries: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Pack an observation's entries into one array."""
    packed = np.zeros(layout.shape, layout.dtype)
    for name, entry in entries.items():
        (packed[name] if packed.dtype.names else packed)[...] = entry
    return packed


def check_recorded(env: Any, path: Path, observation: NDArray[Any], *actions: Action) -> None:
    """Raise UserError unless a step recorded in ``path`` could be one of ``env``."""
    seen = (observation.shape, observation.dtype) == (env.layout.shape, env.layout.dtype)
    if not seen or any(action.shape != env.action_space.shape for action in actions):
        raise UserError(f"{path} holds observations or actions that are none of {env.scenario}")
    entries = entries_of(observation, "").values()
    if not (np.abs(actions).max() <= 1.0 and all(np.isfinite(entry).all() for entry in entries)):
        raise UserError(f"{path} holds {BEYOND}")


def own_environment(env: Any) -> Any:
    """Return the environment as its author made it: in its own units."""
    return env if env.scenario in SCENARIOS else env.env


def task_of(env: Any) -> Task:
    """Return the task that a policy file for the environment must have."""
    return bridge.describe(own_environment(env), env.control_period_s)


def foresee(env: Any, observation: Any, action: Action, steps: int) -> list[Any]:
    """Return this observation and the next ``steps`` ones if the action were held.

    A copy of the environment takes the steps; the list ends early where the episode ends.
    """
    observations, ahead = [observation], copy.deepcopy(env)
    for _ in range(steps):
        observation, _, terminated, truncated, _ = ahead.step(action)
        observations.append(observation)
        if terminated or truncated:
            break
    return observations


def check_foresight(env: Any) -> None:
    """Raise UserError unless a deep copy of the environment drives on as the environment does.

    Ten steps must be the same. A copy of gymnasium's MuJoCo and Box2D environments (``EzPickle``)
    has nothing of their state.
    """
    action, steps = np.ones(env.action_space.shape, np.float32), 10
    try:
        driven = copy.deepcopy(env)  # The run's own stays as it is.
        observation, _ = driven.reset(seed=0)
        for _ in range(steps):  # Away from the start, where a copy without state would stand
            observation, _, terminated, truncated, _ = driven.step(action)
            if terminated or truncated:
                observation, _ = driven.reset(seed=0)
                break
        foreseen = foresee(driven, observation, action, steps)
        seen = [observation, *(driven.step(action)[0] for _ in foreseen[1:])]
    except Exception as error:  # An environment's own code may raise anything.
        raise UserError(f"{env.scenario} cannot be copied to look ahead: {error}") from error
    if any(one.tobytes() != other.tobytes() for one, other in zip(seen, foreseen, strict=True)):
        raise UserError(f"{env.scenario} cannot be copied to look ahead: a copy drives differently")


def expert_of(env: Any, human: str = "expert") -> Expert:
    """Make the environment's scripted expert, or a ``module:Class``; UserError if there is none."""
    if ":" not in human:
        if env.expert is None:
            raise UserError(f"{env.scenario} offers no expert(); name one as module:Class")
        return env.expert()
    expert_class = load_named(human, "expert")
    try:
        return _ScaledExpert(env, expert_class(env.unwrapped))
    except Exception as error:  # It may raise anything
        raise UserError(f"no expert {human!r}: {type(error).__name__}: {error}") from error


def outer(action_range: tuple[Any, Any], action: Any) -> NDArray[np.float32]:
    """Scale an action from [-1, 1], float32 [n], to a range (low, high), as in a policy file."""
    low, high = action_range
    return np.asarray(low + 0.5 * (np.clip(action, -1.0, 1.0) + 1.0) * (high - low), np.float32)


def inner(action_range: tuple[Any, Any], action: Any) -> Action:
    """Scale an action of a range, of any shape, to [-1, 1], float32 [n]."""
    low, high = action_range
    share = (np.asarray(action, np.float64).reshape(-1) - low) / np.maximum(high - low, 1e-12)
    return np.clip(2.0 * share - 1.0, -1.0, 1.0).astype(np.float32)


def _asked(judge: Judge, *ending: Any) -> bool | None:
    try:
        said = judge(*ending)
    except (Exception, SystemExit) as error:  # It may raise anything.
        raise UserError(f"--success failed: {type(error).__name__}: {error}") from error
    if said is None or isinstance(said, bool | np.bool_):
        return said
    raise UserError(f"--success must return True, False or None, not {type(said).__name__}")


class Adapted(bridge.Adapter):
    """Gives any environment the interface of our two scenarios.

    ``name`` is the name it was made by; ``judge`` decides at an episode's end whether it
    succeeded, where the environment says nothing. Raises UserError for spaces that
    `bridge.environments.describe` refuses.
    """

    goal_m = float("nan")
    biased_action = 1.0

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        name: str,
        period_s: float | None = None,
        judge: Judge | None = None,
    ) -> None:
        super().__init__(env, bridge.describe(env, period_s, PERIOD_S))
        self.scenario, self.unwrapped, self.judge = name, env.unwrapped, judge
        self.observation_space = env.observation_space
        self.control_period_s = self.task.control_period_s
        self.action_names = tuple(row.name for row in self.task.action)
        entries = [(n, np.dtype(e.dtype), tuple(e.shape)) for n, e in self.task.observation.items()]
        _, dtype, shape = entries[0]
        several = isinstance(env.observation_space, Dict)
        self.layout = ReplayLayout((), np.dtype(entries)) if several else ReplayLayout(shape, dtype)
        self.action_range = self._space.low.reshape(-1), self._space.high.reshape(-1)
        self.action_space = Box(-1.0, 1.0, (len(self.task.action),), np.float32)
        self.rest_action: Action = inner(self.action_range, self.hands_off)
        self.key_rate_per_s = float(bridge.offered(env, "key_rate_per_s", 5.0))
        own = bridge.offered(env, "expert")
        self.expert = own and (lambda: _ScaledExpert(self, own()))
        self.can_be_seen = bridge.draws(env) or callable(bridge.offered(env, "scene"))
        if env.spec is None or env.spec.max_episode_steps is None:
            bridge.say_once(f"{name} has no step limit: episodes end after {MOST_STEPS} steps")
            self.env = gymnasium.wrappers.TimeLimit(env, MOST_STEPS)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin an episode."""
        self._last_action, self._return = self.rest_action, 0.0
        observation, info = self.env.reset(seed=seed, options=options)
        return self._as_array(observation), _completed(info)

    def step(self, action: Action) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Drive for one control period."""
        self._last_action = np.asarray(action, np.float32)
        own = outer(self.action_range, action).reshape(self._space.shape)
        own = own.astype(self._space.dtype)
        observation, reward, terminated, truncated, info = self.env.step(own)
        info, reward = _completed(info), bridge.finite("reward", reward)
        self._return += reward
        if terminated or truncated:
            if self.judge and outcome_of(info) == UNKNOWN:
                info["is_success"] = _asked(self.judge, observation, info, self._return)
            info["outcome"] = outcome_of(info, only_truncated=not terminated)
        return self._as_array(observation), reward, bool(terminated), bool(truncated), info

    def close(self) -> None:
        """Close the environment: some simulators allow only one in a process."""
        self.env.close()

    @property
    def brake_action(self) -> Action:
        """The environment's own stop, or the last action where it has none."""
        own = bridge.offered(self.env, "brake_action")
        return self._last_action if own is None else inner(self.action_range, own)

    def scene(self) -> dict[str, Any] | None:
        """Return the scene from above in metres; None where the environment has none."""
        return bridge.scene_of(self.env)

    def render(self) -> NDArray[np.uint8]:
        """Return the environment's picture, uint8 [height, width, 3]."""
        picture: Any = self.env.render()
        return picture

    @property
    def keys(self) -> dict[str, Action]:
        """Key -> the action while it is held, in [-1, 1]; the arrows for a single action."""
        own: Mapping[str, Any] = bridge.offered(self.env, "keys", {})
        if not own and len(self.action_names) == 1:
            full = np.ones(1, np.float32)
            return {"up": full, "right": full, "down": -full, "left": -full}
        return {name: inner(self.action_range, action) for name, action in own.items()}

    def _as_array(self, observation: Any) -> NDArray[Any]:
        """Pack an observation into one array; UserError for a number that is not finite."""
        entries = bridge.arrays_of(self.task, observation)
        for name, array in entries.items():
            largest = np.abs(array).max() if array.dtype.kind in "fi" else 0.0
            if not np.isfinite(largest):
                raise UserError(f"{self.scenario} observes a number in {name} that is not finite")
            if largest > BEARABLE:
                advice = "scale them, or no network learns from them"
                bridge.say_once(f"{self.scenario}: {name} exceeds {BEARABLE:g}; {advice}")
        return as_array(self.layout, entries)


class _ScaledExpert(Expert):
    """An expert whose actions are in the environment's own range."""

    def __init__(self, env: Any, own: Any) -> None:
        self._env, self._own = env, own

    def reset(self) -> None:
        getattr(self._own, "reset", lambda: None)()

    def act(self, observation: Any = None) -> Action:
        return inner(self._env.action_range, self._own.act())

    def wants_control(self, action: Action) -> Reason | None:
        return self._own.wants_control(outer(self._env.action_range, action))

    def may_return(self) -> bool:
        return bool(getattr(self._own, "may_return", lambda: True)())


def _completed(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the info with a distance and a speed, 0 and NaN where they are unknown."""
    unknown = {"distance_m": 0.0, "speed_mps": float("nan")}
    return unknown | {key: value for key, value in info.items() if value is not None}


class DelayedVehicle:
    """Puts a simulated network between policy and vehicle; the vehicle brakes by itself.

    In each control period call the function that ``behind`` returned, and ``step`` with its action,
    or with a human's after ``release_brake``. An episode's seed also seeds the network's delays and
    losses, as in ``bridge simulate``.

    A learner pairs what happens at the vehicle with what the policy knew: for tick n it stores the
    observation of tick n - d, the action and the reward of tick n, and the observation of tick
    n + 1 - d, where d (`ticks_late`) is the age in ticks of a command that arrives on time.
    """

    def __init__(self, env: Any, spec: LatencySpec) -> None:
        self.env, self.spec = env, spec
        self.control_period_s: float = env.control_period_s
        self._braking = False

    def reset(self, *, seed: int) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed)
        self.link: VirtualLink[Observation] = VirtualLink(
            self.spec, seed, self.control_period_s, observation.nbytes
        )
        self._tick = 0
        return observation, info

    def step(self, action: Action) -> Any:
        """Drive for one control period."""
        return self.env.step(action)

    def behind(self, policy: Callable[[Observation], Action]) -> Callable[[Observation], Action]:
        """Return a function from observation to the vehicle's action; call it once a period.

        The policy answers each fresh observation that reaches the edge within the tick. The vehicle
        obeys the newest command; it brakes after 2 T without a command, and for a safe stop.
        """

        def carried_out(observation: Observation) -> Action:
            self.link.send_state(self._tick, observation)
            self._tick += 1
            while arrival := self.link.next_at_edge():
                if not arrival.overtaken:
                    answer = policy(arrival.message)
                    self.link.answer(arrival, _command(arrival.step, answer))
            decision = self.link.decide()
            self._press_brake(bool(decision.brake_reason))
            if self._braking:
                return self.env.brake_action
            command = decision.command
            return self.env.rest_action if command is None else np.array(command.action, np.float32)

        return carried_out

    def release_brake(self) -> None:
        """Let a human drive until the next tick."""
        self._press_brake(False)

    def _press_brake(self, pressed: bool) -> None:
        """Press or release a brake that is no part of the action, as in the congestion."""
        self._braking = pressed
        getattr(self.env, "press_brake", lambda pressed: None)(pressed)


def _command(step: int, action: Action) -> Command:
    """Make a command with the fields that a virtual link reads."""
    return Command(
        session="", episode=0, step=step, mode=DRIVE, action=action.tolist(), policy_id="",
        received_ns=0, inference_ns=0, sent_ns=0,
    )  # fmt: skip


def ticks_late(spec: LatencySpec, period_s: float) -> int:
    """Return the age in ticks of the state that a punctual command answers."""
    round_trip_s = (spec.up.delay_ms + spec.down.delay_ms) * 1e-3
    beyond_window_s = max(0.0, round_trip_s - COMMAND_WINDOW * period_s - ROUNDING_S)
    return math.ceil(beyond_window_s / period_s)
