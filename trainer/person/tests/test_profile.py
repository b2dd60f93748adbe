"""Profiles: what they say, and one clear line where they are wrong."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.util import UserError
from trainer.person import profile as calibrate
from trainer.person.devices import pygame
from trainer.person.profile import SHIPPED, SHORTEST, Pedal, Steering, read_profile
from trainer.person.tests.virtual_wheel import VirtualWheel, load_sdl

PLACE = st.floats(-1.0, 1.0)
DEAD_ZONE = st.floats(0.0, 0.9)
GOOD = """
name = "mine"
[steering]
axis = 0
[throttle]
axis = 1
[brake]
axis = 2
[buttons]
hold = [0]
"""


@st.composite
def steerings(draw):
    twentieths = st.lists(st.integers(-20, 20), min_size=3, max_size=3, unique=True)
    places = [place / 20.0 for place in sorted(draw(twentieths))]
    if draw(st.booleans()):
        places.reverse()
    left, centre, right = places
    return Steering(0, left, centre, right, draw(DEAD_ZONE))


@given(steerings(), st.lists(PLACE, min_size=2, max_size=8))
def test_steering_grows_from_left_to_right(steering, places):
    rightwards = sorted(places, reverse=steering.left > steering.right)
    actions = [steering.action(place) for place in rightwards]
    assert actions == sorted(actions)
    assert all(-1.0 <= action <= 1.0 for action in actions)
    ends = [steering.action(at) for at in (steering.left, steering.centre, steering.right)]
    assert ends == pytest.approx([-1.0, 0.0, 1.0])


@given(PLACE, PLACE, DEAD_ZONE, st.floats(0.0, 1.0))
def test_a_pedal_goes_from_nothing_to_all(released, pressed, dead_zone, share):
    if abs(released - pressed) < SHORTEST:
        with pytest.raises(ValueError, match=r"not 0\.02 apart"):
            Pedal(0, released, pressed)
        return
    pedal = Pedal(0, released, pressed, dead_zone)
    assert pedal.action(released) == 0.0
    assert pedal.action(pressed) == 1.0
    assert 0.0 <= pedal.action(released + share * (pressed - released)) <= 1.0


def test_within_the_dead_zone_nothing_happens_and_at_its_edge_nothing_jumps():
    steering = Steering(0, dead_zone=0.2)
    assert [steering.action(place) for place in (-0.2, 0.1, 0.2)] == pytest.approx([0.0, 0.0, 0.0])
    assert steering.action(0.21) == pytest.approx(0.0125)


@pytest.mark.parametrize("name", ["g29.toml", "gamepad.toml"])
def test_what_is_shipped_is_at_rest_at_rest(name):
    profile = read_profile(SHIPPED / name)
    for scenario in ("left_turn", "congestion"):
        assert profile.action(scenario, {}) == 0.0


def test_the_g29s_pedals_and_wheel():
    g29 = read_profile(SHIPPED / "g29.toml")
    assert g29.action("left_turn", {2: -1.0, 3: 1.0}) == 1.0
    assert g29.action("left_turn", {2: 1.0, 3: -1.0}) == -1.0
    assert g29.action("congestion", {0: -0.25}) == -1.0


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("axis = 0", "axis = -1"), "steering.axis"),
        (("axis = 0", 'axis = "x"'), "steering.axis"),
        (("axis = 0", "axis = 0\nwheel = 1"), "unknown field `wheel`"),
        (("axis = 0", "axis = 0\nleft = 0.5\ncentre = 0.0\nright = 1.0"), "centre is not between"),
        (("axis = 1", "axis = 1\nreleased = 1.0"), "not 0.02 apart"),
        (('name = "mine"', ""), "missing required field `name`"),
        (("hold = [0]", ""), "buttons.hold is empty"),
        (('name = "mine"', 'name = "mine"\nrest = 0.5'), "rest must be below threshold"),
        (('name = "mine"', 'name = "mine"\ntake_over = "shouting"'), "shouting"),
        (("axis = 0", "axis = "), "is no TOML"),
    ],
)
def test_a_wrong_profile_is_one_line(tmp_path, change, complaint):
    path = tmp_path / "wrong.toml"
    path.write_text(GOOD.replace(*change))
    with pytest.raises(UserError) as error:
        read_profile(path)
    assert complaint in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_good_one_is_read(tmp_path):
    path = tmp_path / "good.toml"
    path.write_text(GOOD)
    assert read_profile(path).moving.threshold == 0.15


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
