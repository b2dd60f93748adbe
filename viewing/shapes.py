"""Cars as lines, because rerun's flat boxes cannot be turned. Pure geometry, metres."""

from __future__ import annotations

import math

from viewing.scene import Car, Scene

Point = tuple[float, float]

MARGIN_M = (10.0, 5.0)
"""Ground shown beyond path and cars: along x, along y."""
NEAR_M = 20.0
"""From the path; whoever is farther away comes into the picture when it matters."""


def outline(car: Car) -> list[Point]:
    """Return the closed outline of the oriented box (five points)."""
    ahead, aside = car.length_m / 2, car.width_m / 2
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))
    return [_place(car, sx * ahead, sy * aside) for sx, sy in signs]


def body(car: Car) -> list[Point]:
    """Return the axis which, drawn as wide as the car, fills its outline (with round ends)."""
    reach = max(0.0, (car.length_m - car.width_m) / 2)
    return [_place(car, -reach, 0.0), _place(car, reach, 0.0)]


def windscreen(car: Car) -> list[Point]:
    """Return a bar across the car, before its middle, that tells front from back."""
    ahead, aside = 0.2 * car.length_m, 0.35 * car.width_m
    return [_place(car, ahead, -aside), _place(car, ahead, aside)]


def view_bounds(scene: Scene) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the x and y ranges (m) that show the path, and the cars that are near it now."""
    path = [(point[0], point[1]) for point in scene.path]
    cars = [(car.x, car.y) for car in scene.vehicles]
    ranges = []
    for axis, margin in enumerate(MARGIN_M):
        known = [point[axis] for point in path] or [point[axis] for point in cars] or [0.0]
        low, high = min(known), max(known)
        near = [point[axis] for point in cars if low - NEAR_M < point[axis] < high + NEAR_M]
        ranges.append((min([low, *near]) - margin, max([high, *near]) + margin))
    return ranges[0], ranges[1]


def _place(car: Car, ahead_m: float, aside_m: float) -> Point:
    cos, sin = math.cos(car.heading_rad), math.sin(car.heading_rad)
    return car.x + ahead_m * cos - aside_m * sin, car.y + ahead_m * sin + aside_m * cos
