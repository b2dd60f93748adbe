import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.scenarios import picture as pictures
from trainer.scenarios.left_turn import LeftTurnPath
from trainer.scenarios.picture import Rectangle

CAR = Rectangle(0.0, 0.0, 0.0, 5.0, 2.0)


@pytest.mark.parametrize(
    ("other", "touching"),
    [
        (Rectangle(4.9, 0.0, 0.0, 5.0, 2.0), True),
        (Rectangle(5.1, 0.0, 0.0, 5.0, 2.0), False),
        (Rectangle(0.0, 2.1, 0.0, 5.0, 2.0), False),
        (Rectangle(3.4, 0.0, math.pi / 2, 5.0, 2.0), True),
        (Rectangle(3.6, 0.0, math.pi / 2, 5.0, 2.0), False),
        # Bounding boxes pictures.overlap, the cars do not: only the slanted axis tells.
        (Rectangle(4.0, 3.1, math.pi / 4, 5.0, 2.0), False),
    ],
)
def test_overlap_by_hand(other, touching):
    assert pictures.overlap(CAR, other) is touching


rectangles = st.builds(
    Rectangle, *(st.floats(*ends) for ends in ((-6, 6), (-6, 6), (-4, 4), (0.5, 6), (0.5, 3)))
)


@settings(max_examples=200)
@given(rectangles, rectangles)
def test_overlap_is_symmetric_and_agrees_with_sampled_points(a, b):
    assert pictures.overlap(a, b) == pictures.overlap(b, a)
    u, v = np.mgrid[-0.5:0.5:21j, -0.5:0.5:21j] * np.array([a.length, a.width])[:, None, None]
    cos, sin = math.cos(a.heading), math.sin(a.heading)
    dx, dy = a.x + u * cos - v * sin - b.x, a.y + u * sin + v * cos - b.y
    cos, sin = math.cos(b.heading), math.sin(b.heading)
    along, across = np.abs(dx * cos + dy * sin), np.abs(dy * cos - dx * sin)
    if ((along < b.length / 2) & (across < b.width / 2)).any():
        assert pictures.overlap(a, b)


path = LeftTurnPath((2.0, 14.0), straight_m=10.0, radius_m=6.0)


@given(st.floats(0, 30), st.floats(-2, 2))
def test_projection_inverts_the_pose(s_m, right_m):
    pose = path.pose(s_m)
    x = pose.x - right_m * math.sin(pose.heading)
    y = pose.y + right_m * math.cos(pose.heading)
    assert path.project(x, y) == pytest.approx((s_m, right_m), abs=1e-9)


view = pictures.Rasteriser(left_m=-20.0, top_m=-11.25, metres_per_pixel=0.5)
roads = [Rectangle(0.0, 0.4, 0.0, 90.0, 7.3), Rectangle(3.0, 9.0, 1.5, 20.0, 8.0)]
paved = pictures.Rasteriser(view.left_m, view.top_m, view.metres_per_pixel, roads)


def _plain_frame(traffic: list[Rectangle], ego: Rectangle) -> np.ndarray:
    """One rectangle after another, each blended into the whole picture."""
    picture = paved.background.copy()
    x = view.left_m + (np.arange(pictures.COLUMNS) + 0.5) * view.metres_per_pixel
    y = view.top_m + (np.arange(pictures.ROWS)[:, None] + 0.5) * view.metres_per_pixel
    for shape, value in [*((car, pictures.TRAFFIC) for car in traffic), (ego, pictures.EGO)]:
        cos, sin = math.cos(shape.heading), math.sin(shape.heading)
        along = np.abs((x - shape.x) * cos + (y - shape.y) * sin)
        across = np.abs((y - shape.y) * cos - (x - shape.x) * sin)
        inside = np.ones_like(along)
        for offset_m, side_m in ((along, shape.length), (across, shape.width)):
            inside *= np.clip((0.5 * side_m - offset_m) / view.metres_per_pixel + 0.5, 0.0, 1.0)
        picture += inside * (value - picture)
    return (picture + 0.5).astype(np.uint8)


def _cars(headings: st.SearchStrategy[float]) -> st.SearchStrategy[Rectangle]:
    """Also outside the picture, across its edges, and into each other: the ego car is on top."""
    sides = st.floats(2.0, 8.0), st.floats(0.8, 2.5)
    return st.builds(Rectangle, st.floats(-26, 26), st.floats(-14, 14), headings, *sides)


straight, turned = _cars(st.just(0.0)), _cars(st.floats(-4, 4))


@given(st.lists(straight, max_size=11) | st.lists(straight | turned, max_size=4), turned)
def test_cars_drawn_at_once_are_to_the_bit_those_drawn_one_after_another(traffic, ego):
    assert np.array_equal(paved.frame(traffic, ego), _plain_frame(traffic, ego))
