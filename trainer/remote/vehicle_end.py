"""The policy as the vehicle has it: tick by tick, over a network in virtual time.

The same network as lock-step's (`bridge/virtual_link.py`), with a function in the
edge runtime's place. What is trained here is therefore what drives there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge.network import LatencySpec
from bridge.virtual_link import VirtualLink
from edge_runtime.wire import DRIVE, Command
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
