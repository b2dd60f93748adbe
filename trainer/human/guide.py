"""The human beside the policy: watches each action, takes over, and hands control back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from trainer.scenarios.environment import Action, Observation

Reason = Literal["collision", "lane", "stuck", "heading", "offset", "person"]
"""Why the human takes over: hardly a way out of a crash, a car that stops in the traffic's lane,
one that waits for nothing, one that turns aside or is aside; a person has reasons of their own."""


class Driver(Protocol):
    """Anything that drives: expert, human model, policy."""

    def reset(self) -> None:
        """Forget the last episode; most have nothing to forget."""
        return

    def act(self, observation: Observation) -> Action:
        """The action for an observation uint8 [2, 45, 80]."""
        ...


class Trigger(Protocol):
    """The activation conditions of section V: when a person would take over."""

    def reset(self) -> None:
        """Forget the last episode, where there is something to forget."""
        return

    def judge(self, action: Action) -> Reason | None:
        """Why a person would take over from ``action`` now, or None. Once a control period."""
        ...

    def may_return(self) -> bool:
        """Whether a person would give the wheel back here: by default anywhere."""
        return True


@dataclass(frozen=True)
class Intervention:
    """A step at which the human acts."""

    action: Action
    reason: Reason
    first: bool
    """Whether the human took over at this step (eq. 17's intervention time)."""


class Guide(Protocol):
    """What watches the policy: a person, or the expert or model that stands for one."""

    def reset(self) -> None:
        """Start an episode with the policy in control."""

    def watch(self, observation: Observation, policy_action: Action) -> Intervention | None:
        """What the human does about ``policy_action``: None lets it pass. Once a step."""
        ...


class HumanGuide:
    """Turns trigger and driver into interventions.

    The human stays in control for ``hold_steps`` from the last reason for it. A second and a half:
    a person first brings the car out of what made them take over.
    """

    def __init__(self, driver: Driver, trigger: Trigger, hold_steps: int = 15) -> None:
        self.driver, self.trigger, self.hold_steps = driver, trigger, hold_steps
        self.reset()

    def reset(self) -> None:
        """Start an episode with the policy in control."""
        self.driver.reset()
        self.trigger.reset()
        self._steps_left = 0
        self._reason: Reason | None = None

    def watch(self, observation: Observation, policy_action: Action) -> Intervention | None:
        """What the human does about ``policy_action``: None lets it pass. Once a step."""
        trigger = self.trigger.judge(policy_action)
        before = self._reason
        if trigger is not None:
            self._steps_left = self.hold_steps
        if self._steps_left == 0 and (before is None or self.trigger.may_return()):
            self._reason = None
            return None
        self._steps_left = max(self._steps_left - 1, 0)
        if before is None:
            # A person who takes over looks at the scene afresh.
            self.driver.reset()
            self._reason = trigger
        assert self._reason is not None
        return Intervention(self.driver.act(observation), self._reason, first=before is None)
