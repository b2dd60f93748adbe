"""Keyboard, gamepad and wheel through SDL (pygame): from its events to what the hands say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pygame

from edge_runtime.util import UserError
from trainer.person.interface import KEY_HELP, LET_GO, WISHES, Person, PersonOptions, Reading, Wish
from trainer.person.profile import SHIPPED, Profile, read_profile
from trainer.person.window import Window

WISH_KEYS: dict[int, Wish] = {
    pygame.K_p: "pause",
    pygame.K_r: "restart",
    pygame.K_BACKSPACE: "discard",
    pygame.K_ESCAPE: "quit",
    pygame.K_q: "quit",
}
WISH_HELP = (
    "P: pause    R: restart the episode    Backspace: discard it, or the one that has just ended"
    "    Q / Esc: quit, all is kept"
)
SHIPPED_PROFILES = {"gamepad": SHIPPED / "gamepad.toml", "wheel": SHIPPED / "g29.toml"}
PERIOD_S = 0.1
KEYS = {
    "left_turn": {pygame.K_UP: 1.0, pygame.K_w: 1.0, pygame.K_DOWN: -1.0, pygame.K_s: -1.0},
    "congestion": {pygame.K_LEFT: -1.0, pygame.K_a: -1.0, pygame.K_RIGHT: 1.0, pygame.K_d: 1.0},
}
RATES_PER_S = {"left_turn": 5.0, "congestion": 2.5}
"""How quickly a key presses: a pedal is down in 0.2 s; a wheel is turned by a tap, not thrown."""


class WindowDevice:
    """Hands, and the keys of the window: pause, restart, discard, quit, which closing it is, too.

    Args:
        hands: the device proper.
    """

    def __init__(self, hands: KeyboardHands | JoystickHands) -> None:
        self._hands = hands

    @property
    def help(self) -> tuple[str, ...]:
        """What to press for what."""
        return (*self._hands.help, WISH_HELP)

    @property
    def present(self) -> bool:
        """Whether the device is there."""
        return self._hands.present

    def poll(self, now_s: float) -> Reading:
        """Take what SDL has heard since the last call."""
        wishes = frozenset(self._take_events())
        reading = self._hands.read(now_s)
        return Reading(reading.action, reading.engaged, reading.wishes | wishes, reading.by_moving)

    def close(self) -> None:
        """Nothing of its own: the window closes SDL."""

    def _take_events(self) -> Iterator[Wish]:
        if not pygame.display.get_init():
            return
        for event in pygame.event.get():
            self._hands.handle(event)
            if event.type == pygame.QUIT:
                yield "quit"
            elif event.type == pygame.KEYDOWN and event.key in WISH_KEYS:
                yield WISH_KEYS[event.key]


def open_keyboard(options: PersonOptions) -> Person:
    """The keyboard and its window; raises UserError without a screen."""
    window = Window()
    return Person(WindowDevice(KeyboardHands(options.scenario)), window)


def open_joystick(options: PersonOptions, word: str) -> Person:
    """A ``gamepad`` or a ``wheel``, with a window.

    Raises:
        UserError: no screen, no such device, or a profile that is none.
    """
    path = options.profile or SHIPPED_PROFILES[word]
    profile = read_profile(path)
    window = Window()
    hands = JoystickHands(profile, options.scenario)
    if not hands.present:
        there = [
            pygame.joystick.Joystick(number).get_name()
            for number in range(pygame.joystick.get_count())
        ]
        window.close()
        seen = f"there is {', '.join(there)}" if there else "none is plugged in"
        raise UserError(
            f"no {word} that fits the profile {path.name} ({profile.match or 'any'}): {seen}; "
            f"`python -m trainer drive --human {word} --calibrate F.toml` makes a profile"
        )
    return Person(WindowDevice(hands), window, profile.moving)


class KeyboardHands:
    """Hold a key to take over and drive; the space bar holds without driving.

    Args:
        scenario: decides the keys.
    """

    present = True

    def __init__(self, scenario: str) -> None:
        self._keys, self._rate_per_s = KEYS[scenario], RATES_PER_S[scenario]
        self.help = (
            f"hold to take over    {KEY_HELP[scenario]}",
            "Space: take over without driving",
        )
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
            self._action = 0.0  # Who turns round does not first undo.
        step = self._rate_per_s * since_s
        self._action += min(max(target - self._action, -step), step)
        return Reading(action=self._action, engaged=True)


class JoystickHands:
    """A wheel or a gamepad, as its profile has it; it may be unplugged and plugged in again.

    Args:
        profile: what the axes and buttons mean.
        scenario: decides which axes drive.
    """

    def __init__(self, profile: Profile, scenario: str) -> None:
        self._profile, self._scenario = profile, scenario
        self._joystick: Any = None
        self._places: dict[int, float] = {}
        """Of the axes that have moved: SDL calls the others 0, which is a pedal half pressed."""
        self._wishes: set[Wish] = set()
        how = "hold the button to take over"
        if profile.take_over == "moving":
            how = (
                f"{'turn the wheel' if scenario == 'congestion' else 'press a pedal'} to take over"
            )
        self.help = (f"{profile.name}: {how}",)
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
            self._press(event.button)
        elif event.type == pygame.JOYDEVICEREMOVED:
            self._joystick = None
            self._places.clear()

    def read(self, now_s: float) -> Reading:
        """What axes and buttons say; nothing of a device that is gone."""
        if self._joystick is None:
            return LET_GO
        held = any(self._joystick.get_button(b) for b in self._buttons("hold"))
        wishes, self._wishes = frozenset(self._wishes), set()
        action = self._profile.action(self._scenario, self._places)
        moving = self._profile.take_over == "moving"
        return Reading(action, held, wishes, by_moving=moving)

    def _plug_in(self) -> None:
        for number in range(pygame.joystick.get_count()):
            joystick = pygame.joystick.Joystick(number)
            if self._profile.match.lower() in joystick.get_name().lower():
                self._joystick, self._instance = joystick, joystick.get_instance_id()
                return

    def _press(self, button: int) -> None:
        self._wishes |= {wish for wish in WISHES if button in getattr(self._profile.buttons, wish)}

    def _buttons(self, what: str) -> list[int]:
        """The profile's numbers that this device has; asking for another is an error in SDL."""
        count = self._joystick.get_numbuttons()
        return [number for number in getattr(self._profile.buttons, what) if number < count]
