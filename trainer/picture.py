"""Draw a moment of an episode from above, or film all of it with its take-overs."""

from __future__ import annotations

import argparse
import io
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from edge_runtime.cli import add_public_key, examples, positive_number
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError
from trainer.drivers import ACTIONS, EXPERTS, TRIGGERS, load_driver, make_environment
from trainer.human.guide import Driver, Guide, HumanGuide, Intervention
from trainer.options import add_scenario, add_seed, check_suffix
from trainer.scenarios.picture import COLOURS

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
"""A GIF's palette: the scene has few colours, and letters some shades."""
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
        "--out", required=True, metavar="F.png|F.gif", help="the picture, or the film"
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
    guide = None
    if arguments.human is not None:
        human, _ = load_driver(arguments.human, env)
        guide = HumanGuide(human, TRIGGERS[env.scenario](EXPERTS[env.scenario](env)))
    period_s = env.config.control_period_s
    seconds = arguments.time if is_film else arguments.time + period_s  # and the scene after that
    moments = drive_moments(env, driver, guide, arguments.seed, seconds)
    if is_film:
        name = ACTIONS[env.scenario].name
        data = encode_gif([draw_moment(moment, name) for moment in moments], period_s)
    else:
        [last] = deque(moments, maxlen=1)
        buffer = io.BytesIO()
        last.scene.save(buffer, format="png")
        data = buffer.getvalue()
    write_atomic(arguments.out, data)
    print(arguments.out)
    return 0


class Moment(NamedTuple):
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
    width, height = GAUGE_PIXELS
    left = image.width - width - 16
    centre = left + width / 2
    text = COLOURS["text"]
    for row, (name, value, shade) in enumerate(
        (("the policy wants", moment.policy_action, POLICY), ("applied", moment.action, colour))
    ):
        top = 11 + 22 * row
        pen.rectangle((left, top, left + width, top + height), fill=GAUGE)
        ends = sorted((centre, centre + value * width / 2))  # Right is positive.
        pen.rectangle((ends[0], top, ends[1], top + height), fill=shade)
        pen.line((centre, top - 2, centre, top + height + 2), fill=text)
        place = (left - 8, top + height / 2)
        pen.text(place, f"{action_name} {name}", fill=text, anchor="rm", font_size=14)
    return image


def encode_gif(pictures: Sequence[Image.Image], period_s: float) -> bytes:
    """An endless GIF with one palette for all, so that nothing flickers."""
    some = np.vstack([np.asarray(picture) for picture in pictures[:: len(pictures) // 8 or 1]])
    palette = Image.fromarray(some).quantize(COLOUR_COUNT, dither=Image.Dither.NONE)
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    times_ms = [round(1000 * period_s)] * (len(frames) - 1) + [round(1000 * LAST_S)]
    buffer = io.BytesIO()
    more = {"append_images": frames[1:], "duration": times_ms, "loop": 0, "optimize": True}
    frames[0].save(buffer, format="gif", save_all=True, **more)
    return buffer.getvalue()
