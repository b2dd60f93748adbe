"""Pictures as files: learning curves (``plot``), a moment or a film of a drive (``picture``)."""

from __future__ import annotations

import argparse
import io
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bridge.report import GOAL
from edge_runtime.cli import Command, add_public_key, examples, positive_number
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError
from trainer.drivers import ACTIONS, EXPERTS, TRIGGERS, load_driver, make_environment
from trainer.human.guide import Driver, Guide, HumanGuide, Intervention
from trainer.options import add_scenario, add_seed, check_suffix, existing_directory
from trainer.scenarios.picture import COLOURS
from trainer.training.metrics import read_metrics

CURVE_FILE = "learning_curve.png"
WINDOW = 20
"""Episodes of the moving average."""
PANELS = {
    "episode_return": "return (without shaping)",
    "distance_m": "surviving distance, m",
    "success": "success",
    "human_share": "share of steps driven by the human",
}
"""Column -> title."""
Values = NDArray[np.float64]


def _add_plot_arguments(parser: argparse.ArgumentParser) -> None:
    runs = "directory of a training run; several are drawn thinly, and their mean"
    parser.add_argument("run_dirs", metavar="RUN_DIR", nargs="+", help=runs)
    out = f"the picture (default: RUN_DIR/{CURVE_FILE})"
    parser.add_argument("--out", metavar="F.png", help=out)


def _plot(arguments: argparse.Namespace) -> int:
    run_dirs = [existing_directory(path, "run directory") for path in arguments.run_dirs]
    if arguments.out is None and len(run_dirs) > 1:
        raise UserError("several runs go into one picture: --out F.png")
    if arguments.out is not None:
        check_suffix(arguments.out, "a picture is a .png", ".png")
    print(write_learning_curve(*run_dirs, out=arguments.out))
    return 0


PLOT = Command(
    examples(
        "python -m trainer plot runs/phil_1",
        "python -m trainer plot runs/phil_1 runs/phil_2 runs/phil_3 --out curves.png",
    ),
    _add_plot_arguments,
    _plot,
)


def write_learning_curve(*run_dirs: Path, out: str | None = None) -> Path:
    """Draw return, surviving distance, success and human share over the episodes as a PNG.

    Several runs are a thin line each, and their mean up to the end of the shortest. ``out``: the
    file; by default in the first run's directory.

    Raises:
        UserError: one of the runs has no metrics yet, or the file cannot be written.
    """
    path = run_dirs[0] / CURVE_FILE if out is None else Path(out)
    check_writable(path)
    runs = [_columns(run_dir) for run_dir in run_dirs]
    shortest = min(len(run["episode"]) for run in runs)
    episodes = runs[0]["episode"][:shortest]
    figure = Figure(figsize=(10, 6), layout="constrained")
    panels = dict(zip(PANELS, figure.subplots(2, 2, sharex=True).flat, strict=True))
    for name, panel in panels.items():
        curves = [moving_average(run[name], WINDOW) for run in runs]
        label = f"mean of {WINDOW}"
        if len(runs) == 1:
            panel.plot(episodes, runs[0][name], ".", markersize=3, color="0.75")
        else:
            label = f"{len(runs)} runs, {label}"
            for run, curve in zip(runs, curves, strict=True):
                panel.plot(run["episode"], curve, color="C0", alpha=0.25, linewidth=1)
        mean = np.mean([curve[:shortest] for curve in curves], axis=0)
        panel.plot(episodes, mean, color="C0", label=label)
        panel.set_title(PANELS[name])
        panel.grid(alpha=0.3)
    # Success of the policy alone where all runs were validated, and its mean.
    validated = np.array([run["validation"][:shortest] for run in runs])
    tested = ~np.isnan(validated).any(axis=0)
    means = validated[:, tested].mean(axis=0)
    success = panels["success"]
    success.plot(episodes[tested], means, "o-", color="C1", label="policy alone, validation")
    success.legend()
    for name in ("success", "human_share"):
        panels[name].set_xlabel("episode")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_atomic(path, buffer.getvalue())
    return path


def moving_average(values: Values, window: int) -> Values:
    """The mean of the last ``window`` values (fewer at the start), same length."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def _columns(run_dir: Path) -> dict[str, Values]:
    rows = read_metrics(run_dir)
    if not rows:
        raise UserError(f"{run_dir} holds no metrics to draw")

    def column(name: str) -> Values:
        # Kept results have nothing where there was no number.
        return np.array([row.get(name) or "nan" for row in rows], dtype=float)

    return {
        "episode": column("episode") + 1,
        "episode_return": column("episode_return"),
        "distance_m": column("distance_m"),
        "success": np.array([row["outcome"] == GOAL for row in rows], dtype=float),
        "human_share": column("human_steps") / column("steps"),
        "validation": column("validation_success"),
    }


BAND_PIXELS = 58
"""Above the scene: who drives, and both actions."""
GAUGE_PIXELS = (150, 14)
PILL_PIXELS = (310, 34)
FACTS = {
    "collision": "the human drives: a crash ahead",
    "lane": "the human drives: no stopping in the lane",
    "stuck": "the human drives: the way is clear",
    "heading": "the human drives: it turned aside",
    "offset": "the human drives: too far aside",
    "person": "the human drives",
    None: "the policy drives",
}
"""Reason of the intervention -> what is written."""
POLICY, HUMAN, GAUGE = COLOURS["ego"], (46, 139, 76), (200, 206, 196)
COLOUR_COUNT = 64
"""A GIF's palette: the scene has few colours, and letters some shades."""
LAST_S = 1.5
"""How long the last picture stays before the film begins anew."""


def _add_picture_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("policy", metavar="POLICY", help="what drives: see `trainer evaluate`")
    add_public_key(parser)
    add_scenario(parser)
    add_seed(parser, "the episode")
    add, out = parser.add_argument, "the picture, or the film"
    when = "simulated seconds from the start: the moment of a picture, the end of a film"
    add("--time", type=positive_number, default=3.0, metavar="S", help=when)
    human = "what takes over in a film, where the scripted human would (default: nothing)"
    add("--human", metavar="expert|HUMAN_DIR", help=human)
    add("--out", required=True, metavar="F.png|F.gif", help=out)


def _picture(arguments: argparse.Namespace) -> int:
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


PICTURE = Command(
    examples(
        "python -m trainer picture expert --seed 8 --time 3.4 --out scene.png",
        "python -m trainer picture runs/phil_1 --human expert --time 15 --out take_over.gif",
    ),
    _add_picture_arguments,
    _picture,
)


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
    rows = (("the policy wants", moment.policy_action, POLICY), ("applied", moment.action, colour))
    for row, (name, value, shade) in enumerate(rows):
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
