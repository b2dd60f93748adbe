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
from typing import Any, Protocol

import numpy as np

from bridge.network import LatencySpec
from bridge.virtual_link import COMMAND_WINDOW_S, ROUNDING_S, VirtualLink
from edge_runtime.wire import CONTROL_PERIOD_S, DRIVE, Command
from trainer.human.guide import Action, Observation

Policy = Callable[[Observation], Action]


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
        self.braking = False
        """The vehicle brakes: no command has come for 2 T, or the command is a safe stop."""

    @property
    def answered_step(self) -> int:
        """The tick whose state the obeyed command answers; -1 before the first command."""
        return self._link.hold.newest_step

    def tick(self, observation: Observation, policy: Policy) -> Action:
        """Send the tick's observation, let the policy answer all that arrive, and decide.

        The policy is asked for each fresh observation that reaches the edge within the tick: often
        one, but none or several where the network drops, delays or bundles them.

        Returns:
            What the vehicle does, float32 [action size].
        """
        self._link.send_state(self._step, observation)
        self._step += 1
        while arrival := self._link.next_at_edge():
            if not arrival.overtaken:
                self._link.answer(arrival, _command(arrival.step, policy(arrival.message)))
        decision = self._link.decide()
        self.press_brake(bool(decision.brake_reason))
        if self.braking:
            action: Action = self.env.brake_action
        elif decision.command is None:
            action = np.zeros(self.env.action_space.shape, np.float32)
        else:
            action = np.array(decision.command.action, np.float32)
        return action

    def press_brake(self, pressed: bool) -> None:
        """Brake or not until the next tick: a scenario whose action only steers has a pedal."""
        self.braking = pressed
        press = getattr(self.env, "press_brake", None)
        if press is not None:
            press(pressed)


def _command(step: int, action: Action) -> Command:
    """As an edge runtime's, as far as a virtual link looks at it."""
    return Command(
        session="", episode=0, step=step, mode=DRIVE, action=action.tolist(), policy_id="",
        received_ns=0, inference_ns=0, sent_ns=0,
    )  # fmt: skip


class Store(Protocol):
    """What takes transitions: a learner, or a buffer before it."""

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


class DirectPolicy:
    """A policy as the training loop has it, without a network: it acts on what is there.

    Each tick goes to ``store`` as a transition.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode; a network's luck depends on the seed."""
        self._store.start_episode(observation)

    def act(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle is told in the tick of this observation."""
        return policy(observation)

    def yield_to_human(self) -> None:
        """A human has taken over in this tick: only what they do moves the vehicle."""

    def store(
        self, action: Action, reward: float, observation: Observation, *rest: Any, **guidance: Any
    ) -> None:
        """Keep the tick that led to ``observation``; arguments as ``Store.add``."""
        self._store.add(action, reward, observation, *rest, **guidance)


class DelayedPolicy(DirectPolicy):
    """The policy behind a network, in virtual time."""

    def __init__(self, store: Store, env: Any, spec: LatencySpec) -> None:
        super().__init__(store)
        self._env, self._spec = env, spec
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
            self._store.start_episode(self._known[0])
            self._storing = True
        return self._vehicle_end.tick(observation, policy)

    def yield_to_human(self) -> None:
        """The vehicle lets go of the brake that it may have pressed for want of commands."""
        self._vehicle_end.press_brake(False)

    def store(
        self, action: Action, reward: float, observation: Observation, *rest: Any, **guidance: Any
    ) -> None:
        """Keep the tick; the first d of an episode answer to nothing the policy could know."""
        if self._storing:
            super().store(action, reward, [*self._known, observation][1], *rest, **guidance)


def ticks_late(spec: LatencySpec) -> int:
    """How many ticks old the state is that a command answers when it is on time."""
    round_trip_s = (spec.up.delay_ms + spec.down.delay_ms) * 1e-3
    beyond_window_s = max(0.0, round_trip_s - COMMAND_WINDOW_S - ROUNDING_S)
    return math.ceil(beyond_window_s / CONTROL_PERIOD_S)


def behind(spec: LatencySpec, store: Store, env: Any) -> DirectPolicy:
    """The policy behind a network; ``none`` is no network."""
    return DirectPolicy(store) if spec == LatencySpec() else DelayedPolicy(store, env, spec)
