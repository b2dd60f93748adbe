"""A person at the wheel: inputs, views, options, and who is in control. Pure, but for a lock.

On the way from a page to the car, ``Seat`` picks the page that drives, ``Intent`` decides whether
the person wants control, and ``TakeOver`` computes the action while control changes hands.
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
"""Who decides the applied action; ``returning``: the person has let go, and the action is on its
way back to the policy's, which still counts as the person's."""
PERSON = "person"  # ``RunConfig.human`` of a run that a person guides
HUMANS = ("web",)
"""Words of ``--human`` for a person; the browser has keyboard, touch, gamepad and wheel."""
SLOWEST, FASTEST = 0.01, 1000
"""Range of ``--speed``, simulated seconds per real second."""
SILENCE_S = 0.5  # A page that sends nothing for this long has let go
MAX_SLEW = 0.5
"""Maximum change of the action in a control period of a hand-over. From full throttle to full
brake takes 0.4 s, about as long as a foot needs from pedal to pedal."""
MOVED = 0.15  # How far from rest a wheel or a pedal must be to take over
RESTING = 0.05  # Below this it rests; less than MOVED, for a hand that trembles there
REST_S = 0.6  # How long it must rest to hand control back: a wheel passes its middle in every bend


def amount(action: Any) -> Amount:
    """Convert an action of any kind."""
    values = np.asarray(action, float).reshape(-1).tolist()
    return values[0] if len(values) == 1 else tuple(values)


def distance(first: Amount, second: Amount) -> float:
    """Return the largest difference between two actions."""
    return float(np.abs(np.subtract(first, second)).max())


def vector(action: Amount) -> Any:
    """Convert an action to the environment's form, float32 [n]."""
    return np.atleast_1d(np.asarray(action, np.float32))


@dataclass(frozen=True)
class Reading:
    """The state of the person's hands."""

    action: Amount = 0.0
    """In [-1, 1]: the pedal in the left turn (1 full throttle, -1 full brake), the steering in the
    congestion (negative to the left)."""
    engaged: bool = False
    """Whether the person holds a key, button or pad that takes over; a lost device lets go."""
    wishes: frozenset[Wish] = frozenset()
    """Wishes since the last reading; each press is reported once."""
    by_moving: bool = False
    """Whether moving ``action`` away from rest also takes over, as with a steering wheel."""


@dataclass(frozen=True)
class View:
    """One control period as the cockpit shows it."""

    scenario: str
    scene: dict[str, Any] | None
    """``DrivingEnv.scene()``: plain lists and numbers in metres, y downwards, the ego car first; of
    another environment parts may lack. None: there is ``picture`` instead."""
    frames: NDArray[np.uint8] | None
    """The policy's observation, [2, 45, 80], the older frame first; None if it is no such stack."""
    policy_action: Amount | None  # None where the person drives alone
    human_action: Amount  # The device's action, in control or not
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
    """A line for the page, such as "saving" or "episode ended: goal"; usually empty."""
    picture: NDArray[np.uint8] | None = None
    """The environment's own picture, [height, width, 3], if it has no scene."""


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
    """Combines the policy's and the person's action in each control period of one episode.

    While control changes hands, the action moves towards the new driver's by at most ``MAX_SLEW`` a
    period: it starts at once and never jumps.
    """

    def __init__(self) -> None:
        self.state: Literal["policy", "taking", "human", "returning"] = "policy"
        self.applied: Amount | None = None  # The last action sent to the car

    @property
    def control(self) -> Control:
        return "human" if self.state == "taking" else self.state

    def step(self, policy_action: Amount, human_action: Amount, holds: bool) -> Intervention | None:
        """Decide one control period; ``holds``: whether the person wants control (``Intent``).

        Every step counts as the person's unless its action is the policy's own.
        """
        goal = human_action if holds else policy_action
        # An episode starts from the policy's action.
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
    """Decides whether the person wants control: holds a control, or has moved the wheel."""

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

    A hold, or a turned wheel, counts only after the page has once sent hands off, and after a
    silence it must send that again: a connection that comes back does not take over by itself. The
    server's thread calls ``sit_down``, ``hear`` and ``get_up``, the loop's ``poll``.
    """

    def __init__(self, rest: Amount = 0.0) -> None:
        self._rest, self._off = rest, Reading(rest)
        self._lock = threading.Lock()
        self._pages: list[object] = []
        self._wishes: set[Wish] = set()
        self._reading = self._off
        self._tap: Reading | None = None
        """The reading since the last poll that takes over and is farthest from rest: a tap shorter
        than a control period counts as one period, also while a button is held."""
        self._began = False  # A hold has begun since the last poll
        self._polled = rest  # Action of the page's reading at the last poll
        self._hands_were_off = False
        self._heard_s = float("-inf")

    def sit_down(self, page: object) -> None:
        with self._lock:
            self._pages.append(page)

    def get_up(self, page: object) -> None:
        """Remove a page; its wishes are kept for the next poll."""
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

    def hear(self, page: object, message: Input, now_s: float) -> bool:
        """Record a page's input; return whether it was accepted."""
        with self._lock:
            if self._pages[:1] != [page]:
                return False
            if now_s - self._heard_s > SILENCE_S:
                self._let_go()
            self._heard_s = now_s
            self._wishes |= set(message.wishes)
            # Hands off: nothing is held, and a wheel that takes over by moving is at rest.
            action = self._rest if message.action is None else message.action
            resting = not message.by_moving or distance(action, self._rest) <= RESTING
            self._hands_were_off |= resting and not message.engaged
            if not self._hands_were_off:
                return False
            now = Reading(action, message.engaged, by_moving=message.by_moving)
            if self._wants(now):
                self._began |= not self._wants(self._reading)
                taps = (now, self._tap or now)
                self._tap = max(taps, key=lambda tap: distance(tap.action, self._rest))
            self._reading = now
            return True

    def poll(self, now_s: float) -> Reading:
        """Return the driver's reading at ``now_s``, with each wish once."""
        with self._lock:
            now = self._reading if now_s - self._heard_s <= SILENCE_S else self._off
            is_back = now.action == self._polled if self._wants(now) else self._began
            tap, self._tap, self._began, self._polled = self._tap, None, False, now.action
            if now is not self._off and tap is not None and is_back:
                now = tap
            wishes, self._wishes = frozenset(self._wishes), set()
            return Reading(now.action, now.engaged, wishes, now.by_moving)

    def _wants(self, reading: Reading) -> bool:
        return reading.engaged or moved(reading, self._rest)

    def _let_go(self) -> None:
        self._reading, self._tap, self._began = self._off, None, False
        self._hands_were_off = False
        self._heard_s = float("-inf")
