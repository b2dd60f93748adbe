"""Probes: the screen and the hands of a person who drives."""

from __future__ import annotations

import functools
import json
import os
from pathlib import Path
from typing import Any

from edge_runtime.util import UserError
from hil_tests.doctor.check import MissingError, output_of_python

_EVENTS = Path("/dev/input")
_SDL = """
import json, os
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"
os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
import pygame
facts = {"driver": "", "why": "", "controllers": []}
try:
    pygame.display.init()
    facts["driver"] = pygame.display.get_driver()
except pygame.error as error:
    facts["why"] = str(error)
pygame.joystick.init()
for number in range(pygame.joystick.get_count()):
    stick = pygame.joystick.Joystick(number)
    facts["controllers"].append(f"{stick.get_name()} ({stick.get_numaxes()} axes)")
print(json.dumps(facts))
"""


def rerun_viewer() -> str:
    """Rerun's viewer comes up without a screen, and goes."""
    from hil_tests.pictures.headless import headless_viewer

    try:
        with headless_viewer() as client:
            picture = client.take_screenshot()
    except UserError as error:
        raise MissingError(str(error)) from None
    return f"came up and drew a picture of {len(picture) / 1000:.0f} kB"


def window() -> str:
    """SDL opens the display that pygame's window would be on."""
    facts = _sdl()
    if facts["driver"] in ("", "dummy", "offscreen"):
        shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        where = f"display {shown}" if shown else "neither DISPLAY nor WAYLAND_DISPLAY is set"
        raise MissingError(f"SDL opens no window ({where})")
    return f"SDL's driver {facts['driver']}"


def controller() -> str:
    """SDL sees a gamepad or a steering wheel."""
    found = _sdl()["controllers"]
    if found:
        return ", ".join(found)
    unreadable = [
        str(path)
        for path in [*_EVENTS.glob("event*"), *_EVENTS.glob("js*")]
        if not os.access(path, os.R_OK)
    ]
    if unreadable:
        raise MissingError(f"none that may be read: no right to {', '.join(sorted(unreadable))}")
    raise MissingError("SDL sees no game controller")


# Not functools.cache: an older Python, too, is to hear that it is too old.
@functools.lru_cache(maxsize=None)  # noqa: UP033
def _sdl() -> dict[str, Any]:
    # In a process of its own: a display that is gone may end it.
    facts: dict[str, Any] = json.loads(output_of_python(_SDL).splitlines()[-1])
    return facts
