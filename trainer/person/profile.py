"""What the axes and buttons of a wheel or gamepad mean: a TOML file, and asking for its values."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError, read_toml
from trainer.person.interface import Moving

SHIPPED = Path(__file__).parent / "profiles"
Number = Annotated[int, msgspec.Meta(ge=0, le=63)]
Place = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
"""Where an axis is; SDL's go from -1 to 1."""
SHORTEST = 0.02
"""The least way of a wheel or pedal: its noise must not be a full action."""
DeadZone = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]
MOVED = 0.2
"""How far an axis must go to be the one that was asked for."""
STEADY, STEADY_S = 0.02, 0.7
"""How still it must then be held, and for how long."""
FIRST_S = 2.0
"""For pressing and turning everything once."""
LOOK_S = 0.02
PATIENCE_S = 60.0
"""How long a question is asked."""
Say = Callable[[str], None]


class Steering(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An axis that rests in its middle."""

    axis: Number
    left: Place = -1.0
    """Where the action is -1. Short of the axis' end where a hand should not turn that far; the
    larger of the two where the axis runs the other way round."""
    centre: Place = 0.0
    right: Place = 1.0
    dead_zone: DeadZone = 0.02
    """Share of the way from the centre in which nothing happens."""

    def __post_init__(self) -> None:
        if not (self.left < self.centre < self.right or self.left > self.centre > self.right):
            raise ValueError("centre is not between left and right")
        if min(abs(self.left - self.centre), abs(self.right - self.centre)) < SHORTEST:
            raise ValueError(f"left and right are not {SHORTEST} from centre")

    def action(self, place: float) -> float:
        """The steering in [-1, 1] for the axis' place; no jump at the dead zone's edge."""
        side = self.right if (place - self.centre) * (self.right - self.centre) > 0 else self.left
        share = _beyond((place - self.centre) / (side - self.centre), self.dead_zone)
        return share if side == self.right else -share


class Pedal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An axis that rests at one end."""

    axis: Number
    released: Place = -1.0
    pressed: Place = 1.0
    dead_zone: DeadZone = 0.05

    def __post_init__(self) -> None:
        if abs(self.released - self.pressed) < SHORTEST:
            raise ValueError(f"released and pressed are not {SHORTEST} apart")

    def action(self, place: float) -> float:
        """How far it is pressed, in [0, 1]."""
        way = (place - self.released) / (self.pressed - self.released)
        return _beyond(way, self.dead_zone)


class Buttons(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Button numbers; any of a list will do."""

    hold: tuple[Number, ...] = ()
    pause: tuple[Number, ...] = ()
    restart: tuple[Number, ...] = ()
    discard: tuple[Number, ...] = ()
    quit: tuple[Number, ...] = ()


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One model of wheel or gamepad."""

    name: str
    steering: Steering
    throttle: Pedal
    brake: Pedal
    match: str = ""
    """What the device's name, as SDL gives it, contains; empty: whatever is plugged in."""
    take_over: Literal["holding", "moving"] = "holding"
    """By a button of ``buttons.hold`` alone, or by moving the wheel or a pedal, too."""
    threshold: Share = Moving.threshold
    rest: Share = Moving.rest
    rest_s: Annotated[float, msgspec.Meta(gt=0.0, le=10.0)] = Moving.rest_s
    buttons: Buttons = Buttons()

    def __post_init__(self) -> None:
        if self.rest >= self.threshold:
            raise ValueError("rest must be below threshold")
        if self.take_over == "holding" and not self.buttons.hold:
            raise ValueError("take_over is by holding, but buttons.hold is empty")

    @property
    def moving(self) -> Moving:
        """What counts as moving."""
        return Moving(self.threshold, self.rest, self.rest_s)

    def action(self, scenario: str, places: dict[int, float]) -> float:
        """The scenario's action from the axes' places; an axis not in ``places`` is at rest."""
        if scenario == "congestion":
            return self._of(self.steering, places, self.steering.centre)
        throttle = self._of(self.throttle, places, self.throttle.released)
        return throttle - self._of(self.brake, places, self.brake.released)

    @staticmethod
    def _of(axis: Steering | Pedal, places: dict[int, float], at_rest: float) -> float:
        return axis.action(places.get(axis.axis, at_rest))


def read_profile(path: Path) -> Profile:
    """Read a profile.

    Raises:
        UserError: no such file, no TOML, or no profile; one line says where.
    """
    values = read_toml(path, "profile")
    try:
        return msgspec.convert(values, Profile)
    except msgspec.ValidationError as error:
        raise UserError(f"profile {path}: {error}") from None


def _beyond(share: float, dead_zone: float) -> float:
    """The share of the way beyond the dead zone, in [0, 1]."""
    return min(max((share - dead_zone) / (1.0 - dead_zone), 0.0), 1.0)


@dataclass(frozen=True)
class Found:
    """An axis, and where it was held."""

    axis: int
    place: float


class Questions:
    """What is asked of the person, about one device.

    Args:
        joystick: pygame's.
        pump: lets SDL look at its devices.
        say: tells the person what to do.
    """

    def __init__(self, joystick: Any, pump: Callable[[], None], say: Say) -> None:
        self._joystick, self._pump, self._say = joystick, pump, say

    def at_rest(self) -> list[float]:
        """Where all axes are when nobody touches them. UserError: it has none."""
        if not self._joystick.get_numaxes():
            raise UserError(f"{self._joystick.get_name()} has no axes to calibrate")
        self._say("Press every pedal and turn the wheel once, then let go of everything.")
        time.sleep(FIRST_S)
        self._until(lambda: self._still() or None)
        return self._places()

    def axis(self, rest: list[float], what: str) -> Found:
        """Which axis is held away from ``rest``, and where."""
        self._say(what)

        def held() -> Found | None:
            places = self._places()
            away = [abs(here - there) for here, there in zip(places, rest, strict=True)]
            number = max(range(len(away)), key=away.__getitem__)
            return Found(number, places[number]) if away[number] > MOVED and self._still() else None

        found = self._until(held)
        self._say("  and let go.")
        self._until(lambda: abs(self._places()[found.axis] - rest[found.axis]) < MOVED or None)
        return found

    def button(self, what: str) -> int:
        """Which button is pressed."""
        self._say(what)

        def pressed() -> int | None:
            down = [
                b for b in range(self._joystick.get_numbuttons()) if self._joystick.get_button(b)
            ]
            return down[0] if down else None

        return self._until(pressed)

    def _still(self) -> bool:
        """Whether all axes stay where they are for a while."""
        before, end_s = self._places(), time.monotonic() + STEADY_S
        while time.monotonic() < end_s:
            time.sleep(LOOK_S)
            now = self._places()
            if any(abs(a - b) > STEADY for a, b in zip(now, before, strict=True)):
                return False
        return True

    def _places(self) -> list[float]:
        self._pump()
        return [self._joystick.get_axis(axis) for axis in range(self._joystick.get_numaxes())]

    def _until(self, answer: Callable[[], Any]) -> Any:
        """The first answer that is not None."""
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            self._pump()
            given = answer()
            if given is not None:
                return given
            time.sleep(LOOK_S)
        raise UserError("nothing was pressed for a minute; no profile was written")


def ask(questions: Questions, name: str) -> str:
    """The profile, as TOML, from the answers."""
    rest = questions.at_rest()
    left = questions.axis(rest, "Turn LEFT as far as full steering is to be, and hold.")
    right = questions.axis(rest, "Turn RIGHT as far, and hold.")
    if left.axis != right.axis:
        raise UserError(f"left was axis {left.axis}, right axis {right.axis}: begin again")
    throttle = questions.axis(rest, "Press the THROTTLE fully, and hold.")
    brake = questions.axis(rest, "Press the BRAKE fully, and hold.")
    hold = questions.button("Press the button that is to take over while it is held.")
    shown = name.replace("\\", "\\\\").replace('"', '\\"')
    return "\n".join(
        [
            "# Written by `python -m trainer drive --calibrate`.",
            f'name = "{shown}"',
            f'match = "{shown}"',
            'take_over = "moving"  # or "holding": a button of buttons.hold alone',
            "",
            "[steering]",
            f"axis = {left.axis}",
            f"left = {left.place:.3f}",
            f"centre = {rest[left.axis]:.3f}",
            f"right = {right.place:.3f}",
            "dead_zone = 0.03",
            *_pedal("throttle", throttle, rest),
            *_pedal("brake", brake, rest),
            "",
            "[buttons]",
            f"hold = [{hold}]",
            "",
        ]
    )


def calibrate(word: str, out: Path) -> None:
    """Ask on the terminal, about the first device there is, and write the profile.

    Raises:
        UserError: no device, no answer, or a file that cannot be written.
    """
    check_writable(out)
    # Axes are read without a window, too, but not without SDL's video.
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from trainer.person.devices import pygame

    pygame.display.init()
    pygame.joystick.init()
    try:
        if not pygame.joystick.get_count():
            raise UserError(f"no {word} is plugged in")
        joystick = pygame.joystick.Joystick(0)
        questions = Questions(joystick, pygame.event.pump, lambda line: print(line, flush=True))
        print(f"{joystick.get_name()}:")
        write_atomic(out, ask(questions, joystick.get_name()).encode())
    finally:
        pygame.quit()
    print(out)


def _pedal(name: str, found: Found, rest: list[float]) -> list[str]:
    return [
        "",
        f"[{name}]",
        f"axis = {found.axis}",
        f"released = {rest[found.axis]:.3f}",
        f"pressed = {found.place:.3f}",
        "dead_zone = 0.05",
    ]
