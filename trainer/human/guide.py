"""The human beside the policy: watches each action, takes over, and hands control back."""

from collections import deque
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Action = NDArray[np.float32]
Observation = NDArray[Any]
"""The two frames, or another environment's: of several entries a structured array."""
Reason = str  # Why the human takes over
STUCK, ASKED = "stuck", "asked"
REASONS: tuple[Reason, ...] = ("collision", "lane", STUCK, "heading", "offset", "person", ASKED)
"""In this order: a crash can hardly be avoided; the car stops in the traffic's lane; it waits for
nothing; it turns aside; it is aside; a person took over; the robot asked for help. Another
environment's expert may have others."""


class Driver(Protocol):
    """Anything that drives: expert, human model, policy."""

    def reset(self) -> None:
        """Forget the last episode; most have nothing to forget."""
        return

    def act(self, observation: Observation) -> Action:
        """The action, float32 [n], for an observation."""
        ...


class Trigger(Protocol):
    """The activation conditions of section V: when a person would take over."""

    def reset(self) -> None:
        """Forget the last episode, where there is something to forget."""
        return

    def wants_control(self, action: Action) -> Reason | None:
        """Why a person would take over from ``action`` now, or None. Once a control period."""
        ...

    def may_return(self) -> bool:
        """Whether a person would give the wheel back here: by default anywhere."""
        return True


class Expert(Trigger, Protocol):
    """The scripted human of an environment: drives from the true state, and says when."""

    def act(self, observation: Any = None) -> Action:
        """The expert's action, float32 [n]."""
        ...


@dataclass(frozen=True)
class Intervention:
    """A step at which the human acts."""

    action: Action
    reason: Reason
    first: bool  # Whether the human took over at this step (eq. 17's intervention time)


class Guide(Protocol):
    """What watches the policy: a person, or the expert or model that stands for one."""

    def reset(self) -> None:
        """Start an episode with the policy in control."""

    def watch(self, observation: Observation, policy_action: Action) -> Intervention | None:
        """What the human does about ``policy_action``: None lets it pass. Once a step."""
        ...


class Asking(Trigger):
    """The robot asks for help where its critics differ most, and the human need not watch.

    That is where their doubt is among the ``share`` of the highest of late: a budget of help, as
    in ThriftyDAgger (2109.08273). Until it knows what is high the human watches.
    """

    MEMORY = 500  # Control periods

    def __init__(self, human: Trigger, share: float) -> None:
        self.human, self.share = human, share
        self.doubts: deque[float] = deque(maxlen=self.MEMORY)

    def may_return(self) -> bool:
        """Whether the human would give control back here."""
        return self.human.may_return()

    def reset(self) -> None:
        """Forget the last episode, but no doubt."""
        self.human.reset()

    def wants_control(self, action: Action) -> Reason | None:
        """Whether the last of ``doubts``, which is that about ``action``, is a high one."""
        watched = self.human.wants_control(action)
        if len(self.doubts) < self.MEMORY:
            return watched
        return ASKED if self.doubts[-1] > np.quantile(self.doubts, 1.0 - self.share) else None


class Attention:
    """The attention of a human who comes late, or overlooks a reason and then is blind for a while.

    ``late_steps`` are the least and the longest delay, in control periods, of which each is drawn
    anew; ``missed_share`` is how often it notices nothing. A late human takes over from what the
    policy does by then, and that is what has the penalty.
    """

    BLIND_STEPS = 15

    def __init__(
        self, late_steps: tuple[float, float], missed_share: float, random: np.random.Generator
    ) -> None:
        self.random, self.late_steps, self.missed_share = random, late_steps, missed_share
        self._reason: Reason | None = None
        self._steps_left = 0

    def reset(self) -> None:
        """Forget the last episode."""
        self._steps_left = 0

    def notices(self, reason: Reason | None) -> Reason | None:
        """The reason, once the delay has passed; a take-over that has begun is not given up."""
        if self._steps_left == 0:
            if reason is None:
                return None
            missed = self.random.random() < self.missed_share
            self._reason = None if missed else reason
            late = self.BLIND_STEPS if missed else round(self.random.uniform(*self.late_steps))
            self._steps_left = late + 1
        self._steps_left -= 1
        return self._reason if self._steps_left == 0 else None


HOLD_S = 1.5


def steps_held(period_s: float) -> int:
    """For how many control periods a human holds the wheel."""
    return round(HOLD_S / period_s)


class HumanGuide:
    """Turns trigger and driver into interventions.

    The human stays in control for ``hold_steps`` from the last reason for it. A second and a half:
    a person first brings the car out of what made them take over. Where the robot asks, it is a
    third of that: nothing is wrong yet. At the wheel every human is attentive.
    """

    def __init__(
        self,
        driver: Driver,
        trigger: Trigger,
        hold_steps: int,
        attention: Attention | None = None,
    ) -> None:
        self.driver, self.trigger, self.hold_steps = driver, trigger, hold_steps
        self.attention = attention
        self.reset()

    def reset(self) -> None:
        """Start an episode with the policy in control."""
        self.driver.reset()
        self.trigger.reset()
        if self.attention:
            self.attention.reset()
        self._steps_left = 0
        self._reason: Reason | None = None

    def watch(self, observation: Observation, policy_action: Action) -> Intervention | None:
        """What the human does about ``policy_action``: None lets it pass. Once a step."""
        trigger = self.trigger.wants_control(policy_action)
        before = self._reason
        if before is None and self.attention:
            trigger = self.attention.notices(trigger)
        if trigger is not None:
            hold_steps = max(self.hold_steps // 3, 1) if trigger == ASKED else self.hold_steps
            self._steps_left = max(self._steps_left, hold_steps)
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
