import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.scenarios.left_turn import LeftTurnPath
from trainer.scenarios.picture import Rectangle, corners, overlap

CAR = Rectangle(0.0, 0.0, 0.0, 5.0, 2.0)


@pytest.mark.parametrize(
    ("other", "touching"),
    [
        (Rectangle(4.9, 0.0, 0.0, 5.0, 2.0), True),
        (Rectangle(5.1, 0.0, 0.0, 5.0, 2.0), False),
        (Rectangle(0.0, 2.1, 0.0, 5.0, 2.0), False),
        (Rectangle(3.4, 0.0, math.pi / 2, 5.0, 2.0), True),
        (Rectangle(3.6, 0.0, math.pi / 2, 5.0, 2.0), False),
        # Bounding boxes overlap, the cars do not: only the slanted axis tells.
        (Rectangle(4.0, 3.1, math.pi / 4, 5.0, 2.0), False),
    ],
)
def test_overlap_by_hand(other, touching):
    assert overlap(CAR, other) is touching


rectangles = st.builds(
    Rectangle,
    st.floats(-6, 6),
    st.floats(-6, 6),
    st.floats(-4, 4),
    st.floats(0.5, 6),
    st.floats(0.5, 3),
)


def _contains(shape: Rectangle, points: np.ndarray) -> np.ndarray:
    cos, sin = math.cos(shape.heading), math.sin(shape.heading)
    dx, dy = points[:, 0] - shape.x, points[:, 1] - shape.y
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    return (np.abs(along) < shape.length / 2) & (np.abs(across) < shape.width / 2)


@settings(max_examples=200, deadline=None)
@given(rectangles, rectangles)
def test_overlap_is_symmetric_and_agrees_with_sampled_points(a, b):
    assert overlap(a, b) == overlap(b, a)
    grid = np.linspace(-0.5, 0.5, 21)
    u, v = (axis.ravel() for axis in np.meshgrid(grid * a.length, grid * a.width))
    cos, sin = math.cos(a.heading), math.sin(a.heading)
    inside_a = np.stack([a.x + u * cos - v * sin, a.y + u * sin + v * cos], axis=1)
    if _contains(b, inside_a).any():
        assert overlap(a, b)


def test_corners_keep_length_and_width():
    points = corners(Rectangle(1.0, 2.0, 0.7, 5.0, 2.0))
    sides = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    assert sorted(sides) == pytest.approx([2.0, 2.0, 5.0, 5.0])


path = LeftTurnPath((2.0, 14.0), straight_m=10.0, radius_m=6.0)


@given(st.floats(0, 30), st.floats(-2, 2))
def test_projection_inverts_the_pose(s_m, right_m):
    pose = path.pose(s_m)
    x = pose.x - right_m * math.sin(pose.heading)
    y = pose.y + right_m * math.cos(pose.heading)
    assert path.project(x, y) == pytest.approx((s_m, right_m), abs=1e-9)


def test_the_path_is_smooth_and_turns_left_by_a_quarter():
    poses = [path.pose(s) for s in np.arange(0, 25, 0.01)]
    steps = [math.hypot(b.x - a.x, b.y - a.y) for a, b in itertools.pairwise(poses)]
    assert steps == pytest.approx([0.01] * len(steps), rel=1e-3)
    assert poses[0].heading - poses[-1].heading == pytest.approx(math.pi / 2)
    assert (poses[-1].x, poses[-1].y) == pytest.approx((-4 - 5.57, -2.0), abs=0.02)


def test_highway_lanes_follow_the_path():
    s_m = 0.0
    for lane in path.lanes(end_m=21.0, width_m=4.0):
        middle = lane.position(0.5 * lane.length, 0.0)
        pose = path.pose(s_m + 0.5 * lane.length)
        assert tuple(middle) == pytest.approx((pose.x, pose.y), abs=1e-6)
        s_m += lane.length
    assert s_m == pytest.approx(21.0)
