"""The human beside the policy: watches each action, takes over, and hands control back."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from trainer.learner.replay import Action, Observation, Transition

Reason = str  # Why the human takes over
STUCK, ASKED, BY_PERSON = "stuck", "asked", "person"
"""The car waits for nothing; the robot asked for help; a person took over. Our scenarios' experts
also give ``collision``, ``lane`` (it stops in the traffic's lane), ``heading`` and ``offset``."""
HOLD_S = 1.5  # How long a human drives at least after the last reason


class Driver(Protocol):
    """Anything that drives: expert, human model, policy."""

    def reset(self) -> None:
        """Forget the last episode; most have nothing to forget."""
        return

    def act(self, observation: Observation) -> Action:
        """Return the action for an observation."""
        ...


class Expert(Driver, Protocol):
    """The scripted human of an environment: drives from the true state, decides when to take over.

    These are the activation conditions of section V.
    """

    def act(self, observation: Any = None) -> Action:
        """Return the expert's action."""
        ...

    def wants_control(self, action: Action) -> Reason | None:
        """Return why a person would take over from ``action`` now, or None. Once a step."""
        ...

    def may_return(self) -> bool:
        """Return whether a person would give the wheel back here: by default anywhere."""
        return True


@dataclass(frozen=True)
class Intervention:
    """A step at which the human acts."""

    action: Action
    reason: Reason
    first: bool  # Whether the human took over at this step (eq. 17's intervention time)


Record = Callable[[Transition, Intervention | None, dict[str, Any]], None]
"""Called with each stored control period and its step's info, by a view or a recording."""


class GuideGone(Exception):  # noqa: N818 (no error: it was asked for)
    """Raised where a person quits before an episode has begun."""


class Guide:
    """Watches the policy and may take over. This one lets everything pass; others override it."""

    stop = False  # A person wants no further episode

    def reset(self) -> None:
        """Start an episode with the policy in control."""

    def watch(
        self, observation: Observation, policy_action: Action, doubt: float = 0.0
    ) -> Intervention | None:
        """Return the human's part in a step, or None to let ``policy_action`` pass. Once a step.

        ``doubt``: how much the critics differ about the action, for a robot that asks.
        """
        return None

    def end_episode(self, outcome: str) -> str:
        """Return the outcome of the episode that has ended; a person may discard it."""
        return outcome

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed run needs."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""


class Asking:
    """Lets the robot ask for help where its critics differ most; the human need not watch.

    It asks where the doubt is in the highest ``share`` of the recent doubts, as ThriftyDAgger does
    (2109.08273). Until it has seen ``MEMORY`` doubts, the human watches.
    """

    MEMORY = 500  # Control periods

    def __init__(self, share: float) -> None:
        self.share = share
        self.doubts: deque[float] = deque(maxlen=self.MEMORY)

    def ask(self, doubt: float, watched: Reason | None) -> Reason | None:
        """Note a step's doubt; return the reason to take over in it, if any."""
        self.doubts.append(doubt)
        if len(self.doubts) < self.MEMORY:
            return watched
        return ASKED if doubt > np.quantile(self.doubts, 1.0 - self.share) else None


class Attention:
    """Delays a human's take-over, or lets the human miss a reason and then all for a while.

    ``late_steps``: minimum and maximum delay in control periods, drawn for each take-over;
    ``missed_share``: how often the human misses a reason. A late human overrules, and penalises,
    the policy's action at the take-over, not the one that gave the reason.
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
        """Return the reason once the delay has passed, even if it is gone by then."""
        if self._steps_left == 0:
            if reason is None:
                return None
            missed = self.random.random() < self.missed_share
            self._reason = None if missed else reason
            late = self.BLIND_STEPS if missed else round(self.random.uniform(*self.late_steps))
            self._steps_left = late + 1
        self._steps_left -= 1
        return self._reason if self._steps_left == 0 else None


class PoorHands:
    """Replaces a share of a human's actions by wrong ones: always ``biased``, or random if None.

    ``whole``: replaces a share of the take-overs instead, each from its beginning to its end.
    """

    def __init__(
        self, share: float, biased: float | None, random: np.random.Generator, whole: bool = False
    ) -> None:
        self.share, self.biased, self.random, self.whole = share, biased, random, whole
        self._wrong = False

    def spoil(self, action: Action, first: bool) -> Action:
        """Return the action or a wrong one; ``first``: whether a take-over begins."""
        if first or not self.whole:
            self._wrong = self.random.random() < self.share
        if not self._wrong:
            return action
        if self.biased is not None:
            return np.full(action.shape, self.biased, np.float32)
        return self.random.uniform(-1.0, 1.0, action.shape).astype(np.float32)


def steps_held(period_s: float) -> int:
    """Return ``HOLD_S`` in control periods."""
    return round(HOLD_S / period_s)


class HumanGuide(Guide):
    """Takes over where ``trigger``, a scripted human, gives a reason; ``driver`` then drives.

    The human stays in control for ``hold_steps`` after the last reason: a person first brings the
    car out of danger. If the robot asked, a third of that is enough: nothing is wrong yet. While in
    control, every human is attentive.
    """

    def __init__(
        self,
        driver: Driver,
        trigger: Expert,
        hold_steps: int,
        attention: Attention | None = None,
        asking: Asking | None = None,
        hands: PoorHands | None = None,
        random: np.random.Generator | None = None,
    ) -> None:
        """``random`` is the stream that attention and hands draw from, kept in a checkpoint."""
        self.driver, self.trigger, self.hold_steps = driver, trigger, hold_steps
        self.attention, self.asking, self.hands, self.random = attention, asking, hands, random
        self.reset()

    def reset(self) -> None:
        """Start an episode with the policy in control."""
        self.driver.reset()
        self.trigger.reset()
        if self.attention:
            self.attention.reset()
        self._steps_left = 0
        self._reason: Reason | None = None

    def watch(
        self, observation: Observation, policy_action: Action, doubt: float = 0.0
    ) -> Intervention | None:
        """Return the human's part in a step, or None to let ``policy_action`` pass."""
        reason, before = self.trigger.wants_control(policy_action), self._reason
        if self.asking:
            reason = self.asking.ask(doubt, reason)
        if before is None and self.attention:
            reason = self.attention.notices(reason)
        if reason is not None:
            hold_steps = max(self.hold_steps // 3, 1) if reason == ASKED else self.hold_steps
            self._steps_left = max(self._steps_left, hold_steps)
        if self._steps_left == 0 and (before is None or self.trigger.may_return()):
            self._reason = None
            return None
        self._steps_left = max(self._steps_left - 1, 0)
        if before is None:
            # A person who takes over looks at the scene afresh.
            self.driver.reset()
            self._reason = reason
        assert self._reason is not None
        action = self.driver.act(observation)
        action = self.hands.spoil(action, before is None) if self.hands else action
        return Intervention(action, self._reason, first=before is None)

    def state_dict(self) -> dict[str, Any]:
        """Return the random stream and the robot's doubts."""
        doubts: Sequence[float] = self.asking.doubts if self.asking else ()
        random = self.random.bit_generator.state if self.random else None
        return {"guidance": random, "doubts": list(doubts)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a ``state_dict``."""
        if self.random:
            self.random.bit_generator.state = state["guidance"]
        if self.asking:
            self.asking.doubts.extend(state["doubts"])
