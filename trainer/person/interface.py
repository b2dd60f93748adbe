"""A person as the loop and the command line know one: a device to ask, a display to show.

The loop's thread calls everything here, once a control period while driving and about as often
while paused; nothing may block for longer than a few milliseconds. A window is two objects, a
browser may be one that is both.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from edge_runtime.cli import positive_number, whole_number
from edge_runtime.util import UserError

Wish = Literal["pause", "restart", "discard", "quit"]
"""``pause`` pauses and goes on; ``restart`` ends the episode and starts the next; ``discard``
does so and throws it away: it stays in the recording, marked, and nothing learns from it; ``quit``
ends the sitting."""
WISHES: tuple[Wish, ...] = ("pause", "restart", "discard", "quit")
Control = Literal["policy", "human", "returning"]
"""Who decides the applied action; ``returning``: the person has let go and the action is on its way
back to the policy's, which still counts as the person's."""
KEY_HELP = {
    "left_turn": "Up / W: throttle    Down / S: brake",
    "congestion": "Left / A, Right / D: steer",
}
"""Scenario -> what its keys do, in a window and in the browser alike."""
PERSON = "person"
"""``RunConfig.human`` of every device: a run may go on with another one."""


@dataclass(frozen=True)
class Reading:
    """What the person does now."""

    action: float = 0.0
    """The scenario's one action, in [-1, 1]: the pedal in the left turn (1 full throttle, -1 full
    brake), the steering in the congestion (negative to the left)."""
    engaged: bool = False
    """Whether the person holds what takes over. A lost connection or device is letting go."""
    wishes: frozenset[Wish] = frozenset()
    """What was asked for since the last reading; each press is reported once."""
    by_moving: bool = False
    """Whether moving ``action`` away from rest takes over, too, as a steering wheel does
    (``Moving``)."""


LET_GO = Reading()
"""Nobody there."""


@dataclass(frozen=True)
class Moving:
    """When moving a wheel or a pedal takes over, and when its resting gives back."""

    threshold: float = 0.15
    """How far from rest ``Reading.action`` must be to take over."""
    rest: float = 0.05
    """Below this it rests. Less than ``threshold``, so that a hand that trembles there does not
    take over time and again."""
    rest_s: float = 0.6
    """How long it must rest to give back: a wheel passes its middle in every bend."""


@dataclass(frozen=True)
class View:
    """What a person sees of one control period."""

    scenario: str
    scene: dict[str, Any]
    """``DrivingEnv.scene()``: roads, path, goal, vehicles (the ego car first), and the corner of
    the ground shown, in metres; plain lists and numbers, y downwards. Draw with it what
    ``scenarios/scene.py`` draws."""
    frames: NDArray[np.uint8]
    """What the policy sees: [2, 45, 80], the older frame first."""
    policy_action: float | None
    """None where the person drives alone."""
    human_action: float
    """What the device says, in control or not."""
    applied_action: float
    """What the car was told."""
    control: Control
    speed_mps: float
    distance_m: float
    goal_m: float
    episode: int
    step: int
    time_s: float
    """Simulated time since the episode's start."""
    late_ticks: int = 0
    """Control periods of this sitting that began too late."""
    paused: bool = False
    progress: str = ""
    """One line on the learner; empty without one."""
    message: str = ""
    """What is going on besides driving: "saving", "episode ended: goal"; mostly empty."""
    help: tuple[str, ...] = field(default=())
    """The device's keys, one line each."""


class Device(Protocol):
    """Where the person's hands are."""

    @property
    def help(self) -> tuple[str, ...]:
        """What to press for what, one short line each."""
        ...

    @property
    def present(self) -> bool:
        """Whether a person can act: a browser has the wheel, a gamepad is plugged in. Before an
        episode the loop waits for it; within one, somebody absent has let go.
        """
        ...

    def poll(self, now_s: float) -> Reading:
        """What the person does at ``now_s`` (``time.monotonic``). Never blocks, never raises: a
        device that is gone reads ``LET_GO``.
        """
        ...

    def close(self) -> None:
        """Let go of the device; twice is once."""


class Display(Protocol):
    """Where the person's eyes are."""

    def show(self, view: View) -> None:
        """Show the newest view; never blocks, and may leave out views it has no time for."""

    def close(self) -> None:
        """Close it; twice is once."""


@dataclass(frozen=True)
class Person:
    """Hands and eyes. ``device`` and ``display`` may be the same object."""

    device: Device
    display: Display
    moving: Moving = Moving()

    def close(self) -> None:
        """Close both."""
        self.device.close()
        self.display.close()


@dataclass(frozen=True)
class PersonOptions:
    """What the command line says about the person's device."""

    scenario: str = "left_turn"
    profile: Path | None = None
    """Axes and buttons of a gamepad or wheel; None: the shipped one."""
    host: str = "127.0.0.1"
    port: int = 0
    """Of the browser cockpit; 0: any free one."""


def _opener(module: str, name: str, *more: str) -> Callable[[PersonOptions], Person]:
    """Opens a device; the libraries behind it are imported only then."""

    def open_device(options: PersonOptions) -> Person:
        opened: Person = getattr(import_module(module), name)(options, *more)
        return opened

    return open_device


HUMANS = {
    "keyboard": _opener("trainer.person.devices", "open_keyboard"),
    "gamepad": _opener("trainer.person.devices", "open_joystick", "gamepad"),
    "wheel": _opener("trainer.person.devices", "open_joystick", "wheel"),
    "web": _opener("trainer.person.web", "open_cockpit"),
}
"""Word of ``--human`` -> opens device and display; raises UserError where there is none."""
USEFUL = {
    "profile": ("gamepad", "wheel"),
    "host": ("web",),
    "port": ("web",),
    "speed": tuple(HUMANS),
}
"""Option of a person -> the devices that have a use for it."""
DEFAULTS = {"profile": None, "host": PersonOptions.host, "port": PersonOptions.port, "speed": 1.0}


def add_person(parser: argparse.ArgumentParser) -> None:
    """Declare the person's options of ``drive`` and ``train``."""
    group = parser.add_argument_group(f"a person at the wheel (--human {'|'.join(HUMANS)})")
    group.add_argument(
        "--profile",
        metavar="F.toml",
        help="what the axes and buttons of --human gamepad or wheel mean (default: as shipped)",
    )
    group.add_argument(
        "--host",
        default=DEFAULTS["host"],
        help="the address at which --human web listens; by default this machine's alone",
    )
    group.add_argument(
        "--port",
        type=whole_number(0, 65535),
        default=DEFAULTS["port"],
        metavar="N",
        help="the port of --human web; 0: any that is free",
    )
    group.add_argument(
        "--speed",
        type=positive_number,
        default=DEFAULTS["speed"],
        metavar="X",
        help="simulated seconds in one of yours: 0.5 is slow motion",
    )


def person_options(arguments: argparse.Namespace) -> PersonOptions:
    """What the command line says about the device.

    Raises:
        UserError: an option that the device has no use for.
    """
    check_person_options(arguments)
    profile = None if arguments.profile is None else Path(arguments.profile)
    return PersonOptions(arguments.scenario, profile, arguments.host, arguments.port)


def check_person_options(arguments: argparse.Namespace) -> None:
    """Refuse what ``--human``, a device or not, has no use for; raises UserError."""
    for name, devices in USEFUL.items():
        if getattr(arguments, name) != DEFAULTS[name] and arguments.human not in devices:
            raise UserError(f"--{name} means nothing with --human {arguments.human}")
