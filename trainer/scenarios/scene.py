"""The scene from above as a picture for a person: road, path, cars, and what the policy sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from trainer.scenarios.geometry import Rectangle, corners

PIXELS_PER_METRE = 16
LEFT_M, TOP_M, WIDTH_M, HEIGHT_M = -30.0, -7.0, 46.0, 25.0
COLOURS = {
    "ground": (222, 229, 216),
    "road": (92, 97, 105),
    "marking": (235, 235, 235),
    "path": (120, 190, 255),
    "goal": (84, 200, 120),
    "ego": (40, 120, 230),
    "traffic": (235, 140, 40),
    "glass": (30, 34, 40),
    "text": (30, 34, 40),
}


def draw_scene(
    scene: dict[str, Any], frames: NDArray[np.uint8] | None = None, caption: str = ""
) -> NDArray[np.uint8]:
    """Draw ``scene`` (see ``LeftTurnEnv.scene``) and, inset, the two frames of the policy.

    Returns:
        uint8 [height, width, 3].
    """
    size = (int(WIDTH_M * PIXELS_PER_METRE), int(HEIGHT_M * PIXELS_PER_METRE))
    image = Image.new("RGB", size, COLOURS["ground"])
    pen = ImageDraw.Draw(image)
    _draw_roads(pen, scene)
    pen.line([_pixel(p) for p in scene["path"]], fill=COLOURS["path"], width=4)
    _draw_goal(pen, scene["goal"])
    for vehicle in scene["vehicles"]:
        _draw_vehicle(pen, vehicle)
    if frames is not None:
        _inset_frames(image, frames)
    pen.multiline_text(
        (size[0] - 12, size[1] - 12), caption, COLOURS["text"], anchor="rd", font_size=15
    )
    return np.asarray(image)


def _pixel(point: Any) -> tuple[float, float]:
    x, y = point
    return (x - LEFT_M) * PIXELS_PER_METRE, (y - TOP_M) * PIXELS_PER_METRE


def _draw_roads(pen: ImageDraw.ImageDraw, scene: dict[str, Any]) -> None:
    width = int(scene["road_width_m"] * PIXELS_PER_METRE)
    for road in scene["roads"]:
        pen.line([_pixel(p) for p in road], fill=COLOURS["road"], width=width)
    for road in scene["roads"]:
        _draw_dashes(pen, road, skip_m=0.5 * scene["road_width_m"])


def _draw_dashes(pen: ImageDraw.ImageDraw, road: list[list[float]], skip_m: float) -> None:
    """The centre line, dashed every 2 m, leaving out the crossing itself."""
    (x0, y0), (x1, y1) = road[0], road[-1]
    length_m = float(np.hypot(x1 - x0, y1 - y0))
    for start_m in np.arange(0.0, length_m, 4.0):
        ends = [
            np.array([x0, y0]) + (m / length_m) * np.array([x1 - x0, y1 - y0])
            for m in (start_m, start_m + 2.0)
        ]
        if all(np.abs(end).max() >= skip_m for end in ends):
            pen.line([_pixel(end) for end in ends], fill=COLOURS["marking"], width=2)


def _draw_goal(pen: ImageDraw.ImageDraw, goal: list[float]) -> None:
    x, y = _pixel(goal)
    half = 2.0 * PIXELS_PER_METRE
    pen.line([(x, y - half), (x, y + half)], fill=COLOURS["goal"], width=8)


def _draw_vehicle(pen: ImageDraw.ImageDraw, vehicle: dict[str, Any]) -> None:
    body = Rectangle(
        vehicle["x"],
        vehicle["y"],
        vehicle["heading_rad"],
        vehicle["length_m"],
        vehicle["width_m"],
    )
    colour = COLOURS["ego"] if vehicle["ego"] else COLOURS["traffic"]
    pen.polygon([_pixel(p) for p in corners(body)], fill=colour, outline=COLOURS["glass"], width=2)
    ahead = 0.18 * body.length * np.array([np.cos(body.heading), np.sin(body.heading)])
    glass = Rectangle(
        body.x + ahead[0], body.y + ahead[1], body.heading, 0.16 * body.length, 0.8 * body.width
    )
    pen.polygon([_pixel(p) for p in corners(glass)], fill=COLOURS["glass"])


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
