"""A person at the wheel, as the loop and the command line see one."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from edge_runtime.cli import number, whole_number
from edge_runtime.util import UserError
from trainer.environments import Adapted, make_environment

if TYPE_CHECKING:  # It needs torch, which takes two seconds.
    from trainer.person.coach import Coaching

Amount = float | tuple[float, ...]
"""An action in [-1, 1]: one number, or a tuple of them where the environment has several."""
Wish = Literal["pause", "restart", "discard", "quit"]
"""``pause`` pauses and goes on; ``restart`` ends the episode and starts the next; ``discard`` also
marks the recorded episode, and nothing learns from it; ``quit`` ends the sitting."""
WISHES: tuple[Wish, ...] = ("pause", "restart", "discard", "quit")
Control = Literal["policy", "human", "returning"]
"""What decides the applied action; ``returning``: the person has let go, and the action is on its
way back to the policy's, which still counts as the person's."""
PERSON = "person"  # ``RunConfig.human`` of a run that a person guides


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
    """``DrivingEnv.scene()``: plain lists and numbers in metres, y downwards, the ego car first.
    None: there is ``picture`` instead."""
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
    late_ticks: int = 0  # Control periods of this sitting that began too late
    paused: bool = False
    progress: str = ""  # One line on the learner; empty without one
    coach: Coaching | None = None  # Episodes, learning curve and advice; None: nothing yet
    message: str = ""
    """A line for the page, such as "saving" or "episode ended: goal"; mostly empty."""
    picture: NDArray[np.uint8] | None = None
    """What the environment draws, [height, width, 3], where it has no scene."""


class Person(Protocol):
    """Hands and eyes: a device to ask, a display to show.

    The loop's thread calls all of it, once a control period; nothing may block for longer than a
    few milliseconds.
    """

    @property
    def present(self) -> bool:
        """Whether a browser has the wheel: an episode waits for it."""

    def poll(self, now_s: float) -> Reading:
        """Return the hands at ``now_s`` (``time.monotonic``); at rest without a device."""

    def show(self, view: View) -> None:
        """Show the newest view, unless there is no time for it."""

    def close(self) -> None:
        """Close device and display; a second call does nothing."""


HUMANS = ("web",)
"""Words of ``--human`` for a person; the browser has keyboard, touch, gamepad and wheel."""
PERSON_OPTIONS = {"host": "127.0.0.1", "port": 0, "speed": 1.0}
"""Options that only a person has a use for, with their defaults."""
SLOWEST, FASTEST = 0.01, 1000
"""Simulated seconds in one of the person's."""


def add_person(parser: argparse.ArgumentParser) -> None:
    """Declare the person's options of ``drive`` and ``train``."""
    group = parser.add_argument_group(f"a person at the wheel (--human {'|'.join(HUMANS)})")
    here = "address on which the cockpit listens; by default only this machine reaches it"
    port = "port of the cockpit; 0: any free port"
    speed = number(f"a number from {SLOWEST} to {FASTEST}", lambda x: SLOWEST <= x <= FASTEST)
    slow = "simulated seconds in a real second; 0.5 is slow motion"
    group.add_argument("--host", help=here)
    group.add_argument("--port", type=whole_number(0, 65535), metavar="N", help=port)
    group.add_argument("--speed", type=speed, metavar="X", help=slow)
    group.set_defaults(**PERSON_OPTIONS)


def check_person_options(arguments: argparse.Namespace) -> None:
    """Refuse a person's option where no person drives; raises UserError."""
    for name, default in PERSON_OPTIONS.items():
        if getattr(arguments, name) != default and arguments.human not in HUMANS:
            raise UserError(f"--{name} means nothing with --human {arguments.human}")


def open_person(arguments: argparse.Namespace) -> Person:
    """Open the browser cockpit; UserError where it cannot be served."""
    from trainer.person.web import open_cockpit  # aiohttp takes a third of a second to load

    return open_cockpit(arguments)


RESERVED = {"p", "r", "q", "escape", "backspace", "space"}  # Of the wishes and of Space


@dataclass(frozen=True)
class Controls:
    """The keys of one environment."""

    keys: Mapping[str, Amount]
    """Key, in small letters as ``up`` or ``w`` -> what pressing it fully adds to ``rest``."""
    rest: Amount  # Hands off
    rate_per_s: float  # How quickly a key presses
    names: tuple[str, ...]  # Of the actions

    def mix(self, shares: Mapping[str, float]) -> Amount:
        """Return the action for keys pressed by these shares, 0 to 1; unknown keys do nothing."""
        pressed = [np.multiply(share, self.keys[key]) for key, share in shares.items()
                   if key in self.keys]  # fmt: skip
        return amount(np.clip(np.add(self.rest, sum(pressed)), -1.0, 1.0))

    @property
    def help(self) -> str:
        """A line for the page: which key does what."""
        held: dict[str, list[str]] = {}
        for key in self.keys:
            action = zip(self.names, vector(self.mix({key: 1.0})), strict=True)
            words = ", ".join(f"{name} {value:+g}" for name, value in action)
            held.setdefault(words, []).append(key.capitalize())
        what = (f"{' / '.join(keys)}: {words}" for words, keys in held.items())
        return "    ".join(["hold to take over", *what, "Space: hands off"])


@cache
def controls_of(scenario: str) -> Controls:
    """Return the controls of an environment; UserError where a person cannot drive it."""
    with closing(make_environment(scenario)) as env:
        if isinstance(env, Adapted) and not env.can_be_seen:
            raise UserError(f"a person cannot see {scenario}: it has no render() and no scene()")
        if not env.keys:
            raise UserError(f"a person cannot drive {scenario}: several actions, and no keys")
        rest = amount(env.rest_action)
        keys = {
            name.lower().removeprefix("arrow").removeprefix("key"): amount(np.subtract(held, rest))
            for name, held in env.keys.items()
        }
        controls = Controls(keys, rest, env.key_rate_per_s, tuple(env.action_names))
    if taken := sorted(RESERVED & keys.keys()):
        raise UserError(f"{scenario} is driven with {', '.join(taken)}, which are the cockpit's")
    return controls
