"""A vehicle at the other end of a network, in virtual time, in the form of a gymnasium wrapper.

What a learner stores is what happens at the vehicle, beside what the policy knows of it: in tick n
the observation of tick n - d, the action carried out in tick n, its reward, and the observation of
tick n + 1 - d, where d (`ticks_late`) is how many ticks old a command is that is on time. So a
reward stands beside the action that earned it, and a human's action beside the picture to which the
policy would have had to give it. Where the network makes a command late, lost or repeated, the
action carried out is another than the policy's answer; for a learner off policy that is a sample
like any other, and so is the brake.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from bridge.inbound import ROUNDING_S
from bridge.network import COMMAND_WINDOW, LatencySpec, VirtualLink
from edge_runtime.wire import DRIVE, Command
from trainer.learner.replay import Action, Observation

Policy = Callable[[Observation], Action]


class DelayedVehicle:
    """Wraps an environment whose policy acts over a network; the vehicle brakes by itself.

    Each control period ask a policy that is ``behind`` the network for the vehicle's action, and
    step with it, or with a human's after ``release_brake``. The seed of an episode decides the
    network's luck, too, as in ``bridge simulate``.
    """

    def __init__(self, env: Any, spec: LatencySpec) -> None:
        self.env, self.spec = env, spec
        self.control_period_s: float = env.control_period_s
        self._braking = False

    def reset(self, *, seed: int) -> tuple[Observation, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed)
        self.link: VirtualLink[Observation] = VirtualLink(
            self.spec, seed, self.control_period_s, observation.nbytes
        )
        self._tick = 0
        return observation, info

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        result: tuple[Observation, float, bool, bool, dict[str, Any]] = self.env.step(action)
        return result

    def behind(self, policy: Policy) -> Policy:
        """Return what the vehicle does with a policy on the other end: once a control period.

        The policy is asked for each fresh observation that reaches the edge within the tick: often
        one, but none or several where the network drops, delays or bundles them. The vehicle obeys
        the newest command. It brakes where none has come for 2 T, or the command is a safe stop.
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
