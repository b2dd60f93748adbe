"""The window: the scene from above, what the policy sees, and who does what."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pygame
from numpy.typing import NDArray

from bridge.rerun import BY_NAME
from edge_runtime.util import UserError
from trainer.person.interface import View
from trainer.scenarios.picture import draw_scene

SIZE = (1040, 680)
"""The drawn picture's; the window shows it larger or smaller."""
SCREEN_SHARE = 0.9
"""The window takes this much of a small screen: frame and desktop bars need some."""
SCENE_SIZE = (736, 400)
FRAME_SCALE = 3
MARGIN = 16
COLOURS = {
    "background": (24, 27, 32),
    "panel": (36, 41, 48),
    "text": (232, 234, 237),
    "dim": (150, 157, 166),
    **BY_NAME,
    "warning": (255, 110, 100),
}
UNSEEN = ("offscreen", "dummy", "evdev")
"""Drivers that SDL takes by itself where nobody could see anything: it would draw into memory."""
CONTROL_TEXT = {"policy": "the policy drives", "human": "YOU drive", "returning": "handing back"}


def _fitted(width: float, height: float) -> tuple[int, int]:
    """The largest size of the picture's shape that fits."""
    scale = min(width / SIZE[0], height / SIZE[1])
    return max(int(SIZE[0] * scale), 1), max(int(SIZE[1] * scale), 1)


class Window:
    """A window of SDL's.

    Raises:
        UserError: there is no screen to open it on.
    """

    def __init__(self) -> None:
        try:
            with _quiet_stderr():
                pygame.display.init()
                driver = pygame.display.get_driver()
                if driver in UNSEEN and "SDL_VIDEODRIVER" not in os.environ:
                    raise pygame.error(f"SDL would draw {driver}")
                pygame.joystick.init()
                pygame.font.init()
                width, height = pygame.display.get_desktop_sizes()[0]
                size = _fitted(
                    min(SCREEN_SHARE * width, SIZE[0]), min(SCREEN_SHARE * height, SIZE[1])
                )
                self._window = pygame.display.set_mode(size, pygame.RESIZABLE)
        except pygame.error as error:
            pygame.quit()
            raise UserError(
                f"no window can be opened ({error}): there is no screen here, or DISPLAY does not "
                "name it; --human web needs none"
            ) from None
        pygame.display.set_caption("PHIL-TD3: at the wheel")
        self._screen = pygame.Surface(SIZE)
        self._fonts = {size: pygame.font.Font(None, size) for size in (20, 24, 38)}

    def show(self, view: View) -> None:
        """Draw everything anew."""
        if not pygame.display.get_init():
            return
        self._screen.fill(COLOURS["background"])
        self._blit(draw_scene(view.scene, ego=COLOURS[view.control]), (0, 0))
        self._frames(view)
        self._state(view)
        self._bars(view)
        for row, line in enumerate((*view.help, view.progress)):
            colour = "text" if row < len(view.help) else "dim"
            self._text(line, (MARGIN, 588 + 21 * row), colour)
        room = self._window.get_size()
        size = _fitted(*room)
        drawn = self._screen
        if size != SIZE:
            drawn = pygame.transform.smoothscale(drawn, size)
        self._window.fill(COLOURS["background"])
        self._window.blit(drawn, ((room[0] - size[0]) // 2, (room[1] - size[1]) // 2))
        pygame.display.flip()

    def close(self) -> None:
        """Close the window, and SDL with it."""
        pygame.quit()

    def _frames(self, view: View) -> None:
        """What the policy sees, the older frame first."""
        top = SCENE_SIZE[1] + MARGIN + 22
        for place, (frame, when) in enumerate(zip(view.frames, ("0.1 s ago", "now"), strict=True)):
            large = np.repeat(np.repeat(frame, FRAME_SCALE, axis=0), FRAME_SCALE, axis=1)
            left = MARGIN + place * (large.shape[1] + MARGIN)
            self._text(f"the policy sees, {when}", (left, top - 20), "dim")
            self._blit(np.repeat(large[:, :, None], 3, axis=2), (left, top))

    def _state(self, view: View) -> None:
        """The right column: who is in control, and how the drive is going."""
        left, top = SCENE_SIZE[0] + MARGIN, MARGIN
        nobody = view.control == "policy" and view.policy_action is None
        who = "nobody drives" if nobody else CONTROL_TEXT[view.control]
        self._text(who, (left, top), view.control, 38)
        lines = (
            f"{view.speed_mps:.1f} m/s",
            f"{view.distance_m:.1f} of {view.goal_m:.0f} m",
            f"{view.time_s:.1f} s",
            f"episode {view.episode}, step {view.step}",
        )
        for row, line in enumerate(lines):
            self._text(line, (left, top + 44 + 28 * row), "text", 24)
        if view.late_ticks:
            late = f"{view.late_ticks} control periods began late"
            self._text(late, (left, top + 44 + 28 * len(lines)), "warning")
        message = "paused: P goes on" if view.paused else view.message
        self._text(message, (left, top + 220), "warning", 24)

    def _bars(self, view: View) -> None:
        """The three actions, one above the other, -1 to 1."""
        left, width = 2 * (MARGIN + 80 * FRAME_SCALE) + 2 * MARGIN, 400
        words = ("left", "right") if view.scenario == "congestion" else ("brake", "throttle")
        top = SCENE_SIZE[1] + MARGIN
        self._text(words[0], (left, top), "dim")
        self._text(words[1], (left + width, top), "dim", right=True)
        rows = (
            ("policy", view.policy_action or 0.0, "policy"),
            ("you", view.human_action, "human"),
            ("applied", view.applied_action, "applied"),
        )
        for row, (name, action, colour) in enumerate(rows):
            y = top + 24 + 42 * row
            box = pygame.Rect(left, y, width, 18)
            pygame.draw.rect(self._screen, COLOURS["panel"], box)
            reach = int(action * width / 2)
            bar = pygame.Rect(left + width // 2 + min(reach, 0), y, abs(reach), 18)
            pygame.draw.rect(self._screen, COLOURS[colour], bar)
            bottom = (box.centerx, box.bottom - 1)
            pygame.draw.line(self._screen, COLOURS["dim"], box.midtop, bottom)
            self._text(f"{name} {action:+.2f}", (left, y + 20), "dim")

    def _text(
        self, text: str, place: tuple[int, int], colour: str, size: int = 20, right: bool = False
    ) -> None:
        drawn = self._fonts[size].render(text, True, COLOURS[colour])
        x, y = place
        self._screen.blit(drawn, (x - drawn.get_width() if right else x, y))

    def _blit(self, picture: NDArray[np.uint8], place: tuple[int, int]) -> None:
        """Put a picture uint8 [height, width, 3] on the screen."""
        height, width = picture.shape[:2]
        surface: Any = pygame.image.frombuffer(picture.tobytes(), (width, height), "RGB")
        self._screen.blit(surface, place)


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Drop what is written to stderr meanwhile, by any thread: keep it short.

    SDL and what it tries say more than one line where there is no screen; ours says it all.
    """
    sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # It was closed, and nobody would read it.
        yield
        return
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
