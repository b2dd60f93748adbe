"""Which devices a person may use, by the word of ``--human``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from trainer.person.interface import Person


@dataclass(frozen=True)
class PersonOptions:
    """What the command line says about the person's device."""

    scenario: str = "left_turn"
    profile: Path | None = None
    """Axes and buttons of a gamepad or wheel; None: the shipped one."""
    host: str = "127.0.0.1"
    port: int = 0
    """Of the browser cockpit; 0: any free one."""


def _keyboard(options: PersonOptions) -> Person:
    from trainer.person.devices import open_keyboard

    return open_keyboard(options)


def _gamepad(options: PersonOptions) -> Person:
    from trainer.person.devices import open_joystick

    return open_joystick(options, "gamepad")


def _wheel(options: PersonOptions) -> Person:
    from trainer.person.devices import open_joystick

    return open_joystick(options, "wheel")


def _web(options: PersonOptions) -> Person:
    from trainer.person.web.cockpit import open_cockpit

    return open_cockpit(options)


HUMANS: dict[str, Callable[[PersonOptions], Person]] = {
    "keyboard": _keyboard,
    "gamepad": _gamepad,
    "wheel": _wheel,
    "web": _web,
}
"""Word -> opens the device and the display; raises UserError where there is none. The libraries
behind them are imported when they are opened."""
