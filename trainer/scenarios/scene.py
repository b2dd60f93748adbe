"""The scene from above as a picture for a person: road, path, cars, and what the policy sees."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
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
BODY = ("x", "y", "heading_rad", "length_m", "width_m")
"""A scene's vehicle in the order of a ``Rectangle``."""
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

    ``ego`` is the ego car's colour, which tells what drives it.

    Returns:
        uint8 [height, width, 3].
    """
    size = (int(WIDTH_M * PIXELS_PER_METRE), int(HEIGHT_M * PIXELS_PER_METRE))
    image = Image.new("RGB", size, COLOURS["ground"])
    pen, corner = ImageDraw.Draw(image), scene.get("view", VIEW)

    def pixels(points: Iterable[Sequence[float]]) -> list[tuple[float, float]]:
        return [
            ((x - corner[0]) * PIXELS_PER_METRE, (y - corner[1]) * PIXELS_PER_METRE)
            for x, y in points
        ]

    def line(points: Iterable[Sequence[float]], colour: str, width_pixels: int) -> None:
        pen.line(pixels(points), fill=COLOURS[colour], width=width_pixels)

    for road in scene["roads"]:
        line(road, "road", int(scene["road_width_m"] * PIXELS_PER_METRE))
    # Lane lines of their own, or the centre line of every road outside their crossing.
    lines, skip_m = scene.get("lane_lines"), 0.0
    if lines is None:
        lines, skip_m = scene["roads"], 0.5 * scene["road_width_m"]
    for each in lines:
        for dash in _dashes(each, skip_m):
            line(dash, "marking", 2)
    line(scene["path"], "path", 4)
    x, y = scene["goal"]
    line([[x, y - GOAL_HALF_M], [x, y + GOAL_HALF_M]], "goal", 8)
    for vehicle in scene["vehicles"]:
        body = Rectangle(*(vehicle[name] for name in BODY))
        ahead = 0.18 * body.length * np.array([np.cos(body.heading), np.sin(body.heading)])
        glass = Rectangle(
            body.x + ahead[0], body.y + ahead[1], body.heading, 0.16 * body.length, 0.8 * body.width
        )
        colour = ego if vehicle["ego"] else COLOURS["traffic"]
        pen.polygon(pixels(corners(body)), fill=colour, outline=COLOURS["glass"], width=2)
        pen.polygon(pixels(corners(glass)), fill=COLOURS["glass"])
    if frames is not None:
        _inset_frames(image, frames)
    end = (size[0] - 12, size[1] - 12)
    pen.multiline_text(end, caption, COLOURS["text"], anchor="rd", font_size=15)
    return np.asarray(image)


def _dashes(road: Sequence[Sequence[float]], skip_m: float) -> Iterator[list[list[float]]]:
    """A line dashed every 2 m, leaving out what is nearer to the origin than ``skip_m``."""
    start, end = np.array(road[0]), np.array(road[-1])
    length_m = float(np.hypot(*(end - start)))
    for start_m in np.arange(0.0, length_m, 4.0):
        ends = [start + (m / length_m) * (end - start) for m in (start_m, start_m + 2.0)]
        if all(np.abs(each).max() >= skip_m for each in ends):
            yield [each.tolist() for each in ends]


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
