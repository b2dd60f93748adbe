import re
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.util import UserError
from trainer.person.controls import SHIPPED, SHORTEST, Pedal, Steering, read_profile

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
    g29, pad = (read_profile(SHIPPED / name) for name in ("g29.toml", "gamepad.toml"))
    for profile, scenario in product((g29, pad), ("left_turn", "congestion")):
        assert profile.action(scenario, {}) == 0.0
    assert g29.action("left_turn", {2: -1.0, 3: 1.0}) == 1.0
    assert g29.action("left_turn", {2: 1.0, 3: -1.0}) == -1.0
    assert g29.action("congestion", {0: -0.25}) == -1.0


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
