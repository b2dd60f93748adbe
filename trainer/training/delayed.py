"""Between policy and vehicle in training: directly, or over the network it will be deployed on.

Over a network, what is stored is what happens at the vehicle, beside what the policy knows of it:
in tick n the observation of tick n - d, the action carried out in tick n, its reward, and the
observation of tick n + 1 - d, where d is how many ticks old a command is that is on time. So a
reward stands beside the action that earned it, and a human's action beside the picture to which
the policy would have had to give it. Where the network makes a command late, lost or repeated, the
action carried out is another than the policy's answer; for a learner off policy that is a sample
like any other, and so is the brake.

What was carried out in the d ticks between is not in the picture: the delayed decision process is
only partially observed, and the contract fixes the observation, so past commands are not added.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bridge.network import LatencySpec
from bridge.virtual_link import COMMAND_WINDOW_S, ROUNDING_S, VirtualLink
from edge_runtime.wire import CONTROL_PERIOD_S, DRIVE, Command
from trainer.human.guide import Driver

Observation = NDArray[np.uint8]
Action = NDArray[np.float32]
Policy = Callable[[Observation], Action]


@dataclass(frozen=True)
class Held:
    """What the vehicle does in one tick."""

    action: Action
    step: int
    """The tick whose state the obeyed command answers; -1 before the first command."""
    braking: bool
    """The vehicle brakes: no command has come for 2 T, or the command is a safe stop."""


class VehicleEnd:
    """One episode of a policy behind a network.

    Args:
        env: the scenario; its brake is pressed here when commands stop.
        spec: the network.
        seed: of the network: the episode's, as in ``bridge simulate``.
    """

    def __init__(self, env: Any, spec: LatencySpec, seed: int) -> None:
        self.env = env
        self._link: VirtualLink[Observation] = VirtualLink(spec, seed)
        self._step = 0

    def tick(self, observation: Observation, policy: Policy) -> Held:
        """Send the tick's observation, let the policy answer all that arrive, and decide.

        The policy is asked for each fresh observation that reaches the edge within the tick: often
        one, but none or several where the network drops, delays or bundles them.
        """
        self._link.send_state(self._step, observation)
        self._step += 1
        while arrival := self._link.next_at_edge():
            if not arrival.overtaken:
                self._link.answer(arrival, _command(arrival.step, policy(arrival.message)))
        return self._decide()

    def release_brake(self) -> None:
        """Until the next tick: whoever is in the car has taken over."""
        self._press_brake(False)

    def _decide(self) -> Held:
        decision = self._link.decide()
        braking = bool(decision.brake_reason)
        self._press_brake(braking)
        if braking:
            action = self.env.brake_action
        elif decision.command is None:
            action = np.zeros(self.env.action_space.shape, np.float32)
        else:
            action = np.array(decision.command.action, np.float32)
        return Held(action, self._link.hold.newest_step, braking)

    def _press_brake(self, pressed: bool) -> None:
        """A scenario whose action only steers has a brake beside it."""
        press = getattr(self.env, "press_brake", None)
        if press is not None:
            press(pressed)


class RemoteDriver:
    """A driver behind a network, for one episode that begins now."""

    def __init__(self, driver: Driver, env: Any, spec: LatencySpec, seed: int) -> None:
        self.driver = driver
        self.vehicle_end = VehicleEnd(env, spec, seed)

    def reset(self) -> None:
        """Forget the last episode."""
        self.driver.reset()

    def act(self, observation: Observation) -> Action:
        """What the vehicle does, float32 [action size]; once a control period."""
        return self.vehicle_end.tick(observation, self.driver.act).action


def _command(step: int, action: Action) -> Command:
    return Command(
        session="",
        episode=0,
        step=step,
        mode=DRIVE,
        action=[float(value) for value in action],
        policy_id="",
        received_ns=0,
        inference_ns=0,
        sent_ns=0,
    )


class Store(Protocol):
    """The part of a learner that a wheel needs."""

    def start_episode(self, observation: Observation) -> None:
        """Take an episode's first observation."""

    def add(
        self,
        action: Action,
        reward: float,
        observation: Observation,
        terminal: bool,
        human: bool,
        overruled: Action | None = None,
        penalised: bool = False,
    ) -> None:
        """Store a transition that led to ``observation``; arguments as ``ReplayBuffer.add``."""


class Wheel(Protocol):
    """What the training loop asks for: actions as the vehicle has them, and storing."""

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode."""

    def act(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle is told in the tick of this observation."""
        ...

    def yield_to_human(self) -> None:
        """A human has taken over in this tick: only what they do moves the vehicle."""

    def store(
        self,
        action: Action,
        reward: float,
        observation: Observation,
        terminated: bool,
        human: bool,
        overruled: Action | None = None,
        penalised: bool = False,
    ) -> None:
        """Keep the tick that led to ``observation``; arguments as ``ReplayBuffer.add``."""


class DirectWheel:
    """No network: the policy acts on what is there."""

    def __init__(self, learning: Store) -> None:
        self._learning = learning

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode."""
        self._learning.start_episode(observation)

    def act(self, observation: Observation, policy: Policy) -> Action:
        """The policy's action."""
        return policy(observation)

    def yield_to_human(self) -> None:
        """The policy's action is not carried out; nothing else holds the vehicle."""

    def store(
        self, action: Action, reward: float, observation: Observation, *rest: Any, **guidance: Any
    ) -> None:
        """Every tick is a transition."""
        self._learning.add(action, reward, observation, *rest, **guidance)


class RemoteWheel:
    """The policy behind a network, in virtual time."""

    def __init__(self, learning: Store, env: Any, spec: LatencySpec) -> None:
        self._learning, self._env, self._spec = learning, env, spec
        self._known: deque[Observation] = deque(maxlen=ticks_late(spec) + 1)
        """Observations of the ticks n - d to n."""
        self._storing = False

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode; the seed decides the network's luck."""
        self._vehicle_end = VehicleEnd(self._env, self._spec, seed)
        self._known.clear()
        self._storing = False

    def act(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle does: the newest command, or the brake."""
        self._known.append(observation)
        if not self._storing and len(self._known) == self._known.maxlen:
            self._learning.start_episode(self._known[0])
            self._storing = True
        return self._vehicle_end.tick(observation, policy).action

    def yield_to_human(self) -> None:
        """The vehicle lets go of the brake that it may have pressed for want of commands."""
        self._vehicle_end.release_brake()

    def store(
        self, action: Action, reward: float, observation: Observation, *rest: Any, **guidance: Any
    ) -> None:
        """Keep the tick; the first d of an episode answer to nothing the policy could know."""
        if self._storing:
            following = [*self._known, observation][1]
            self._learning.add(action, reward, following, *rest, **guidance)


def ticks_late(spec: LatencySpec) -> int:
    """How many ticks old the state is that a command answers when it is on time."""
    round_trip_s = (spec.up.delay_ms + spec.down.delay_ms) * 1e-3
    beyond_window_s = max(0.0, round_trip_s - COMMAND_WINDOW_S - ROUNDING_S)
    return math.ceil(beyond_window_s / CONTROL_PERIOD_S)


def make_wheel(learning: Store, env: Any, spec: LatencySpec) -> Wheel:
    """The wheel for a network; ``none`` is no network."""
    return DirectWheel(learning) if spec == LatencySpec() else RemoteWheel(learning, env, spec)
