"""Pictures of a scene: the 45x80 grey values that the policy sees, and a larger one for people.

Both show oriented rectangles. A pixel of the policy's picture mixes the values of the classes that
cover it by area: a car that moves by a tenth of a pixel changes the picture, so two frames show
speed (eq. 28 stacks two). Drawing takes tens of microseconds.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bridge import rerun as shown
from bridge.rerun import POLICY, Colour


class Rectangle(NamedTuple):
    """A vehicle's footprint: centre in metres, heading in rad, sides in metres."""

    x: float
    y: float
    heading: float
    length: float
    width: float


def corners(rectangle: Rectangle) -> NDArray[np.float64]:
    """Return the four corners in order, shape [4, 2], metres."""
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
    for box, other in ((a, b), (b, a)):
        cos, sin = math.cos(box.heading), math.sin(box.heading)
        along, across = abs(dx * cos + dy * sin), abs(dy * cos - dx * sin)
        if 2 * along > box.length + other.length * cos_between + other.width * sin_between:
            return False
        if 2 * across > box.width + other.length * sin_between + other.width * cos_between:
            return False
    return True


ROWS, COLUMNS = 45, 80
GROUND, ROAD, EGO, TRAFFIC = 0, 70, 150, 255
"""Grey values of the semantic classes, far enough apart for one channel."""


class Rasteriser:
    """Draws rectangles into a picture of a fixed part of the ground; y grows downwards."""

    def __init__(
        self, left_m: float, top_m: float, metres_per_pixel: float, roads: Sequence[Rectangle] = ()
    ) -> None:
        self.left_m, self.top_m = left_m, top_m
        self.metres_per_pixel = metres_per_pixel
        steps_m = (np.arange(COLUMNS) + 0.5) * metres_per_pixel
        self._centres = np.stack([left_m + steps_m, top_m + steps_m])
        """Centres of the columns and rows, m; the rows are padded, so that both fit into one
        array."""
        self.background = np.full((ROWS, COLUMNS), GROUND, dtype=np.float32)
        """The still part of the picture, grey values [45, 80]."""
        for road in roads:
            self.draw(self.background, road, ROAD)
        # float64, as the sums in `_with_traffic` need it.
        self._still = self.background.astype(np.float64)
        self._up_to_traffic = (TRAFFIC - self.background).astype(np.float64)

    def frame(self, traffic: list[Rectangle], ego: Rectangle) -> NDArray[np.uint8]:
        """Draw one frame of the observation, uint8 [45, 80], with the ego car on top."""
        picture = self._with_traffic(traffic)
        self.draw(picture, ego, EGO)
        return (picture + 0.5).astype(np.uint8)

    def _with_traffic(self, cars: list[Rectangle]) -> NDArray[np.float32]:
        """Draw the cars on the background, float32 [45, 80].

        A car parallel to the rows covers a row of shares times a column of shares. Where no two
        cars share a pixel, one matrix product adds all of them, with the same bits as drawing one
        after another.
        """
        if cars and all(car.heading == 0.0 for car in cars):
            shapes = np.array(cars)[:, :, None]
            covered = self._covered(self._centres - shapes[:, :2], shapes[:, 3:])
            if _product(np.ceil(covered)).max() <= 1.0:
                mixed = self._still + _product(covered) * self._up_to_traffic
                return mixed.astype(np.float32)
        picture = self.background.copy()
        for car in cars:
            self.draw(picture, car, TRAFFIC)
        return picture

    def draw(self, picture: NDArray[np.float32], shape: Rectangle, value: float) -> None:
        """Blend a rectangle into ``picture`` [45, 80], weighted by the area it covers."""
        cos, sin = math.cos(shape.heading), math.sin(shape.heading)
        pixel_m = self.metres_per_pixel
        reach_x = 0.5 * (abs(cos) * shape.length + abs(sin) * shape.width) + pixel_m
        reach_y = 0.5 * (abs(sin) * shape.length + abs(cos) * shape.width) + pixel_m
        left = max(int((shape.x - reach_x - self.left_m) / pixel_m), 0)
        right = min(int((shape.x + reach_x - self.left_m) / pixel_m) + 1, COLUMNS)
        top = max(int((shape.y - reach_y - self.top_m) / pixel_m), 0)
        bottom = min(int((shape.y + reach_y - self.top_m) / pixel_m) + 1, ROWS)
        if left >= right or top >= bottom:
            return
        dx = self._centres[0, left:right] - shape.x
        dy = (self._centres[1, top:bottom] - shape.y)[:, None]
        if sin == 0.0:
            # Parallel to the rows, as most traffic is: a row times a column instead of a field.
            along, across = dx, dy
        else:
            along, across = dx * cos + dy * sin, dy * cos - dx * sin
        inside = self._covered(along, shape.length) * self._covered(across, shape.width)
        patch = picture[top:bottom, left:right]
        patch += inside * (value - patch)

    def _covered(
        self, offset_m: NDArray[np.floating], side_m: float | NDArray[np.floating]
    ) -> NDArray[np.floating]:
        """Return the share of a pixel between two sides, by its offset from their middle."""
        share = (0.5 * side_m - np.abs(offset_m)) / self.metres_per_pixel + 0.5
        # np.clip costs more than the arithmetic on arrays this small.
        return np.minimum(np.maximum(share, 0.0), 1.0)


def _product(axes: NDArray[np.floating]) -> NDArray[np.floating]:
    """Sum up each car's row times its column: [n, 2, 80] -> [45, 80]."""
    columns, rows = axes[:, 0], axes[:, 1, :ROWS]
    product: NDArray[np.floating] = rows.T @ columns
    return product


PIXELS_PER_METRE = 16
WIDTH_M, HEIGHT_M = 46.0, 25.0
VIEW = (-30.0, -7.0)
"""Upper left corner of the ground shown, for a scene that names no ``view`` of its own."""
GOAL_HALF_M = 2.0
BODY = ("x", "y", "heading_rad", "length_m", "width_m")
"""Fields of a scene's vehicle in the order of a ``Rectangle``."""


def draw_scene(scene: dict[str, Any]) -> NDArray[np.uint8]:
    """Draw ``scene`` (see ``DrivingEnv.scene``) from above, uint8 [height, width, 3]."""
    size = (int(WIDTH_M * PIXELS_PER_METRE), int(HEIGHT_M * PIXELS_PER_METRE))
    image = Image.new("RGB", size, shown.GROUND)
    pen, corner = ImageDraw.Draw(image), np.array(scene.get("view", VIEW))

    def pixels(points: Any) -> list[tuple[float, ...]]:
        return [*map(tuple, ((np.array(points) - corner) * PIXELS_PER_METRE).tolist())]

    def line(points: Any, colour: Colour, width_pixels: int) -> None:
        pen.line(pixels(points), fill=colour, width=width_pixels)

    for road in scene["roads"]:
        line(road, shown.ROAD, int(scene["road_width_m"] * PIXELS_PER_METRE))
    for each in scene.get("lane_lines", scene["roads"]):
        line(each, shown.MARKING, 2)
    line(scene["path"], shown.PATH, 4)
    x, y = scene["goal"]
    line([[x, y - GOAL_HALF_M], [x, y + GOAL_HALF_M]], shown.GOAL, 8)
    for vehicle in scene["vehicles"]:
        body = corners(Rectangle(*(vehicle[name] for name in BODY)))
        colour = POLICY if vehicle["ego"] else shown.APPLIED
        pen.polygon(pixels(body), fill=colour, outline=shown.GLASS, width=2)
        line((body[0], body[1]), shown.GLASS, 8)  # The front
    return np.asarray(image)
