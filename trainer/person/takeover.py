"""Who is in control: which page of the browser, and the person or the policy. Pure but for a lock.

Three parts, from the hands to the car: ``Seat`` says which page's hands count, ``Intent`` whether
the person wants control, ``TakeOver`` what the car is told while that changes.
"""

import threading
from typing import Annotated, Literal

import msgspec
import numpy as np

from trainer.human.guide import BY_PERSON, Intervention
from trainer.person.interface import (
    WISHES,
    Amount,
    Control,
    Reading,
    Wish,
    amount,
    distance,
    vector,
)

SILENCE_S = 0.5  # A driver who is not heard for this long has let go
MAX_SLEW = 0.5
"""Most change of the action in a control period of a hand-over. From full throttle to full brake
takes 0.4 s: about what a foot needs from pedal to pedal."""
MOVED = 0.15
"""How far from rest a wheel or a pedal must be to take over."""
RESTING = 0.05  # Below this it rests; less than MOVED, for a hand that trembles there
REST_S = 0.6  # How long it must rest to hand control back: a wheel passes its middle in every bend
State = Literal["policy", "taking", "human", "returning"]
NEXT: dict[tuple[State, bool], tuple[State, State]] = {
    ("policy", True): ("taking", "human"),
    ("policy", False): ("policy", "policy"),
    ("taking", True): ("taking", "human"),
    ("taking", False): ("returning", "policy"),
    ("human", True): ("human", "human"),
    ("human", False): ("returning", "policy"),
    ("returning", True): ("taking", "human"),
    ("returning", False): ("returning", "policy"),
}
"""(state, whether the person holds) -> next state while the wanted action is further away than
``MAX_SLEW``, next state once it is not. Until then the action moves by ``MAX_SLEW`` a period: it
never jumps, and begins to move at once."""


class TakeOver:
    """Decides each control period from what the policy and the person want, for one episode."""

    def __init__(self) -> None:
        self.state: State = "policy"
        self.applied: Amount | None = None  # What the car was told last

    @property
    def control(self) -> Control:
        return "human" if self.state == "taking" else self.state

    def step(self, policy_action: Amount, human_action: Amount, holds: bool) -> Intervention | None:
        """Decide one control period; ``holds``: whether the person wants control (``Intent``).

        Every step counts as the person's whose action is not the policy's own.
        """
        goal = human_action if holds else policy_action
        # At an episode's start there is nothing to leave from but the policy's action.
        last = policy_action if self.applied is None else self.applied
        before = self.state
        self.state = NEXT[before, holds][distance(goal, last) <= MAX_SLEW]
        if self.state in ("taking", "returning"):
            change = np.clip(np.subtract(goal, last), -MAX_SLEW, MAX_SLEW)
            goal = amount(np.add(last, change))
        self.applied = goal
        if self.state == "policy":
            return None
        return Intervention(vector(goal), BY_PERSON, first=before == "policy")


def moved(reading: Reading, rest: Amount) -> bool:
    """Return whether a wheel or a pedal is far enough from rest to take over."""
    return reading.by_moving and distance(reading.action, rest) > MOVED


class Intent:
    """Decides whether the person wants control: holds something, or has moved the wheel."""

    def __init__(self, rest: Amount = 0.0) -> None:
        self._rest = rest
        self._moved = False
        self._resting_since_s: float | None = None

    def update(self, reading: Reading, now_s: float) -> bool:
        """Return whether the person wants control, by the newest reading."""
        if not reading.by_moving:
            self._moved, self._resting_since_s = False, None
        elif distance(reading.action, self._rest) > RESTING:
            self._moved |= moved(reading, self._rest)
            self._resting_since_s = None
        elif self._resting_since_s is None:
            self._resting_since_s = now_s
        elif now_s - self._resting_since_s >= REST_S:
            self._moved = False
        return reading.engaged or self._moved


Share = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
MOST_ACTIONS = 16


class Input(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A page's message, at least every 100 ms; silence is letting go."""

    at_ms: Annotated[float, msgspec.Meta(ge=0.0, le=1e15)]
    """The page's clock, sent back at once, so that the page knows the round trip."""
    action: Share | Annotated[tuple[Share, ...], msgspec.Meta(max_length=MOST_ACTIONS)] | None
    """None: hands off."""
    engaged: bool
    by_moving: bool = False  # Whether moving ``action`` takes over, too: a steering wheel
    wishes: Annotated[tuple[Wish, ...], msgspec.Meta(max_length=len(WISHES))] = ()
    seen: Annotated[int, msgspec.Meta(ge=0)] = 0  # Number of the newest view that was drawn


class Seat:
    """The pages of a cockpit: the oldest one drives, the others watch.

    A hold, or a wheel that is turned, counts only after the page was heard with its hands off, and
    after a silence it must be heard so again: a connection that comes back does not take over by
    itself. The server's thread calls ``sit_down``, ``hear`` and ``get_up``, the loop's ``poll``.
    """

    def __init__(self, rest: Amount = 0.0) -> None:
        self._rest, self._off = rest, Reading(rest)
        self._lock = threading.Lock()
        self._pages: list[object] = []
        self._wishes: set[Wish] = set()
        self._said = self._off
        self._tap: Reading | None = None
        """The farthest of what took over since the last poll, by a button, a wheel or a pedal: a
        tap shorter than a control period counts for one."""
        self._hands_were_off = False
        self._heard_s = float("-inf")

    def sit_down(self, page: object) -> None:
        with self._lock:
            self._pages.append(page)

    def get_up(self, page: object) -> None:
        """Remove a page; what its driver wished for still stands."""
        with self._lock:
            if self._pages[:1] == [page]:
                self._let_go()
            self._pages = [other for other in self._pages if other != page]

    def is_driver(self, page: object) -> bool:
        with self._lock:
            return self._pages[:1] == [page]

    def is_heard(self, now_s: float) -> bool:
        with self._lock:
            return now_s - self._heard_s <= SILENCE_S

    def hear(self, page: object, said: Input, now_s: float) -> bool:
        """Record a page's input; return whether it was accepted."""
        with self._lock:
            if self._pages[:1] != [page]:
                return False
            if now_s - self._heard_s > SILENCE_S:
                self._let_go()
            self._heard_s = now_s
            self._wishes |= set(said.wishes)
            # Nothing is held, and a wheel that takes over by moving is at rest.
            action = self._rest if said.action is None else said.action
            resting = not said.by_moving or distance(action, self._rest) <= RESTING
            self._hands_were_off |= resting and not said.engaged
            if not self._hands_were_off:
                return False
            before, now = self._said, Reading(action, said.engaged, by_moving=said.by_moving)
            if self._wants(now) and (self._tap is not None or not self._wants(before)):
                taps = (now, self._tap or now)
                self._tap = max(taps, key=lambda tap: distance(tap.action, self._rest))
            self._said = now
            return True

    def poll(self, now_s: float) -> Reading:
        """Return what the driver does at ``now_s``; each wish once."""
        with self._lock:
            said = self._said if now_s - self._heard_s <= SILENCE_S else self._off
            if said is not self._off and not self._wants(said) and self._tap is not None:
                said = self._tap
            self._tap = None
            wishes, self._wishes = frozenset(self._wishes), set()
            return Reading(said.action, said.engaged, wishes, said.by_moving)

    def _wants(self, said: Reading) -> bool:
        return said.engaged or moved(said, self._rest)

    def _let_go(self) -> None:
        self._said, self._tap = self._off, None
        self._hands_were_off = False
        self._heard_s = float("-inf")
