"""Keyboard, gamepad and wheel through SDL (pygame): from its events to what the hands say."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import pygame

from edge_runtime.util import UserError
from trainer.person.interface import (
    KEY_HELP,
    LET_GO,
    WISH_HELP,
    WISHES,
    Moving,
    Person,
    Reading,
    View,
    Wish,
)
from trainer.person.profile import SHIPPED, Profile, read_profile
from trainer.person.window import Window

WISH_KEYS: dict[int, Wish] = {
    pygame.K_p: "pause",
    pygame.K_r: "restart",
    pygame.K_BACKSPACE: "discard",
    pygame.K_ESCAPE: "quit",
    pygame.K_q: "quit",
}
SHIPPED_PROFILES = {"gamepad": SHIPPED / "gamepad.toml", "wheel": SHIPPED / "g29.toml"}
PERIOD_S = 0.1
KEYS = {
    "left_turn": {pygame.K_UP: 1.0, pygame.K_w: 1.0, pygame.K_DOWN: -1.0, pygame.K_s: -1.0},
    "congestion": {pygame.K_LEFT: -1.0, pygame.K_a: -1.0, pygame.K_RIGHT: 1.0, pygame.K_d: 1.0},
}
RATES_PER_S = {"left_turn": 5.0, "congestion": 2.5}
"""How quickly a key presses: a pedal is down in 0.2 s; a wheel is turned by a tap, not thrown."""


class WindowPerson:
    """Hands before a window, and the window's keys: pause, restart, discard, quit.

    Closing the window is quitting.
    """

    def __init__(self, hands: KeyboardHands | JoystickHands, window: Window) -> None:
        self._hands, self._window = hands, window
        self.help: tuple[str, ...] = (hands.help, WISH_HELP)
        self.moving = hands.moving

    @property
    def present(self) -> bool:
        """Whether the device is there."""
        return self._hands.present

    def poll(self, now_s: float) -> Reading:
        """Take what SDL has heard since the last call."""
        wishes: set[Wish] = set()
        for event in pygame.event.get() if pygame.display.get_init() else ():
            self._hands.handle(event)
            if event.type == pygame.QUIT:
                wishes.add("quit")
            elif event.type == pygame.KEYDOWN and event.key in WISH_KEYS:
                wishes.add(WISH_KEYS[event.key])
        reading = self._hands.read(now_s)
        return Reading(reading.action, reading.engaged, reading.wishes | wishes, reading.by_moving)

    def show(self, view: View) -> None:
        """Draw everything anew."""
        self._window.show(view)

    def close(self) -> None:
        """Close the window, and SDL with it."""
        self._window.close()


def open_keyboard(arguments: argparse.Namespace) -> Person:
    """The keyboard and its window; raises UserError without a screen."""
    return WindowPerson(KeyboardHands(arguments.scenario), Window())


def open_joystick(arguments: argparse.Namespace) -> Person:
    """A gamepad or a wheel, with a window.

    Raises:
        UserError: no screen, no such device, or a profile that is none.
    """
    word = arguments.human
    path = Path(arguments.profile or SHIPPED_PROFILES[word])
    profile = read_profile(path)
    window = Window()
    hands = JoystickHands(profile, arguments.scenario)
    if not hands.present:
        there = ", ".join(joystick.get_name() for joystick in joysticks())
        window.close()
        raise UserError(
            f"no {word} that fits the profile {path.name} ({profile.match or 'any'}): "
            f"{f'there is {there}' if there else 'none is plugged in'}; "
            f"`python -m trainer drive --human {word} --calibrate F.toml` makes a profile"
        )
    return WindowPerson(hands, window)


def joysticks() -> list[Any]:
    """Everything that is plugged in; SDL's joysticks must have been started."""
    return [pygame.joystick.Joystick(number) for number in range(pygame.joystick.get_count())]


class KeyboardHands:
    """Hold a key to take over and drive; the space bar holds without driving."""

    present = True
    moving = Moving()

    def __init__(self, scenario: str) -> None:
        self._keys, self._rate_per_s = KEYS[scenario], RATES_PER_S[scenario]
        self.help = KEY_HELP[scenario]
        self._down: set[int] = set()
        self._tapped: set[int] = set()
        """Pressed since the last reading: a tap shorter than a control period counts for one."""
        self._action = 0.0
        self._read_s: float | None = None

    def handle(self, event: Any) -> None:
        """Follow the keys up and down."""
        if event.type == pygame.KEYDOWN:
            self._down.add(event.key)
            self._tapped.add(event.key)
        elif event.type == pygame.KEYUP:
            self._down.discard(event.key)
        elif event.type == pygame.WINDOWFOCUSLOST:
            # The key's release would be told to another window.
            self._down.clear()

    def read(self, now_s: float) -> Reading:
        """Engaged while any of the keys is down; the action ramps towards what they say."""
        held = self._down | self._tapped
        self._tapped.clear()
        since_s = PERIOD_S if self._read_s is None else min(now_s - self._read_s, PERIOD_S)
        self._read_s = now_s
        driving = held & self._keys.keys()
        if not driving and pygame.K_SPACE not in held:
            self._action = 0.0
            return LET_GO
        target = min(max(sum(self._keys[key] for key in driving), -1.0), 1.0)
        if target * self._action < 0.0:
            self._action = 0.0  # Turning round does not first undo.
        step = self._rate_per_s * since_s
        self._action += min(max(target - self._action, -step), step)
        return Reading(action=self._action, engaged=True)


class JoystickHands:
    """A wheel or a gamepad, as its profile has it; it may be unplugged and plugged in again."""

    def __init__(self, profile: Profile, scenario: str) -> None:
        self._profile, self._scenario = profile, scenario
        self.moving = Moving(profile.threshold, profile.rest, profile.rest_s)
        self._joystick: Any = None
        self._places: dict[int, float] = {}
        """Axes that have moved: SDL calls the others 0, which is a pedal half pressed."""
        self._wishes: set[Wish] = set()
        how = "hold the button"
        if profile.take_over == "moving":
            how = "turn the wheel" if scenario == "congestion" else "press a pedal"
        self.help = f"{profile.name}: {how} to take over"
        self._plug_in()

    @property
    def present(self) -> bool:
        """Whether it is plugged in."""
        return self._joystick is not None

    def handle(self, event: Any) -> None:
        """Follow axes, buttons and plugs."""
        if event.type == pygame.JOYDEVICEADDED and not self.present:
            self._plug_in()
        elif self._joystick is None or getattr(event, "instance_id", None) != self._instance:
            return
        elif event.type == pygame.JOYAXISMOTION:
            self._places[event.axis] = float(event.value)
        elif event.type == pygame.JOYBUTTONDOWN:
            buttons = self._profile.buttons
            self._wishes |= {wish for wish in WISHES if event.button in buttons.get(wish, ())}
        elif event.type == pygame.JOYDEVICEREMOVED:
            self._joystick = None
            self._places.clear()

    def read(self, now_s: float) -> Reading:
        """What axes and buttons say; nothing of a device that is gone."""
        if self._joystick is None:
            return LET_GO
        # Asking for a button that the device does not have is an error in SDL.
        count = self._joystick.get_numbuttons()
        holding = [number for number in self._profile.buttons.get("hold", ()) if number < count]
        held = any(self._joystick.get_button(number) for number in holding)
        wishes, self._wishes = frozenset(self._wishes), set()
        action = self._profile.action(self._scenario, self._places)
        return Reading(action, held, wishes, by_moving=self._profile.take_over == "moving")

    def _plug_in(self) -> None:
        for joystick in joysticks():
            if self._profile.match.lower() in joystick.get_name().lower():
                self._joystick, self._instance = joystick, joystick.get_instance_id()
                return
