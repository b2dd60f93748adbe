"""What is in control, and what the car is told while that changes: a pure state machine.

```
state       the person holds     the person has let go
policy      taking or human      policy
taking      taking or human      returning or policy
human       human                returning or policy
returning   taking or human      returning or policy
```

Where a cell names two states, the second is reached when the action is no further from its goal
than a hand-over may move it (``MAX_SLEW``); until then it moves by just that. So the car never
jumps at a hand-over, and feels it within the first control period.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from trainer.person.interface import Control, Moving, Reading

MAX_SLEW = 0.5
"""The most that the action changes in a control period of a hand-over. From full throttle to full
brake takes four of them, 0.4 s: about what a foot needs from pedal to pedal."""
State = Literal["policy", "taking", "human", "returning"]
NEXT: dict[tuple[State, bool, bool], State] = {
    ("policy", False, True): "policy",
    ("policy", False, False): "policy",
    ("policy", True, False): "taking",
    ("policy", True, True): "human",
    ("taking", True, False): "taking",
    ("taking", True, True): "human",
    ("taking", False, False): "returning",
    ("taking", False, True): "policy",
    ("human", True, False): "human",
    ("human", True, True): "human",
    ("human", False, False): "returning",
    ("human", False, True): "policy",
    ("returning", True, False): "taking",
    ("returning", True, True): "human",
    ("returning", False, False): "returning",
    ("returning", False, True): "policy",
}
"""(state, whether the person holds, whether the goal is within reach) -> state."""


@dataclass(frozen=True)
class Applied:
    """One control period's decision."""

    action: float
    """What the car is told, in [-1, 1]."""
    control: Control
    human: bool
    """Whether the step counts as the person's (mask Delta): all but the policy's own action."""
    first: bool
    """Whether an intervention begins here (eq. 17's intervention time)."""


class TakeOver:
    """Decides each control period from what the policy and the person want, for one episode."""

    def __init__(self) -> None:
        self.state: State = "policy"
        self._applied: float | None = None

    def step(self, policy_action: float, human_action: float, holds: bool) -> Applied:
        """Decide one control period; ``holds``: whether the person wants control (``Intent``)."""
        goal = human_action if holds else policy_action
        # At an episode's start there is nothing to leave from but the policy's action.
        last = policy_action if self._applied is None else self._applied
        before = self.state
        self.state = NEXT[before, holds, abs(goal - last) <= MAX_SLEW]
        handing_over = self.state in ("taking", "returning")
        self._applied = last + min(max(goal - last, -MAX_SLEW), MAX_SLEW) if handing_over else goal
        control: Control = "human" if self.state == "taking" else self.state
        human = self.state != "policy"
        return Applied(self._applied, control, human, first=human and before == "policy")


class Intent:
    """Whether the person wants control: holds something, or has moved the wheel."""

    def __init__(self, moving: Moving) -> None:
        self.moving = moving
        self._moved = False
        self._resting_since_s: float | None = None

    def update(self, reading: Reading, now_s: float) -> bool:
        """Whether the person wants control, from the newest reading."""
        away = abs(reading.action)
        if not reading.by_moving:
            self._moved, self._resting_since_s = False, None
        elif away > self.moving.rest:
            self._moved |= away > self.moving.threshold
            self._resting_since_s = None
        elif self._resting_since_s is None:
            self._resting_since_s = now_s
        elif now_s - self._resting_since_s >= self.moving.rest_s:
            self._moved = False
        return reading.engaged or self._moved
