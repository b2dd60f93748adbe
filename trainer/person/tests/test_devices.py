import re
import textwrap
import time
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge import rerun
from edge_runtime.util import UserError
from trainer.person.coach import Coach, Coaching, Episode, said
from trainer.person.controls import SHIPPED, SHORTEST, Pedal, Steering, read_profile
from trainer.person.devices import (
    COACH_LEFT,
    COACH_WIDTH,
    COLOURS,
    SIZE,
    JoystickHands,
    KeyboardHands,
    Window,
    pygame,
)
from trainer.person.tests.browser import first_view
from trainer.person.tests.people import LET_GO
from trainer.person.tests.virtual_wheel import VirtualWheel, load_sdl

FAILED = Episode(3, "collision", 0.0, 0)
G29 = read_profile(SHIPPED / "g29.toml")


def press(hands, code, down=True):
    hands.handle(pygame.event.Event(pygame.KEYDOWN if down else pygame.KEYUP, key=code))


def test_a_held_key_takes_over_and_its_action_grows_until_the_window_loses_the_focus():
    hands = KeyboardHands("left_turn")
    assert not hands.read(0.0).engaged
    press(hands, pygame.K_DOWN)
    readings = [hands.read(0.1 * period) for period in range(1, 4)]
    assert [r.action for r in readings] == pytest.approx([-0.5, -1.0, -1.0])
    assert all(r.engaged for r in readings)
    press(hands, pygame.K_DOWN, down=False)
    assert hands.read(0.5) == LET_GO
    press(hands, pygame.K_UP)
    assert hands.read(0.6).engaged
    hands.handle(pygame.event.Event(pygame.WINDOWFOCUSLOST))
    assert not hands.read(0.7).engaged


def test_a_tap_between_two_readings_is_not_missed_and_turning_round_does_not_first_undo():
    hands = KeyboardHands("congestion")
    hands.read(0.0)
    for down in (True, False):
        press(hands, pygame.K_LEFT, down)
    reading = hands.read(0.1)
    assert (reading.engaged, reading.action) == (True, pytest.approx(-0.25))
    assert not hands.read(0.2).engaged
    press(hands, pygame.K_RIGHT)
    for period in range(3, 8):
        hands.read(0.1 * period)
    press(hands, pygame.K_RIGHT, down=False)
    press(hands, pygame.K_LEFT)
    assert hands.read(0.8).action == pytest.approx(-0.25)


@pytest.mark.parametrize(
    ("code", "engaged"),
    [(pygame.K_SPACE, True), (pygame.K_LEFT, False)],  # of the other scenario
)
def test_the_space_bar_holds_without_driving_and_other_keys_do_nothing(code, engaged):
    hands = KeyboardHands("left_turn")
    press(hands, code)
    reading = hands.read(0.0)
    assert (reading.engaged, reading.action) == (engaged, 0.0)


@pytest.fixture
def wheel(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    if load_sdl() is None:
        pytest.skip("this pygame has no SDL of its own with virtual joysticks")
    pygame.display.init()
    pygame.joystick.init()
    yield VirtualWheel()
    pygame.quit()


def at_the_wheel(scenario: str) -> Window:
    return Window(JoystickHands(G29, scenario))


def read(device: Window):
    """SDL tells axes on the next look at its devices."""
    device.poll(time.monotonic())
    return device.poll(time.monotonic())


def test_axes_and_buttons_of_a_wheel(wheel):
    assert read(at_the_wheel("left_turn")).action == 0.0, "untouched pedals are not half pressed"
    device = at_the_wheel("congestion")
    wheel.axis(0, 0.25)
    reading = read(device)
    assert reading.action == pytest.approx(1.0, abs=1e-3)
    assert (reading.by_moving, reading.engaged) == (True, False)
    wheel.button(4, True)
    assert read(device).engaged
    wheel.button(9, True)
    wishes = [device.poll(0.0).wishes for _ in range(3)]
    assert wishes.count(frozenset({"pause"})) == 1


def test_a_wheel_that_is_pulled_out_lets_go_and_comes_back(wheel):
    other = msgspec.structs.replace(G29, match="Thrustmaster")
    assert not Window(JoystickHands(other, "left_turn")).present, "another device"
    device = at_the_wheel("congestion")
    wheel.axis(0, 0.25)
    assert read(device).action > 0.9
    wheel.unplug()
    reading = read(device)
    assert (device.present, reading.action, reading.by_moving) == (False, 0.0, False)
    again, third = VirtualWheel(), VirtualWheel()
    read(device)
    assert device.present
    again.axis(0, -0.25)
    assert read(device).action < -0.9
    again.unplug()
    read(device)
    third.axis(0, 0.25)
    assert read(device).action > 0.9, "the other one that fits"


@pytest.fixture
def opened(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")

    def opened(*screen):
        monkeypatch.setattr(pygame.display, "get_desktop_sizes", lambda: [screen])
        return Window(KeyboardHands("left_turn"))

    yield opened
    pygame.quit()


def test_keys_come_to_the_hands_and_to_the_wishes_through_the_window(opened):
    window = opened(1920, 1080)
    for key in (pygame.K_DOWN, pygame.K_q):
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))
    reading = window.poll(0.0)
    assert (reading.engaged, reading.wishes) == (True, {"quit"})


def shown() -> Any:
    return pygame.display.get_surface()


def found(colour):
    """Where a colour is seen in the window, as (left, top, right, bottom)."""
    mask = pygame.mask.from_threshold(shown(), colour, (12, 12, 12, 255))
    boxes = mask.get_bounding_rects()
    assert boxes, "not seen"
    return boxes[0].unionall(boxes[1:])


@pytest.mark.parametrize("screen", [(800, 480), (480, 800), (1024, 600), (3840, 2160)])
def test_all_of_it_is_seen_on_any_screen(opened, screen):
    window = opened(*screen)
    window.show(replace(first_view(), applied_action=1.0, human_action=1.0))
    width, height = pygame.display.get_window_size()
    assert width <= min(screen[0], SIZE[0])
    assert height <= min(screen[1], SIZE[1])
    bar = found(rerun.APPLIED)  # Also the other car's colour, further up.
    assert bar.bottom / height == pytest.approx((400 + 16 + 24 + 2 * 42 + 18) / SIZE[1], abs=0.01)


def test_the_learning_curve_runs_through_the_right_column(opened):
    curve = [(1.0, 0.2), (29.0, 0.9)]
    coach = Coaching("Watch only.", "29 s at the wheel", "90%", curve, [], 29.0, [FAILED])
    opened(1920, 1080).show(replace(first_view(), control="human", policy_action=0, coach=coach))
    line = found(rerun.POLICY)
    assert line.left >= COACH_LEFT
    assert line.width == pytest.approx(28 / 30 * COACH_WIDTH, abs=6)


def test_the_learning_curve_leaves_the_words_above_it_alone(opened):
    cost = {"human_s": 129.0, "takeovers": 12, "failures": 13}
    words = said(cost, [(42.0, 0.9)], [(22.0, 0.9)])
    coach = Coaching("", words, "90%", [(42.0, 0.9)], [], 129.0, [])
    opened(1920, 1080).show(replace(first_view(), coach=coach))
    right = shown().subsurface((COACH_LEFT, 0, COACH_WIDTH, 400))
    panel = pygame.mask.from_threshold(right, COLOURS["panel"], (1, 1, 1, 255))
    top = max(panel.get_bounding_rects(), key=lambda box: box.width * box.height).top
    ink = pygame.mask.from_threshold(right, COLOURS["dim"], (60, 60, 60, 255))
    inked = [any(ink.get_at((x, y)) for x in range(COACH_WIDTH)) for y in range(top)]
    lines = sum(now and not before for before, now in pairwise(inked))
    assert lines == 1 + len(textwrap.wrap(words, 36)) == 5


def test_where_nothing_learns_there_is_no_curve(opened):
    coach = Coach()
    coach.episodes.append(FAILED)
    coaching = coach.show({"human_s": 29.0, "takeovers": 2, "failures": 1})
    opened(1920, 1080).show(replace(first_view(), coach=coaching))
    right = shown().subsurface((COACH_LEFT, 0, COACH_WIDTH, 400))
    mask = pygame.mask.from_threshold(right, COLOURS["background"], (1, 1, 1, 255))
    assert mask.count() == right.get_width() * right.get_height()


def test_a_window_that_is_resized_shows_all_of_it_in_its_shape(opened):
    window = opened(1920, 1080)
    pygame.display.set_mode((520, 680), pygame.RESIZABLE)
    window.show(replace(first_view(), human_action=1.0, control="policy"))
    assert found(rerun.HUMAN).width == pytest.approx(200 * 520 / SIZE[0], abs=3)
    assert found(rerun.HUMAN).top > 170, "in the middle"


@pytest.mark.parametrize("control", ["policy", "human", "returning"])
def test_the_car_has_the_colour_of_who_drives(opened, control):
    opened(1920, 1080).show(replace(first_view(), control=control, human_action=0.0))
    car = pygame.surfarray.array3d(shown().subsurface((0, 0, 736, 400)))
    seen = set(map(tuple, car.reshape(-1, 3).tolist()))
    drivers = {rerun.POLICY, rerun.HUMAN, rerun.RETURNING}
    assert seen & drivers == {rerun.BY_NAME[control]}


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


def test_at_rest_nothing_happens_and_at_the_dead_zones_edge_nothing_jumps():
    steering, places = Steering(0, dead_zone=0.2), (-0.2, 0.1, 0.2, 0.21)
    actions = [steering.action(place) for place in places]
    assert actions == pytest.approx([0.0, 0.0, 0.0, 0.0125])
    pad = read_profile(SHIPPED / "gamepad.toml")
    for profile, scenario in product((G29, pad), ("left_turn", "congestion")):
        assert profile.action(scenario, {}) == 0.0
    assert G29.action("left_turn", {2: -1.0, 3: 1.0}) == 1.0
    assert G29.action("left_turn", {2: 1.0, 3: -1.0}) == -1.0
    assert G29.action("congestion", {0: -0.25}) == -1.0


@pytest.mark.parametrize(
    ("found", "wrong", "complaint"),
    [
        ("axis = 0", "axis = -1", "steering.axis"),
        ("axis = 0", 'axis = "x"', "steering.axis"),
        ("axis = 0", "axis = 0\nwheel = 1", "unknown field `wheel`"),
        ("axis = 0", "axis = 0\nleft = 0.5\ncentre = 0.0\nright = 1.0", "centre is not between"),
        ("axis = 1", "axis = 1\nreleased = 1.0", "not 0.02 apart"),
        ('name = "mine"', "", "missing required field `name`"),
        ("hold = [0]", "", "buttons.hold is empty"),
        ("hold = [0]", "hold = [0]\nfly = [1]", "Invalid enum value 'fly'"),
        ('name = "mine"', 'name = "mine"\nrest = 0.5', "rest must be below threshold"),
        ('name = "mine"', 'name = "mine"\ntake_over = "shouting"', "shouting"),
        ("axis = 0", "axis = ", "is no TOML"),
    ],
)
def test_a_wrong_profile_is_one_line(tmp_path, found, wrong, complaint):
    path = tmp_path / "wrong.toml"
    path.write_text(GOOD)
    assert read_profile(path).threshold == 0.15
    path.write_text(GOOD.replace(found, wrong))
    with pytest.raises(UserError, match=f"^.*{path}.*{re.escape(complaint)}.*$"):
        read_profile(path)
