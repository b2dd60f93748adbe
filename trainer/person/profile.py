"""What the axes and buttons of a wheel or gamepad mean: a TOML file, and asking for its values."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec

from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError, read_toml
from trainer.person.interface import Moving, Wish

SHIPPED = Path(__file__).parent / "profiles"
Number = Annotated[int, msgspec.Meta(ge=0, le=63)]
Place = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
"""Of an axis, as SDL gives it."""
SHORTEST = 0.02
"""The shortest travel of a wheel or pedal: its noise must not be a full action."""
DeadZone = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
Share = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]


class Steering(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An axis that rests in its middle."""

    axis: Number
    left: Place = -1.0
    """Where the action is -1: before the axis' end, where a hand should not turn that far. It is
    larger than ``right`` where the axis is reversed."""
    centre: Place = 0.0
    right: Place = 1.0
    dead_zone: DeadZone = 0.02
    """The share of the way from the centre in which nothing happens."""

    def __post_init__(self) -> None:
        if not (self.left < self.centre < self.right or self.left > self.centre > self.right):
            raise ValueError("centre is not between left and right")
        if min(abs(self.left - self.centre), abs(self.right - self.centre)) < SHORTEST:
            raise ValueError(f"left and right are not {SHORTEST} from centre")

    def action(self, place: float) -> float:
        """The steering in [-1, 1] for the axis' place; no jump at the dead zone's edge."""
        right, left = (
            _share(place, self.centre, side, self.dead_zone) for side in (self.right, self.left)
        )
        return right - left


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
        return _share(place, self.released, self.pressed, self.dead_zone)


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
    buttons: dict[Literal["hold"] | Wish, tuple[Number, ...]] = {}
    """Button numbers; any of a list will do."""

    def __post_init__(self) -> None:
        if self.rest >= self.threshold:
            raise ValueError("rest must be below threshold")
        if self.take_over == "holding" and not self.buttons.get("hold"):
            raise ValueError("take_over is by holding, but buttons.hold is empty")

    def action(self, scenario: str, places: dict[int, float]) -> float:
        """The scenario's action from the axes' places; an axis not in ``places`` is at rest."""
        if scenario == "congestion":
            return self.steering.action(places.get(self.steering.axis, self.steering.centre))
        throttle, brake = (
            pedal.action(places.get(pedal.axis, pedal.released))
            for pedal in (self.throttle, self.brake)
        )
        return throttle - brake


def read_profile(path: Path) -> Profile:
    """Read a profile; UserError where there is none, or it is wrong: one line says where."""
    values = read_toml(path, "profile")
    try:
        return msgspec.convert(values, Profile)
    except msgspec.ValidationError as error:
        raise UserError(f"profile {path}: {error}") from None


def _share(place: float, start: float, end: float, dead_zone: float) -> float:
    """The share of the way from start to end, beyond the dead zone, in [0, 1]."""
    way = (place - start) / (end - start)
    return min(max((way - dead_zone) / (1.0 - dead_zone), 0.0), 1.0)


MOVED = 0.2
"""How far an axis must go to be the one that was asked for."""
STEADY, STEADY_S = 0.02, 0.7
"""How still it must then be held, and for how long."""
FIRST_S = 2.0
"""For pressing and turning everything once."""
LOOK_S = 0.02
PATIENCE_S = 60.0
"""How long a question is asked."""
Answer = TypeVar("Answer")
WRITTEN = """\
# Written by `python -m trainer drive --calibrate`.
name = {name}
match = {name}
take_over = "moving"  # or "holding": a button of buttons.hold alone

[steering]
axis = {left.axis}
left = {left.place:.3f}
centre = {left.rest:.3f}
right = {right.place:.3f}
dead_zone = 0.03

[throttle]
axis = {throttle.axis}
released = {throttle.rest:.3f}
pressed = {throttle.place:.3f}
dead_zone = 0.05

[brake]
axis = {brake.axis}
released = {brake.rest:.3f}
pressed = {brake.place:.3f}
dead_zone = 0.05

[buttons]
hold = [{hold}]
"""


class Found(NamedTuple):
    """An axis, where it was held, and where it rests."""

    axis: int
    place: float
    rest: float


def calibrate(word: str, out: Path) -> None:
    """Ask on the terminal about the first device there is, and write the profile.

    Raises:
        UserError: no device, no answer, or a file that cannot be written.
    """
    check_writable(out)
    # Axes are read without a window, too, but not without SDL's video.
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from trainer.person.devices import joysticks, pygame

    pygame.display.init()
    pygame.joystick.init()
    try:
        devices = joysticks()
        if not devices:
            raise UserError(f"no {word} is plugged in")
        print(f"{devices[0].get_name()}:")
        profile = ask(devices[0], pygame.event.pump, lambda line: print(line, flush=True))
        write_atomic(out, profile.encode())
    finally:
        pygame.quit()
    print(out)


def ask(joystick: Any, pump: Callable[[], object], say: Callable[[str], None]) -> str:
    """The profile, as TOML, from what the person does with the joystick (pygame's) when told.

    ``pump`` lets SDL look at its devices. UserError: no answer, or a contradictory one.
    """

    def places() -> list[float]:
        pump()
        return [joystick.get_axis(axis) for axis in range(joystick.get_numaxes())]

    def until(answer: Callable[[], Answer | None]) -> Answer:
        """The first answer that is neither None nor False."""
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            given = answer()
            if given is not None and given is not False:
                return given
            time.sleep(LOOK_S)
        raise UserError("nothing was pressed for a minute; no profile was written")

    def still() -> bool:
        """Whether all axes stay where they are for a while."""
        before, end_s = places(), time.monotonic() + STEADY_S
        while time.monotonic() < end_s:
            time.sleep(LOOK_S)
            if any(abs(a - b) > STEADY for a, b in zip(places(), before, strict=True)):
                return False
        return True

    def held() -> Found | None:
        """The axis that is held away from its rest, where it is once it is still."""
        away = [abs(here - there) for here, there in zip(places(), rest, strict=True)]
        axis = max(range(len(away)), key=away.__getitem__)
        if away[axis] <= MOVED or not still():
            return None
        return Found(axis, places()[axis], rest[axis])

    def ask_axis(what: str) -> Found:
        say(what)
        found = until(held)
        say("  and let go.")
        until(lambda: abs(places()[found.axis] - found.rest) < MOVED)
        return found

    def pressed() -> int | None:
        pump()
        return next(filter(joystick.get_button, range(joystick.get_numbuttons())), None)

    name = joystick.get_name()
    if not joystick.get_numaxes():
        raise UserError(f"{name} has no axes to calibrate")
    say("Press every pedal and turn the wheel once, then let go of everything.")
    time.sleep(FIRST_S)
    until(still)
    rest = places()
    left = ask_axis("Turn LEFT as far as full steering is to be, and hold.")
    right = ask_axis("Turn RIGHT as far, and hold.")
    if left.axis != right.axis:
        raise UserError(f"left was axis {left.axis}, right axis {right.axis}: begin again")
    throttle = ask_axis("Press the THROTTLE fully, and hold.")
    brake = ask_axis("Press the BRAKE fully, and hold.")
    say("Press the button that is to take over while it is held.")
    return WRITTEN.format(
        name=json.dumps(name, ensure_ascii=False),  # in TOML a string is written as in JSON
        left=left,
        right=right,
        throttle=throttle,
        brake=brake,
        hold=until(pressed),
    )
