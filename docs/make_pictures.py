"""Make pictures of this folder anew: ``python docs/make_pictures.py``.

The film, the cockpit and rerun's views are taken from the screen, by a person.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from bridge.report import write_figure
from edge_runtime.cli import run_cli
from edge_runtime.util import read_json
from hil_tests.envelope import draw_axes
from trainer.environments import make_environment
from trainer.evaluation import load_driver
from trainer.util import kept

FOLDER = Path(__file__).parent
MOMENTS = {"left_turn": (8, 3.4), "congestion": (3, 5.0)}  # Scenario -> seed and time, s


def moment(scenario: str) -> tuple[Any, Any]:
    """Return the environment at that moment, the expert driving, and what is observed."""
    seed, time_s = MOMENTS[scenario]
    env = make_environment(scenario)
    driver, _ = load_driver("expert", env)
    frames, _ = env.reset(seed=seed)
    driver.reset()
    for _ in range(round(time_s / env.control_period_s)):
        frames, *_ = env.step(driver.act(frames))
    return env, frames


def main(_: list[str]) -> int:
    """Draw both scenarios from above, both frames of both, and success against latency."""
    figure = Figure(figsize=(8.6, 5.6), layout="constrained")
    for panels, scenario in zip(figure.subplots(len(MOMENTS), 2), MOMENTS, strict=True):
        env, frames = moment(scenario)
        Image.fromarray(env.render()).save(FOLDER / f"{scenario}.png")
        for panel, frame, when in zip(panels, frames, ("0.1 s ago", "now"), strict=True):
            panel.imshow(np.asarray(frame), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            panel.set_title(f"{scenario.replace('_', ' ')}, {when}: 80 x 45 pixels", fontsize=10)
            panel.set_axis_off()
    write_figure(figure, FOLDER / "policy_sees.png")
    shipped = read_json(kept("results/latency/left_turn/shipped.json"), "latency report")
    write_figure(draw_axes(shipped["latency"]), FOLDER / "success_against_latency.png")
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
