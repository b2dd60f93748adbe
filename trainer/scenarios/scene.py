"""The scene from above as a picture for a person: road, path, cars, and what the policy sees."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bridge.rerun import POLICY, Colour
from trainer.scenarios.picture import Rectangle, corners

PIXELS_PER_METRE = 16
WIDTH_M, HEIGHT_M = 46.0, 25.0
VIEW = (-30.0, -7.0)
"""Upper left corner of the ground shown, for a scene that names no ``view`` of its own."""
GOAL_HALF_M = 2.0
COLOURS = {
    "ground": (222, 229, 216),
    "road": (92, 97, 105),
    "marking": (235, 235, 235),
    "path": (120, 190, 255),
    "goal": (84, 200, 120),
    "ego": POLICY,
    "traffic": (235, 140, 40),
    "glass": (30, 34, 40),
    "text": (30, 34, 40),
}


def draw_scene(
    scene: dict[str, Any],
    frames: NDArray[np.uint8] | None = None,
    caption: str = "",
    ego: Colour = POLICY,
) -> NDArray[np.uint8]:
    """Draw ``scene`` (see ``DrivingEnv.scene``) and, inset, the two frames of the policy.

    ``ego`` is the ego car's colour: of whoever drives it.

    Returns:
        uint8 [height, width, 3].
    """
    size = (int(WIDTH_M * PIXELS_PER_METRE), int(HEIGHT_M * PIXELS_PER_METRE))
    image = Image.new("RGB", size, COLOURS["ground"])
    pen = _GroundPen(image, scene.get("view", VIEW))
    _draw_roads(pen, scene)
    pen.line(scene["path"], "path", 4)
    x, y = scene["goal"]
    pen.line([[x, y - GOAL_HALF_M], [x, y + GOAL_HALF_M]], "goal", 8)
    for vehicle in scene["vehicles"]:
        _draw_vehicle(pen, vehicle, ego if vehicle["ego"] else COLOURS["traffic"])
    if frames is not None:
        _inset_frames(image, frames)
    ImageDraw.Draw(image).multiline_text(
        (size[0] - 12, size[1] - 12), caption, COLOURS["text"], anchor="rd", font_size=15
    )
    return np.asarray(image)


def vehicle_entry(number: int, shape: Rectangle, speed_mps: float, ego: bool) -> dict[str, Any]:
    """One of a scene's ``vehicles``."""
    return {
        "id": number,
        "x": shape.x,
        "y": shape.y,
        "heading_rad": shape.heading,
        "length_m": shape.length,
        "width_m": shape.width,
        "speed_mps": float(speed_mps),
        "ego": ego,
    }


class _GroundPen:
    """Draws what is given in metres on the ground.

    Args:
        image: the picture.
        corner: the ground's point in its upper left corner.
    """

    def __init__(self, image: Image.Image, corner: Sequence[float]) -> None:
        self._pen = ImageDraw.Draw(image)
        self._left_m, self._top_m = corner

    def line(self, points: Iterable[Sequence[float]], colour: str, width_pixels: int) -> None:
        self._pen.line(self._pixels(points), fill=COLOURS[colour], width=width_pixels)

    def area(self, shape: Rectangle, colour: Colour, outlined: bool = False) -> None:
        outline = COLOURS["glass"] if outlined else None
        self._pen.polygon(self._pixels(corners(shape)), fill=colour, outline=outline, width=2)

    def _pixels(self, points: Iterable[Sequence[float]]) -> list[tuple[float, float]]:
        scale = PIXELS_PER_METRE
        return [((x - self._left_m) * scale, (y - self._top_m) * scale) for x, y in points]


def _draw_roads(pen: _GroundPen, scene: dict[str, Any]) -> None:
    width = int(scene["road_width_m"] * PIXELS_PER_METRE)
    for road in scene["roads"]:
        pen.line(road, "road", width)
    # Lane lines of their own, or the centre line of every road outside their crossing.
    for line in scene.get("lane_lines", []):
        _draw_dashes(pen, line, skip_m=0.0)
    for road in scene["roads"] if "lane_lines" not in scene else []:
        _draw_dashes(pen, road, skip_m=0.5 * scene["road_width_m"])


def _draw_dashes(pen: _GroundPen, road: list[list[float]], skip_m: float) -> None:
    """A line dashed every 2 m, leaving out what is nearer to the origin than ``skip_m``."""
    (x0, y0), (x1, y1) = road[0], road[-1]
    length_m = float(np.hypot(x1 - x0, y1 - y0))
    for start_m in np.arange(0.0, length_m, 4.0):
        ends = [
            np.array([x0, y0]) + (m / length_m) * np.array([x1 - x0, y1 - y0])
            for m in (start_m, start_m + 2.0)
        ]
        if all(np.abs(end).max() >= skip_m for end in ends):
            pen.line([end.tolist() for end in ends], "marking", 2)


def _draw_vehicle(pen: _GroundPen, vehicle: dict[str, Any], colour: Colour) -> None:
    body = Rectangle(
        vehicle["x"],
        vehicle["y"],
        vehicle["heading_rad"],
        vehicle["length_m"],
        vehicle["width_m"],
    )
    pen.area(body, colour, outlined=True)
    ahead = 0.18 * body.length * np.array([np.cos(body.heading), np.sin(body.heading)])
    glass = Rectangle(
        body.x + ahead[0], body.y + ahead[1], body.heading, 0.16 * body.length, 0.8 * body.width
    )
    pen.area(glass, COLOURS["glass"])


def _inset_frames(image: Image.Image, frames: NDArray[np.uint8]) -> None:
    """What the policy sees, enlarged, in the lower left corner: the older frame first."""
    scale, margin = 2.3, 12
    size = (int(frames.shape[2] * scale), int(frames.shape[1] * scale))
    top = image.height - size[1] - margin
    pen = ImageDraw.Draw(image)
    for place, (frame, when) in enumerate(zip(frames, ("0.1 s ago", "now"), strict=True)):
        inset = Image.fromarray(frame).resize(size, Image.Resampling.NEAREST).convert("RGB")
        left = margin + place * (size[0] + margin)
        image.paste(inset, (left, top))
        text = f"the policy sees, {when}"
        pen.text((left, top - 20), text, fill=COLOURS["text"], font_size=14)
