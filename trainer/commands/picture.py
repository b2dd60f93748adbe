"""Draw a moment of an episode, or all of it, from above, as a person understands it."""

from __future__ import annotations

import argparse
import io
from typing import Any

from PIL import Image

from edge_runtime.cli import add_public_key, examples, not_negative, positive_number
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError
from trainer.actions import ACTIONS
from trainer.animation import draw_moment, drive_moments, encode_gif
from trainer.commands.options import add_scenario, check_picture
from trainer.drivers import EXPERTS, TRIGGERS, load_driver, make_environment
from trainer.human.guide import Driver, HumanGuide

EXAMPLE = examples(
    "python -m trainer picture expert --seed 8 --time 3.4 --out scene.png",
    "python -m trainer picture runs/phil_1 --human expert --time 15 --out take_over.gif",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("policy", help="who drives: see `trainer evaluate`")
    add_public_key(parser)
    add_scenario(parser)
    parser.add_argument("--seed", type=not_negative, default=0, help="of the episode")
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
        help="who takes over, where the scripted human would; in a film (default: nobody)",
    )
    parser.add_argument(
        "--out",
        required=True,
        metavar="F.png|F.gif",
        help="the picture, or the film",
    )


def run(arguments: argparse.Namespace) -> int:
    """Drive to the moment and draw it, or film the way there; returns the exit status."""
    check_picture(arguments.out, film=True)
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
