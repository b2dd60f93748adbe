"""Between policy and vehicle in training: directly, or over the network it will be deployed on.

Over a network, what is stored is what happens at the vehicle, beside what the policy knows of it:
in tick n the observation of tick n - d, the action carried out in tick n, its reward, and the
observation of tick n + 1 - d, where d is how many ticks old a command is that is on time. So a
reward stands beside the action that earned it, and a human's action beside the picture to which
the policy would have had to give it. Where the network makes a command late, lost or repeated, the
action carried out is another than the policy's answer; for a learner off policy that is a sample
like any other, and so is the brake.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from bridge.network import LatencySpec
from bridge.virtual_link import COMMAND_WINDOW, ROUNDING_S, VirtualLink
from edge_runtime.wire import DRIVE, Command
from trainer.human.guide import Action, Observation
from trainer.training.learning import LearningThread

Policy = Callable[[Observation], Action]


class VehicleEnd:
    """One episode of a policy behind a network.

    The brake of ``env`` is pressed here when commands stop. ``seed`` is the episode's, as in
    ``bridge simulate``, ``observation`` any one, for its size.
    """

    def __init__(self, env: Any, spec: LatencySpec, seed: int, observation: Observation) -> None:
        self.env = env
        self._rest: Action = env.rest_action
        self._link: VirtualLink[Observation] = VirtualLink(
            spec, seed, env.control_period_s, observation.nbytes
        )
        self._step = 0
        self.braking = False
        """The vehicle brakes: no command has come for 2 T, or the command is a safe stop."""

    def tick(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle does, float32 [action size], once the policy has answered what arrives.

        The policy is asked for each fresh observation that reaches the edge within the tick: often
        one, but none or several where the network drops, delays or bundles them.
        """
        self._link.send_state(self._step, observation)
        self._step += 1
        while arrival := self._link.next_at_edge():
            if not arrival.overtaken:
                answer = policy(arrival.message)
                self._link.answer(arrival, _command(arrival.step, answer))
        decision = self._link.decide()
        self.press_brake(bool(decision.brake_reason))
        if self.braking:
            return self.env.brake_action
        command = decision.command
        return self._rest if command is None else np.array(command.action, np.float32)

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


class DelayedPolicy:
    """The policy as the training loop has it: behind a network, in virtual time, or ``none``.

    Each tick goes to ``store`` as a transition.
    """

    def __init__(self, store: LearningThread, env: Any, spec: LatencySpec) -> None:
        self._store, self._env, self._spec = store, env, spec
        late = ticks_late(spec, env.control_period_s)
        self._known: deque[Observation] = deque(maxlen=late + 1)
        """Observations of the ticks n - d to n."""
        self._storing = False

    def start(self, observation: Observation, seed: int) -> None:
        """Begin an episode; the seed decides the network's luck."""
        self._vehicle_end = None
        if self._spec != LatencySpec():
            self._vehicle_end = VehicleEnd(self._env, self._spec, seed, observation)
        self._known.clear()
        self._storing = False

    def act(self, observation: Observation, policy: Policy) -> Action:
        """What the vehicle does: the newest command, or the brake."""
        self._known.append(observation)
        if not self._storing and len(self._known) == self._known.maxlen:
            self._store.start_episode(self._known[0])
            self._storing = True
        end = self._vehicle_end
        return end.tick(observation, policy) if end else policy(observation)

    def yield_to_human(self) -> None:
        """The vehicle lets go of the brake that it may have pressed for want of commands."""
        if self._vehicle_end:
            self._vehicle_end.press_brake(False)

    def store(
        self, action: Action, reward: float, observation: Observation, *rest: Any, **guidance: Any
    ) -> None:
        """Keep the tick that led to ``observation``; arguments as ``ReplayBuffer.add``.

        An episode's first d are not kept: the policy had seen nothing.
        """
        if ahead := guidance.get("foreseen"):
            # As late as all that the policy sees.
            guidance["foreseen"] = [*self._known, *ahead[1:]][: len(ahead)]
        if self._storing:
            known = [*self._known, observation][1]
            self._store.add(action, reward, known, *rest, **guidance)


def ticks_late(spec: LatencySpec, period_s: float) -> int:
    """How many ticks old the state is that a command answers when it is on time."""
    round_trip_s = (spec.up.delay_ms + spec.down.delay_ms) * 1e-3
    beyond_window_s = max(0.0, round_trip_s - COMMAND_WINDOW * period_s - ROUNDING_S)
    return math.ceil(beyond_window_s / period_s)
