"""Environments by name: the two scenarios, and any other environment adapted to look like them.

An observation is one array (a structured one for several entries), an action is float32 [n] in
[-1, 1]; `outer` and `inner` alone scale it. A step's ``info`` holds position, speed and, in the
last step, the outcome.
"""

import copy
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from numpy.typing import NDArray

from bridge import environments as bridge
from bridge.inbound import ROUNDING_S
from bridge.network import COMMAND_WINDOW, LatencySpec, VirtualLink
from bridge.outcomes import outcome_of
from edge_runtime.manifest import Task
from edge_runtime.util import UserError, load_named
from edge_runtime.wire import DRIVE, Command
from trainer.human.guide import Action, Expert, Reason
from trainer.learner.replay import Observation, ReplayLayout
from trainer.scenarios import SCENARIOS, Scene
from trainer.util import PERIOD_S

COMMAND_NOISE = 0.05 * 2.0
"""Standard deviation of the noise condition: 5 % of the whole control domain (section VII-D)."""
MOST_STEPS = 1000  # Of an episode whose environment has no limit of its own
BEARABLE = 1e4  # Largest number in an observation; the layers of a network take some units


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
    """Make the environment of a scenario's word, a gymnasium id or ``module:id``; UserError.

    The two scenarios come as they are, in the scene of a test condition; any other is `Adapted`.
    With ``printed_reward`` a scenario pays what eq. 31 or 32 says, without its own weight. A step
    lasts ``period_s``, else what the environment says, else 0.1 s, which a line says. ``success``
    is a ``module:function`` that judges the episodes of one that does not.
    """
    name, scene = scenario_of(name), CONDITIONS[condition].scene
    if name not in SCENARIOS:
        if printed_reward:
            raise UserError(f"printed_reward is the paper's, and {name} is none of its scenarios")
        judge = load_named(success, "function") if success else None
        return Adapted(bridge.make_environment(name, scene), name, period_s, judge)
    if success:
        raise UserError(f"{name} itself says whether an episode succeeded")
    scenario: Any = gymnasium.make(SCENARIOS[name], scene=scene).unwrapped
    if printed_reward:
        scenario.config = scenario.config.with_printed_reward()
    scenario.control_period_s = bridge.describe(scenario, period_s).control_period_s
    return scenario


def scenario_of(name: str) -> str:
    """Return the word of a scenario that is named by its id; any other name unchanged."""
    words = {environment_id: word for word, environment_id in SCENARIOS.items()}
    return words.get(name.rpartition(":")[2], name)


def check_trained_in(env: Any, policy: Path, scenario: str) -> None:
    """Raise UserError if a policy is of another environment; no file decides what is made."""
    if scenario != env.scenario:
        raise UserError(f"{policy} was trained in {scenario}, not in {env.scenario}")


def entries_of(observations: NDArray[Any], plain: str) -> dict[str, NDArray[Any]]:
    """Return observations as the entries that a policy file names; a single one is ``plain``."""
    names = observations.dtype.names
    return {name: observations[name] for name in names} if names else {plain: observations}


def own_environment(env: Any) -> Any:
    """Return the environment as its author made it: in its own units."""
    return env if env.scenario in SCENARIOS else env.env


def task_of(env: Any) -> Task:
    """Return what the environment asks of a policy file."""
    return bridge.describe(own_environment(env), env.control_period_s)


def foresee(env: Any, observation: Any, action: Action, steps: int) -> list[Any]:
    """Return the observation and those of ``steps`` steps with the action held.

    A copy of the environment takes the steps; fewer where the episode ends.
    """
    seen, ahead = [observation], copy.deepcopy(env)
    for _ in range(steps):
        observation, _, terminated, truncated, _ = ahead.step(action)
        seen.append(observation)
        if terminated or truncated:
            break
    return seen


def check_foresight(env: Any) -> None:
    """Raise UserError unless the environment can be deep-copied for look-ahead."""
    try:
        copy.deepcopy(env)
    except Exception as error:  # Of any class of an environment
        raise UserError(f"a copy of {env.scenario} cannot look ahead: {error!r}") from error


def expert_of(env: Any, human: str = "expert") -> Expert:
    """Return the environment's scripted expert, or another, ``module:Class``; UserError: none."""
    if ":" not in human:
        if env.expert is None:
            raise UserError(f"{env.scenario} offers no expert(); name one as module:Class")
        return env.expert()
    made = load_named(human, "expert")
    try:
        return _ScaledExpert(env, made(env.unwrapped))
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


class Adapted(bridge.Adapter):
    """Any environment in the form of the two scenarios.

    It was made by the ``name``; ``judge`` says at an episode's end whether it succeeded. Raises
    UserError for what `bridge.environments.describe` refuses.
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
            bridge.say_once(f"{name} has no limit of its own: {MOST_STEPS} steps are taken")
            self.env = gymnasium.wrappers.TimeLimit(env, MOST_STEPS)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin an episode."""
        self._last_action, self._return = self.rest_action, 0.0
        observation, info = self.env.reset(seed=seed, options=options)
        return self._seen(observation), _known(info)

    def step(self, action: Action) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Drive for one control period."""
        self._last_action = np.asarray(action, np.float32)
        own = outer(self.action_range, action).reshape(self._space.shape)
        seen, reward, terminated, truncated, info = self.env.step(own.astype(self._space.dtype))
        info, reward = _known(info), bridge.finite("reward", reward)
        self._return += reward
        if terminated or truncated:
            if self.judge:
                info["is_success"] = self.judge(seen, info, self._return)
            info["outcome"] = outcome_of(info, only_truncated=not terminated)
        return self._seen(seen), reward, bool(terminated), bool(truncated), info

    def close(self) -> None:
        """Close the environment: of some simulators only one may live in a process."""
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

    def _seen(self, observation: Any) -> NDArray[Any]:
        """Return one array; UserError for numbers that no network could learn from."""
        seen = np.zeros(self.layout.shape, self.layout.dtype)
        for name, array in self.arrays(observation).items():
            (seen[name] if seen.dtype.names else seen)[...] = array
            largest = np.abs(array).max() if array.dtype.kind in "fi" else 0.0
            if not np.isfinite(largest):
                raise UserError(f"{self.scenario} observes a number in {name} that is not finite")
            if largest > BEARABLE:
                what = f"numbers beyond {BEARABLE:g}, of which no network learns: scale them"
                bridge.say_once(f"{self.scenario} observes in {name} {what}")
        return seen


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


def _known(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the info with distance and speed, which are 0 and NaN where they are unknown."""
    unknown = {"distance_m": 0.0, "speed_mps": float("nan")}
    return unknown | {key: value for key, value in info.items() if value is not None}


class DelayedVehicle:
    """Wraps an environment whose policy acts over a network; the vehicle brakes by itself.

    Each control period ask a policy that is ``behind`` the network for the vehicle's action, and
    step with it, or with a human's after ``release_brake``. The seed of an episode decides the
    network's luck, too, as in ``bridge simulate``.

    A learner stores what happens at the vehicle beside what the policy knows of it: in tick n the
    observation of tick n - d, the action carried out in tick n, its reward, and the observation of
    tick n + 1 - d, where d (`ticks_late`) is how many ticks old a command is that is on time.
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
        """Return what the vehicle does with a policy on the other end: once a control period.

        The policy is asked for each fresh observation that reaches the edge within the tick. The
        vehicle obeys the newest command; it brakes where none has come for 2 T, or the command is a
        safe stop.
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
        """Brake or not until the next tick: a scenario whose action only steers has a pedal."""
        self._braking = pressed
        getattr(self.env, "press_brake", lambda pressed: None)(pressed)


def _command(step: int, action: Action) -> Command:
    """Make a command as far as a virtual link looks at it."""
    return Command(
        session="", episode=0, step=step, mode=DRIVE, action=action.tolist(), policy_id="",
        received_ns=0, inference_ns=0, sent_ns=0,
    )  # fmt: skip


def ticks_late(spec: LatencySpec, period_s: float) -> int:
    """Return how many ticks old the state is that a command answers when it is on time."""
    round_trip_s = (spec.up.delay_ms + spec.down.delay_ms) * 1e-3
    beyond_window_s = max(0.0, round_trip_s - COMMAND_WINDOW * period_s - ROUNDING_S)
    return math.ceil(beyond_window_s / period_s)
