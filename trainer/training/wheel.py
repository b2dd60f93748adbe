"""Between policy and vehicle in training: directly, or over the network it will be deployed on.

Over a network, what is stored is what happens at the vehicle, from the policy's point of view: in
each tick, the observation that the obeyed command answers, the action carried out, the reward of
that tick, and the observation that the next tick's command answers. So a reward stands beside the
action that earned it, however long the command was under way, and a human's action beside the
picture to which the policy would have had to give it. What happened meanwhile is not in the
picture: the delayed decision process is only partially observed, and the contract fixes the
observation, so past commands are not added to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from edge_runtime.latency.model import LatencySpec
from trainer.remote.vehicle_end import Action, Held, Observation, Policy, VehicleEnd
from trainer.training.learning import Learning


class Wheel(Protocol):
    """What the training loop asks for: actions as the vehicle has them, and storing."""

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode."""

    def act(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle is told in the tick of this observation."""
        ...

    def store(
        self, action: Action, reward: float, observation: Observation, ends: Ends, human: bool
    ) -> None:
        """Keep the tick that led to ``observation``; ``action`` is what was carried out."""


@dataclass(frozen=True)
class Ends:
    """How a tick ends the episode, if it does."""

    terminated: bool
    truncated: bool


class DirectWheel:
    """No network: the policy acts on what is there."""

    def __init__(self, learning: Learning) -> None:
        self._learning = learning

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode."""
        self._learning.start_episode(observation)

    def act(self, observation: Observation, policy: Policy) -> Action:
        """The policy's action."""
        return policy(observation)

    def store(
        self, action: Action, reward: float, observation: Observation, ends: Ends, human: bool
    ) -> None:
        """Every tick is a transition."""
        self._learning.add(action, reward, observation, ends.terminated, human)


@dataclass(frozen=True)
class _Tick:
    """A tick that waits for the observation which the next command answers."""

    step: int
    action: Action
    reward: float
    human: bool


class RemoteWheel:
    """The policy behind a network.

    The replay buffer keeps pictures in a chain, so a tick becomes a transition where the next
    command answers the next state, as nearly all do at a constant delay. Where a command was held
    or skipped (jitter, loss), and while the car brakes by itself, the chain is begun anew; the end
    of an episode by goal or failure is always kept.
    """

    def __init__(self, learning: Learning, env: Any, spec: LatencySpec) -> None:
        self._learning, self._env, self._spec = learning, env, spec

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode; the seed decides the network's luck."""
        self._vehicle_end = VehicleEnd(self._env, self._spec, seed)
        self._held: Held | None = None
        self._waiting: _Tick | None = None
        self._chain_step: int | None = None

    def act(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle does: the newest command, or the brake."""
        held = self._held = self._vehicle_end.tick(observation, policy)
        self._settle(held)
        return held.action

    def store(
        self, action: Action, reward: float, observation: Observation, ends: Ends, human: bool
    ) -> None:
        """Keep the tick until it is known what the next one answers."""
        held = self._held
        assert held is not None
        if held.observation is None:
            return
        if ends.terminated:
            self._learning.add(action, reward, observation, True, human)
        elif human or not held.braking:
            self._waiting = _Tick(held.step, action, reward, human)

    def _settle(self, held: Held) -> None:
        """Store the tick before this one if this one goes on where it was; be ready for this."""
        waiting, self._waiting = self._waiting, None
        if held.observation is None:
            return
        if waiting is not None and held.step == waiting.step + 1:
            self._learning.add(
                waiting.action, waiting.reward, held.observation, False, waiting.human
            )
        elif held.step != self._chain_step:
            self._learning.start_episode(held.observation)
        self._chain_step = held.step


def make_wheel(learning: Learning, env: Any, spec: LatencySpec) -> Wheel:
    """The wheel for a network; ``none`` is no network."""
    return DirectWheel(learning) if spec == LatencySpec() else RemoteWheel(learning, env, spec)
