"""Draw a moment of an episode from above, or film all of it with its take-overs."""

from __future__ import annotations

import argparse
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from edge_runtime.cli import add_public_key, examples, positive_number
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError
from trainer.drivers import ACTIONS, EXPERTS, TRIGGERS, load_driver, make_environment
from trainer.human.guide import Driver, Guide, HumanGuide, Intervention
from trainer.options import add_scenario, add_seed, check_suffix
from trainer.scenarios.scene import COLOURS

EXAMPLE = examples(
    "python -m trainer picture expert --seed 8 --time 3.4 --out scene.png",
    "python -m trainer picture runs/phil_1 --human expert --time 15 --out take_over.gif",
)
BAND_PIXELS = 58
"""Above the scene: who drives, and both actions."""
GAUGE_PIXELS = (150, 14)
PILL_PIXELS = (310, 34)
FACTS = {
    "collision": "the human drives: a crash ahead",
    "lane": "the human drives: no stopping in the lane",
    "stuck": "the human drives: the way is clear",
    "heading": "the human drives: it turned aside",
    "offset": "the human drives: it drifted aside",
    "person": "the human drives",
    None: "the policy drives",
}
"""What is said, by the reason of the intervention."""
POLICY, HUMAN, GAUGE = COLOURS["ego"], (46, 139, 76), (200, 206, 196)
COLOUR_COUNT = 64
"""Of a GIF's palette: the scene has few colours, and letters some shades."""
LAST_S = 1.5
"""How long the last picture stays before it begins anew."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("policy", metavar="POLICY", help="what drives: see `trainer evaluate`")
    add_public_key(parser)
    add_scenario(parser)
    add_seed(parser, "the episode")
    parser.add_argument(
        "--time",
        type=positive_number,
        default=3.0,
        metavar="S",
        help="simulated seconds from the start: the moment of a picture, the end of a film",
    )
    parser.add_argument(
        "--human",
        metavar="expert|HUMAN_DIR",
        help="what takes over in a film, where the scripted human would (default: nothing)",
    )
    parser.add_argument(
        "--out",
        required=True,
        metavar="F.png|F.gif",
        help="the picture, or the film",
    )


def run(arguments: argparse.Namespace) -> int:
    """Drive to the moment and draw it, or film the way there; returns the exit status."""
    check_suffix(arguments.out, "a picture is a .png, a film a .gif", ".png", ".gif")
    is_film = arguments.out.endswith(".gif")
    if arguments.human is not None and not is_film:
        raise UserError("--human takes over in a film: --out F.gif")
    check_writable(arguments.out)
    env = make_environment(arguments.scenario)
    driver, _ = load_driver(arguments.policy, env, arguments.public_key)
    if is_film:
        data = _film(arguments, env, driver)
    else:
        data = _picture(env, driver, arguments.seed, arguments.time)
    write_atomic(arguments.out, data)
    print(arguments.out)
    return 0


def _picture(env: Any, driver: Driver, seed: int, time_s: float) -> bytes:
    observation, _ = env.reset(seed=seed)
    driver.reset()
    ended = False
    while not ended and env.steps * env.config.control_period_s < time_s - 1e-9:
        observation, _, terminated, truncated, _ = env.step(driver.act(observation))
        ended = terminated or truncated
    buffer = io.BytesIO()
    Image.fromarray(env.render()).save(buffer, format="png")
    return buffer.getvalue()


def _film(arguments: argparse.Namespace, env: Any, driver: Driver) -> bytes:
    guide = None
    if arguments.human is not None:
        human, _ = load_driver(arguments.human, env)
        guide = HumanGuide(human, TRIGGERS[env.scenario](EXPERTS[env.scenario](env)))
    moments = drive_moments(env, driver, guide, arguments.seed, arguments.time)
    pictures = [draw_moment(moment, ACTIONS[env.scenario].name) for moment in moments]
    return encode_gif(pictures, env.config.control_period_s)


@dataclass(frozen=True)
class Moment:
    """One control period: the scene before it, and who decides what in it."""

    scene: Image.Image
    policy_action: float
    action: float
    intervention: Intervention | None


def drive_moments(
    env: Any, driver: Driver, guide: Guide | None, seed: int, seconds: float
) -> Iterator[Moment]:
    """Drive until the episode ends, or for so many simulated seconds; the guide may take over."""
    observation, _ = env.reset(seed=seed)
    driver.reset()
    if guide is not None:
        guide.reset()
    for _ in range(round(seconds / env.config.control_period_s)):
        scene = Image.fromarray(env.render())
        policy_action = driver.act(observation)
        intervention = None if guide is None else guide.watch(observation, policy_action)
        action = policy_action if intervention is None else intervention.action
        yield Moment(scene, float(policy_action[0]), float(action[0]), intervention)
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            yield Moment(Image.fromarray(env.render()), 0.0, 0.0, None)
            return


def draw_moment(moment: Moment, action_name: str) -> Image.Image:
    """The scene, and above it who drives, what the policy wants and what is done."""
    scene = moment.scene
    image = Image.new("RGB", (scene.width, scene.height + BAND_PIXELS), COLOURS["ground"])
    image.paste(scene, (0, BAND_PIXELS))
    pen = ImageDraw.Draw(image)
    reason = None if moment.intervention is None else moment.intervention.reason
    colour = POLICY if reason is None else HUMAN
    top = (BAND_PIXELS - PILL_PIXELS[1]) // 2
    pill = (12, top, 12 + PILL_PIXELS[0], top + PILL_PIXELS[1])
    pen.rounded_rectangle(pill, PILL_PIXELS[1] // 2, fill=colour)
    middle = ((pill[0] + pill[2]) // 2, (pill[1] + pill[3]) // 2)
    pen.text(middle, FACTS[reason], fill=(255, 255, 255), anchor="mm", font_size=17)
    left = image.width - GAUGE_PIXELS[0] - 16
    for row, (name, value, shade) in enumerate(
        ((f"{action_name} the policy wants", moment.policy_action, POLICY),
         (f"{action_name} applied", moment.action, colour))
    ):  # fmt: skip
        _draw_gauge(pen, (left, 11 + 22 * row), name, value, shade)
    return image


def _draw_gauge(
    pen: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    name: str,
    value: float,
    colour: tuple[int, int, int],
) -> None:
    """A bar from the middle: right is positive."""
    (left, top), (width, height) = corner, GAUGE_PIXELS
    pen.rectangle((left, top, left + width, top + height), fill=GAUGE)
    centre = left + width / 2
    ends = sorted((centre, centre + value * width / 2))
    pen.rectangle((ends[0], top, ends[1], top + height), fill=colour)
    pen.line((centre, top - 2, centre, top + height + 2), fill=COLOURS["text"])
    pen.text((left - 8, top + height / 2), name, fill=COLOURS["text"], anchor="rm", font_size=14)


def encode_gif(pictures: Sequence[Image.Image], period_s: float) -> bytes:
    """An endless GIF with one palette for all, so that nothing flickers."""
    every = Image.fromarray(
        np.vstack([np.asarray(p) for p in pictures[:: len(pictures) // 8 or 1]])
    )
    palette = every.quantize(COLOUR_COUNT, dither=Image.Dither.NONE)
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    times_ms = [round(1000 * period_s)] * (len(frames) - 1) + [round(1000 * LAST_S)]
    buffer = io.BytesIO()
    frames[0].save(
        buffer,
        format="gif",
        save_all=True,
        append_images=frames[1:],
        duration=times_ms,
        loop=0,
        optimize=True,
    )
    return buffer.getvalue()
