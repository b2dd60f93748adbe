"""A person at the wheel: hands and eyes, their options, and who is in control. Pure but for a lock.

From the hands to the car: ``Seat`` says which page's hands count, ``Intent`` whether the person
wants control, ``TakeOver`` what the car is told while that changes.
"""

from __future__ import annotations

import argparse
import threading
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_runtime.cli import number, whole_number
from trainer.human.guide import BY_PERSON, Intervention

Amount = float | tuple[float, ...]
"""An action in [-1, 1]: one number, or a tuple of them where the environment has several."""
Wish = Literal["pause", "restart", "discard", "quit", "succeeded", "failed"]
"""``pause`` pauses and goes on; ``restart`` ends the episode and starts the next; ``discard`` also
marks the recorded episode, and nothing learns from it; ``quit`` ends the sitting; ``succeeded`` and
``failed`` are the person's word on an episode of which the environment says neither."""
WISHES: tuple[Wish, ...] = get_args(Wish)
Control = Literal["policy", "human", "returning"]
"""What decides the applied action; ``returning``: the person has let go, and the action is on its
way back to the policy's, which still counts as the person's."""
PERSON = "person"  # ``RunConfig.human`` of a run that a person guides
HUMANS = ("web",)
"""Words of ``--human`` for a person; the browser has keyboard, touch, gamepad and wheel."""
SLOWEST, FASTEST = 0.01, 1000
"""Simulated seconds in one of the person's."""
SILENCE_S = 0.5  # A driver who is not heard for this long has let go
MAX_SLEW = 0.5
"""Most change of the action in a control period of a hand-over. From full throttle to full brake
takes 0.4 s: about what a foot needs from pedal to pedal."""
MOVED = 0.15  # How far from rest a wheel or a pedal must be to take over
RESTING = 0.05  # Below this it rests; less than MOVED, for a hand that trembles there
REST_S = 0.6  # How long it must rest to hand control back: a wheel passes its middle in every bend


def amount(action: Any) -> Amount:
    """Convert an action of any kind."""
    values = np.asarray(action, float).reshape(-1).tolist()
    return values[0] if len(values) == 1 else tuple(values)


def distance(one: Amount, other: Amount) -> float:
    """Return the largest difference between two actions."""
    return float(np.abs(np.subtract(one, other)).max())


def vector(action: Amount) -> Any:
    """Convert an action to what the environment takes, float32 [n]."""
    return np.atleast_1d(np.asarray(action, np.float32))


@dataclass(frozen=True)
class Reading:
    """The state of the person's hands."""

    action: Amount = 0.0
    """In [-1, 1]: the pedal in the left turn (1 full throttle, -1 full brake), the steering in the
    congestion (negative to the left)."""
    engaged: bool = False
    """Whether the person holds what takes over. A lost connection or device is letting go."""
    wishes: frozenset[Wish] = frozenset()
    """What was asked for since the last reading; each press is reported once."""
    by_moving: bool = False
    """Whether moving ``action`` away from rest also takes over, as with a steering wheel."""


@dataclass(frozen=True)
class View:
    """What a person sees of one control period."""

    scenario: str
    scene: dict[str, Any] | None
    """``DrivingEnv.scene()``: plain lists and numbers in metres, y downwards, the ego car first; of
    another environment parts may lack. None: there is ``picture`` instead."""
    frames: NDArray[np.uint8] | None
    """What the policy sees: [2, 45, 80], the older frame first; None: something else."""
    policy_action: Amount | None  # None where the person drives alone
    human_action: Amount  # What the device says, in control or not
    applied_action: Amount
    control: Control
    speed_mps: float  # nan where the environment does not tell, as ``goal_m``
    distance_m: float
    goal_m: float
    episode: int  # From 0; the page shows it from 1
    step: int
    time_s: float  # Simulated time since the episode's start
    paused: bool = False
    progress: str = ""  # One line on the learner; empty without one
    message: str = ""
    """A line for the page, such as "saving" or "episode ended: goal"; mostly empty."""
    picture: NDArray[np.uint8] | None = None
    """What the environment draws, [height, width, 3], where it has no scene."""


def add_person(parser: argparse.ArgumentParser) -> None:
    """Declare the person's options of ``drive`` and ``train``."""
    group = parser.add_argument_group(f"a person at the wheel (--human {'|'.join(HUMANS)})")
    here = "address on which the cockpit listens; the default admits only this machine"
    port = "port of the cockpit; 0: any free port"
    speed = number(f"a number from {SLOWEST} to {FASTEST}", lambda x: SLOWEST <= x <= FASTEST)
    slow = "simulated seconds per real second; 0.5 is half speed"
    group.add_argument("--host", default="127.0.0.1", help=here)
    group.add_argument("--port", type=whole_number(0, 65535), default=0, metavar="N", help=port)
    group.add_argument("--speed", type=speed, default=1.0, metavar="X", help=slow)


class TakeOver:
    """Decides each control period from what the policy and the person want, for one episode.

    While control changes hands, the action moves by at most ``MAX_SLEW`` a period towards the new
    driver's: it never jumps, and begins to move at once.
    """

    def __init__(self) -> None:
        self.state: Literal["policy", "taking", "human", "returning"] = "policy"
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
        before, driver = self.state, "human" if holds else "policy"
        if before == driver or distance(goal, last) <= MAX_SLEW:
            self.state = "human" if holds else "policy"
        else:
            self.state = "taking" if holds else "returning"
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
        """The farthest of what takes over since the last poll, by a button, a wheel or a pedal: a
        tap shorter than a control period counts for one, also while a button is held."""
        self._began = False  # A hold has begun since then
        self._polled = rest  # The action that was said then
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
            if self._wants(now):
                self._began |= not self._wants(before)
                taps = (now, self._tap or now)
                self._tap = max(taps, key=lambda tap: distance(tap.action, self._rest))
            self._said = now
            return True

    def poll(self, now_s: float) -> Reading:
        """Return what the driver does at ``now_s``; each wish once."""
        with self._lock:
            said = self._said if now_s - self._heard_s <= SILENCE_S else self._off
            is_back = said.action == self._polled if self._wants(said) else self._began
            tap, self._tap, self._began, self._polled = self._tap, None, False, said.action
            if said is not self._off and tap is not None and is_back:
                said = tap
            wishes, self._wishes = frozenset(self._wishes), set()
            return Reading(said.action, said.engaged, wishes, said.by_moving)

    def _wants(self, said: Reading) -> bool:
        return said.engaged or moved(said, self._rest)

    def _let_go(self) -> None:
        self._said, self._tap, self._began = self._off, None, False
        self._hands_were_off = False
        self._heard_s = float("-inf")
