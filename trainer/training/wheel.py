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
from typing import Any, Protocol

from bridge.network import LatencySpec
from bridge.virtual_link import COMMAND_WINDOW_S, ROUNDING_S
from edge_runtime.wire import CONTROL_PERIOD_S
from trainer.remote.vehicle_end import Action, Observation, Policy, VehicleEnd


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
