"""Keyboard, gamepad and wheel through SDL (pygame), and the window that shows the drive."""

from __future__ import annotations

import argparse
import math
import os
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pygame
from numpy.typing import NDArray

from bridge.rerun import BY_NAME
from edge_runtime.util import UserError
from trainer.person.coach import Coaching
from trainer.person.controls import SHIPPED, Profile, controls_of, keyboard_of, read_profile
from trainer.person.interface import (
    WISH_HELP,
    WISHES,
    Amount,
    Moving,
    Reading,
    View,
    Wish,
    amount,
    vector,
)
from trainer.scenarios.picture import draw_scene

WISH_KEYS: dict[int, Wish] = {
    pygame.K_p: "pause",
    pygame.K_r: "restart",
    pygame.K_BACKSPACE: "discard",
    pygame.K_ESCAPE: "quit",
    pygame.K_q: "quit",
}
SHIPPED_PROFILES = {"gamepad": SHIPPED / "gamepad.toml", "wheel": SHIPPED / "g29.toml"}
SIZE = (1300, 680)  # The drawn picture's; the window shows it larger or smaller
SCREEN_SHARE = 0.9  # The window takes this much of a small screen: frame and desktop bars need some
SCENE_SIZE = (736, 400)
COACH_LEFT, COACH_WIDTH = 1040, 244
CURVE_HEIGHT = 130
LEAST_S = 30.0  # Of the human's time, from left to right of the curves
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
"""Drivers that SDL falls back to where there is no screen: it would draw into memory."""
CONTROL_TEXT = {"policy": "the policy drives", "human": "YOU drive", "returning": "handing back"}


def open_keyboard(arguments: argparse.Namespace) -> Window:
    """The keyboard and its window; raises UserError without a screen."""
    return Window(KeyboardHands(arguments.scenario))


def open_joystick(arguments: argparse.Namespace) -> Window:
    """A gamepad or a wheel, with a window.

    Raises UserError: no screen, no such device, or a wrong profile.
    """
    word = arguments.human
    path = Path(arguments.profile or SHIPPED_PROFILES[word])
    profile = read_profile(path)
    window = Window(JoystickHands(profile, arguments.scenario))
    if not window.present:
        there = ", ".join(joystick.get_name() for joystick in joysticks())
        window.close()
        raise UserError(
            f"no {word} that fits the profile {path.name} ({profile.match or 'any'}): "
            f"{f'there is {there}' if there else 'none is plugged in'}; "
            f"`python -m pygame.examples.joystick` shows what to write into a profile of your own"
        )
    return window


def joysticks() -> list[Any]:
    """Everything that is plugged in; SDL's joysticks must have been started."""
    return [pygame.joystick.Joystick(number) for number in range(pygame.joystick.get_count())]


class KeyboardHands:
    """Hold a key to take over and drive; the space bar holds without driving."""

    present = True
    moving = Moving()

    def __init__(self, scenario: str) -> None:
        self._controls = keyboard_of(scenario)
        self.help = self._controls.help
        self._down: set[str] = set()
        self._tapped: set[str] = set()
        """Pressed since the last reading: a tap shorter than a control period counts for one."""
        self._pressed: Amount = 0.0
        self._read_s: float | None = None

    def plug_in(self) -> None:
        """It always is."""

    def handle(self, event: Any) -> None:
        """Follow the keys up and down."""
        if event.type == pygame.KEYDOWN:
            self._down.add(pygame.key.name(event.key))
            self._tapped.add(pygame.key.name(event.key))
        elif event.type == pygame.KEYUP:
            self._down.discard(pygame.key.name(event.key))
        elif event.type == pygame.WINDOWFOCUSLOST:
            self._down.clear()  # The key's release goes to another window.

    def read(self, now_s: float) -> Reading:
        """Engaged while any of the keys is down; the action ramps towards what they say."""
        held = self._down | self._tapped
        self._tapped.clear()
        period_s = self._controls.period_s
        since_s = period_s if self._read_s is None else min(now_s - self._read_s, period_s)
        self._read_s = now_s
        rest, driving = self._controls.rest, held & self._controls.keys.keys()
        if not driving and "space" not in held:
            self._pressed = 0.0
            return Reading(rest)
        target = np.subtract(self._controls.mix(dict.fromkeys(driving, 1.0)), rest)
        # The other direction begins at once, from rest.
        pressed = np.where(target * self._pressed < 0.0, 0.0, self._pressed)
        step = self._controls.rate_per_s * since_s
        self._pressed = amount(pressed + np.clip(target - pressed, -step, step))
        action = amount(np.clip(np.add(rest, self._pressed), -1.0, 1.0))
        return Reading(action=action, engaged=True)


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
            steers = "left" in controls_of(scenario).keys
            how = "turn the wheel" if steers else "press a pedal"
        self.help = f"{profile.name}: {how} to take over"

    @property
    def present(self) -> bool:
        """Whether it is plugged in."""
        return self._joystick is not None

    def plug_in(self) -> None:
        """Take the first device that the profile fits, if there is one."""
        for joystick in joysticks():
            if self._profile.match.lower() in joystick.get_name().lower():
                self._joystick, self._instance = joystick, joystick.get_instance_id()
                return

    def handle(self, event: Any) -> None:
        """Follow axes, buttons and plugs."""
        if event.type == pygame.JOYDEVICEADDED and not self.present:
            self.plug_in()
        elif not self.present or getattr(event, "instance_id", None) != self._instance:
            return
        elif event.type == pygame.JOYAXISMOTION:
            self._places[event.axis] = float(event.value)
        elif event.type == pygame.JOYBUTTONDOWN:
            buttons = self._profile.buttons
            self._wishes |= {wish for wish in WISHES if event.button in buttons.get(wish, ())}
        elif event.type == pygame.JOYDEVICEREMOVED:
            self._joystick = None
            self._places.clear()
            self.plug_in()  # another one that fits

    def read(self, now_s: float) -> Reading:
        """What axes and buttons say; nothing of a device that is gone."""
        if self._joystick is None:
            return Reading(controls_of(self._scenario).rest)
        # Asking for a button that the device does not have is an error in SDL.
        count = self._joystick.get_numbuttons()
        holding = [number for number in self._profile.buttons.get("hold", ()) if number < count]
        held = any(self._joystick.get_button(number) for number in holding)
        wishes, self._wishes = frozenset(self._wishes), set()
        action = self._profile.action(self._scenario, self._places)
        return Reading(action, held, wishes, by_moving=self._profile.take_over == "moving")


class Window:
    """A person before a window: hands on a device, and the window's keys for the wishes.

    Closing the window is quitting.

    Raises UserError: there is no screen to open it on.
    """

    def __init__(self, hands: KeyboardHands | JoystickHands) -> None:
        try:
            with _quiet_stderr():
                pygame.display.init()
                driver = pygame.display.get_driver()
                if driver in UNSEEN and "SDL_VIDEODRIVER" not in os.environ:
                    raise pygame.error(f"SDL would draw {driver}")
                pygame.joystick.init()
                pygame.font.init()
                width, height = pygame.display.get_desktop_sizes()[0]
                room = min(SCREEN_SHARE * width, SIZE[0]), min(SCREEN_SHARE * height, SIZE[1])
                size = _fitted(SIZE, room).size
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
        hands.plug_in()
        self._hands, self.moving = hands, hands.moving
        self.help: tuple[str, ...] = (hands.help, WISH_HELP)

    @property
    def present(self) -> bool:
        """Whether the device is there."""
        return self._hands.present

    def poll(self, now_s: float) -> Reading:
        """Take what SDL has heard since the last call."""
        wishes: set[Wish] = set()
        for event in pygame.event.get():
            self._hands.handle(event)
            if event.type == pygame.QUIT:
                wishes.add("quit")
            elif event.type == pygame.KEYDOWN and event.key in WISH_KEYS:
                wishes.add(WISH_KEYS[event.key])
        reading = self._hands.read(now_s)
        return Reading(reading.action, reading.engaged, reading.wishes | wishes, reading.by_moving)

    def show(self, view: View) -> None:
        """Draw everything anew."""
        self._screen.fill(COLOURS["background"])
        self._scene(view)
        self._frames(view)
        self._state(view)
        self._bars(view)
        self._coach(view.coach)
        for row, line in enumerate((*self.help, view.progress)):
            colour = "text" if row < len(self.help) else "dim"
            self._text(line, (MARGIN, 588 + 21 * row), colour)
        place = _fitted(SIZE, self._window.get_size())
        drawn = self._screen
        if place.size != SIZE:
            drawn = pygame.transform.smoothscale(drawn, place.size)
        self._window.fill(COLOURS["background"])
        self._window.blit(drawn, place)
        pygame.display.flip()

    def close(self) -> None:
        """Close the window, and SDL with it."""
        pygame.quit()

    def _scene(self, view: View) -> None:
        """The road from above, or what the environment draws."""
        if view.scene is not None:
            shown = draw_scene(view.scene, ego=COLOURS[view.control])
            self._screen.blit(_surface(shown), (0, 0))
        elif view.picture is not None:
            surface = _surface(view.picture)
            size = _fitted(surface.get_size(), SCENE_SIZE).size
            self._screen.blit(pygame.transform.smoothscale(surface, size), (0, 0))

    def _frames(self, view: View) -> None:
        """What the policy sees, the older frame first, where that is two frames."""
        if view.frames is None:
            return
        top = SCENE_SIZE[1] + MARGIN + 22
        for place, (frame, when) in enumerate(zip(view.frames, ("0.1 s ago", "now"), strict=True)):
            large = np.repeat(np.repeat(frame, FRAME_SCALE, axis=0), FRAME_SCALE, axis=1)
            left = MARGIN + place * (large.shape[1] + MARGIN)
            self._text(f"the policy sees, {when}", (left, top - 20), "dim")
            self._screen.blit(_surface(np.repeat(large[:, :, None], 3, axis=2)), (left, top))

    def _state(self, view: View) -> None:
        """The right column: who is in control, and how the drive is going."""
        left, top = SCENE_SIZE[0] + MARGIN, MARGIN
        nobody = view.control == "policy" and view.policy_action is None
        who = "nobody drives" if nobody else CONTROL_TEXT[view.control]
        self._text(who, (left, top), view.control, 38)
        late = f"{view.late_ticks} control periods began late" if view.late_ticks else ""
        speed = "" if math.isnan(view.speed_mps) else f"{view.speed_mps:.1f} m/s"
        way = f"{view.distance_m:.1f} of {view.goal_m:.0f} m"
        for y, line, colour, size in (
            (44, speed, "text", 24),
            (72, "" if math.isnan(view.goal_m) else way, "text", 24),
            (100, f"{view.time_s:.1f} s", "text", 24),
            (128, f"episode {view.episode}, step {view.step}", "text", 24),
            (156, late, "warning", 20),
            (220, "paused: P goes on" if view.paused else view.message, "warning", 24),
        ):
            self._text(line, (left, top + y), colour, size)

    def _bars(self, view: View) -> None:
        """The three actions, one above the other, -1 to 1."""
        left, width = 2 * (MARGIN + 80 * FRAME_SCALE) + 2 * MARGIN, 400
        names = controls_of(view.scenario).names
        top = SCENE_SIZE[1] + MARGIN
        self._text(f"- {', '.join(names)}", (left, top), "dim")
        self._text("+", (left + width, top), "dim", right=True)
        rows = (
            ("policy", view.policy_action or 0.0, "policy"),
            ("you", view.human_action, "human"),
            ("applied", view.applied_action, "applied"),
        )
        for row, (name, action, colour) in enumerate(rows):
            y = top + 24 + 42 * row
            box = pygame.Rect(left, y, width, 18)
            pygame.draw.rect(self._screen, COLOURS["panel"], box)
            values = vector(action).tolist()
            for line, value in enumerate(values):
                reach, high = int(value * width / 2), 18 // len(values)
                place = (left + width // 2 + min(reach, 0), y + line * high)
                pygame.draw.rect(self._screen, COLOURS[colour], (place, (abs(reach), high)))
            bottom = (box.centerx, box.bottom - 1)
            pygame.draw.line(self._screen, COLOURS["dim"], box.midtop, bottom)
            said = " ".join(f"{value:+.2f}" for value in values)
            self._text(f"{name} {said}", (left, y + 20), "dim")

    def _coach(self, coach: Coaching | None) -> None:
        """The column at the right: advice, the policy alone beside what is typical, episodes."""
        if coach is None:
            return
        left, top = COACH_LEFT, MARGIN
        for line in textwrap.wrap(coach.advice, 30):
            self._text(line, (left, top), "text", 24)
            top += 24
        if coach.said:
            top = 140
            for line in (f"policy alone: {coach.alone or '–'}", *textwrap.wrap(coach.said, 36)):
                self._text(line, (left, top), "dim")
                top += 20
            self._curves(coach, pygame.Rect(left, 244, COACH_WIDTH, CURVE_HEIGHT))
        rows = [
            (str(one.number), one.outcome, f"{one.human_s:.1f}", str(one.takeovers))
            for one in reversed(coach.episodes)
        ]
        for row, (number, outcome, human_s, takeovers) in enumerate(
            [("", "", "you, s", "take-overs"), *rows]
        ):
            y = 408 + 19 * row
            self._text(outcome, (left + 36, y), "text")
            for cell, end in ((number, 26), (human_s, 154), (takeovers, COACH_WIDTH)):
                self._text(cell, (left + end, y), "dim", right=True)

    def _curves(self, coach: Coaching, box: pygame.Rect) -> None:
        """Success by the human's seconds; the upright line is where the person is."""
        pygame.draw.rect(self._screen, COLOURS["panel"], box)
        xs = [x for x, _ in (*coach.curve, *coach.typical)]
        end_s = max(LEAST_S, coach.human_s, *xs)
        wide, high = box.width - 2, box.height - 4
        now = box.left + coach.human_s / end_s * wide
        pygame.draw.line(self._screen, COLOURS["human"], (now, box.top), (now, box.bottom - 1))
        self._text(f"{end_s:.0f} s of you", (box.right, box.bottom + 4), "dim", right=True)
        for curve, colour, name, place in (
            (coach.curve, "policy", "alone", 0),
            (coach.typical, "dim", "typical", 50),
        ):
            self._text(name * bool(curve), (box.left + place, box.bottom + 4), colour)
            places = [(box.left + x / end_s * wide, box.bottom - 2 - y * high) for x, y in curve]
            if len(places) > 1:
                pygame.draw.lines(self._screen, COLOURS[colour], False, places, 2)
            elif places:
                pygame.draw.circle(self._screen, COLOURS[colour], places[0], 3)

    def _text(
        self, text: str, place: tuple[int, int], colour: str, size: int = 20, right: bool = False
    ) -> None:
        drawn = self._fonts[size].render(text, True, COLOURS[colour])
        x, y = place
        self._screen.blit(drawn, (x - drawn.get_width() if right else x, y))


def _surface(picture: NDArray[np.uint8]) -> Any:
    """A picture uint8 [height, width, 3] as pygame has it."""
    height, width = picture.shape[:2]
    return pygame.image.frombuffer(picture.tobytes(), (width, height), "RGB")


def _fitted(shape: tuple[int, int], room: tuple[float, float]) -> Any:
    """The largest rectangle of that shape in the middle of the room; both are width and height."""
    return pygame.Rect((0, 0), shape).fit((0, 0), room)


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Drop what any thread writes to stderr meanwhile: without a screen, SDL writes many lines."""
    if sys.stderr is None:  # It is closed anyway.
        yield
        return
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
