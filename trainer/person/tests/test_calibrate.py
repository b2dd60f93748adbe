"""Calibration asks, a virtual wheel answers."""

from __future__ import annotations

import pytest

from trainer.person import calibrate
from trainer.person.devices import pygame
from trainer.person.profile import read_profile
from trainer.person.tests.virtual_wheel import VirtualWheel, load_sdl


@pytest.fixture
def wheel(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(calibrate, "STEADY_S", 0.05)
    monkeypatch.setattr(calibrate, "FIRST_S", 0.05)
    if load_sdl() is None:
        pytest.skip("this pygame has no SDL of its own with virtual joysticks")
    pygame.display.init()
    pygame.joystick.init()
    wheel = VirtualWheel()
    for pedal in (1, 2):
        wheel.axis(pedal, -1.0)
    yield wheel
    pygame.quit()


ANSWERS = {"LEFT": (0, 0.5, 0.0), "RIGHT": (0, -0.4, 0.0), "THROTTLE": (2, 0.9, -1.0)}


def answering(wheel, answers):
    """Whoever holds an axis while it is asked for, and lets go when told."""
    held = []

    def say(line: str) -> None:
        for word, (axis, place, rest) in answers.items():
            if word in line:
                wheel.axis(axis, place)
                held.append((axis, rest))
        if "let go" in line and held:
            wheel.axis(*held.pop())
        if "button" in line:
            wheel.button(7, True)

    return say


def questions(wheel, answers):
    joystick = pygame.joystick.Joystick(wheel.index)
    return calibrate.Questions(joystick, pygame.event.pump, answering(wheel, answers))


def test_the_answers_become_a_profile(wheel, tmp_path):
    answers = {**ANSWERS, "BRAKE": (1, 1.0, -1.0)}
    path = tmp_path / "mine.toml"
    path.write_text(calibrate.ask(questions(wheel, answers), 'A "quoted" wheel'))
    profile = read_profile(path)
    assert profile.name == 'A "quoted" wheel'
    assert profile.buttons.hold == (7,)
    places = {0: 0.5, 1: -1.0, 2: 0.9}
    assert profile.action("congestion", places) == pytest.approx(-1.0, abs=0.01)
    assert profile.action("congestion", {0: -0.4}) == pytest.approx(1.0, abs=0.01)
    assert profile.action("left_turn", places) == pytest.approx(1.0, abs=0.01)
    assert profile.action("left_turn", {2: -1.0, 1: 1.0}) == pytest.approx(-1.0, abs=0.01)


def test_left_and_right_on_different_axes_is_refused(wheel):
    answers = {**ANSWERS, "RIGHT": (3, 0.5, 0.0)}
    with pytest.raises(calibrate.UserError, match="left was axis 0, right axis 3"):
        calibrate.ask(questions(wheel, answers), "x")


def test_no_answer_ends_it(wheel, monkeypatch):
    monkeypatch.setattr(calibrate, "PATIENCE_S", 0.3)
    with pytest.raises(calibrate.UserError, match="no profile was written"):
        calibrate.ask(questions(wheel, {}), "x")


class Trembling:
    """An axis that is never still until it has moved for a while; each look is a moment."""

    def __init__(self) -> None:
        self.places = [0.5, 0.7, 0.4, 0.6] * 5 + [0.8] * 200

    def look(self) -> None:
        self.places.pop(0)

    def get_numaxes(self) -> int:
        return 1

    def get_axis(self, axis: int) -> float:
        return self.places[0]


def test_an_axis_that_moves_is_waited_for(monkeypatch):
    monkeypatch.setattr(calibrate, "STEADY_S", 0.05)
    hand = Trembling()

    def say(line: str) -> None:
        if "let go" in line:
            hand.places = [0.0] * 100

    found = calibrate.Questions(hand, hand.look, say).axis([0.0], "hold it")
    assert found == calibrate.Found(0, 0.8)
