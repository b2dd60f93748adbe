"""Planar geometry shared by the scenarios: oriented rectangles and their overlap.

Coordinates are highway-env's: x to the right, y **down**, headings clockwise from x, metres
and radians.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Rectangle(NamedTuple):
    """A vehicle's footprint: centre in metres, heading in rad, sides in metres."""

    x: float
    y: float
    heading: float
    length: float
    width: float


def corners(rectangle: Rectangle) -> NDArray[np.float64]:
    """The four corners in order, shape [4, 2], metres."""
    x, y, heading, length, width = rectangle
    cos, sin = math.cos(heading), math.sin(heading)
    along = np.array([0.5, 0.5, -0.5, -0.5]) * length
    across = np.array([0.5, -0.5, -0.5, 0.5]) * width
    return np.stack([x + along * cos - across * sin, y + along * sin + across * cos], axis=1)


def overlap(a: Rectangle, b: Rectangle) -> bool:
    """Whether two rectangles overlap, by the separating axis theorem on their four axes."""
    dx, dy = b.x - a.x, b.y - a.y
    reach = math.hypot(a.length, a.width) + math.hypot(b.length, b.width)
    if dx * dx + dy * dy > 0.25 * reach * reach:
        return False
    cos_between = abs(math.cos(b.heading - a.heading))
    sin_between = abs(math.sin(b.heading - a.heading))
    for one, other in ((a, b), (b, a)):
        cos, sin = math.cos(one.heading), math.sin(one.heading)
        along, across = abs(dx * cos + dy * sin), abs(dy * cos - dx * sin)
        if 2 * along > one.length + other.length * cos_between + other.width * sin_between:
            return False
        if 2 * across > one.width + other.length * sin_between + other.width * cos_between:
            return False
    return True
