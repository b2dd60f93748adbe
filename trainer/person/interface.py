"""What the loop knows of a person: a device that is asked, a display that is shown.

The loop's thread calls everything here, once a control period while driving and about as often
while paused; nothing may block for longer than a few milliseconds. A window is two objects, a
browser may be one that is both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

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
