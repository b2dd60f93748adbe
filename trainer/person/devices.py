"""Keyboard, gamepad and wheel through SDL (pygame), with their window."""

from __future__ import annotations

import os
from collections.abc import Iterator

from edge_runtime.util import UserError

# Before SDL starts: no greeting on stdout, its signal handlers would eat ^C, and a wheel must work
# while another window has the focus.
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
os.environ.setdefault("SDL_NO_SIGNAL_HANDLERS", "1")
os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")

import pygame

from trainer.person.hands import Hands, JoystickHands, KeyboardHands
from trainer.person.interface import Person, Reading, Wish
from trainer.person.profile import SHIPPED, read_profile
from trainer.person.registry import PersonOptions
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


class WindowDevice:
    """Hands, and the keys of the window: pause, restart, discard, quit, which closing it is, too.

    Args:
        hands: the device proper.
    """

    def __init__(self, hands: Hands) -> None:
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
