"""Draw a moment of an episode, from above, as a person understands it."""

from __future__ import annotations

import argparse
import io

from PIL import Image

from edge_runtime.cli import examples
from edge_runtime.errors import UserError
from edge_runtime.files import check_writable, write_atomic
from trainer.commands.options import add_scenario, not_negative, positive_float
from trainer.drivers import load_driver, make_environment

EXAMPLE = examples("python -m trainer picture expert --seed 8 --time 3.4 --out scene.png")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("policy", help="who drives: see `trainer evaluate`")
    add_scenario(parser)
    parser.add_argument("--seed", type=not_negative, default=0, help="of the episode")
    parser.add_argument(
        "--time",
        type=positive_float,
        default=3.0,
        metavar="S",
        help="simulated seconds from the start",
    )
    parser.add_argument("--out", required=True, metavar="F.png", help="the picture")


def run(arguments: argparse.Namespace) -> int:
    """Drive to the moment and draw it; returns the exit status."""
    if not arguments.out.endswith(".png"):
        raise UserError(f"--out {arguments.out}: the picture is a .png")
    check_writable(arguments.out)
    env = make_environment(arguments.scenario)
    driver, _ = load_driver(arguments.policy, env)
    observation, _ = env.reset(seed=arguments.seed)
    driver.reset()
    ended = False
    while not ended and env.steps * env.config.control_period_s < arguments.time - 1e-9:
        observation, _, terminated, truncated, _ = env.step(driver.act(observation))
        ended = terminated or truncated
    buffer = io.BytesIO()
    Image.fromarray(env.render()).save(buffer, format="png")
    write_atomic(arguments.out, buffer.getvalue())
    print(arguments.out)
    return 0
