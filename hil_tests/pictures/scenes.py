"""Pictures of the scenarios: from above, as the policy sees them, and a film of a take-over."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from edge_runtime.files import write_atomic
from hil_tests.commands import run_command
from trainer.drivers import load_driver, make_environment
from trainer.scenarios import SCENARIOS

LEFT_TURN_MOMENT = ("--seed", "8", "--time", "3.4")
CONGESTION_MOMENT = ("--seed", "3", "--time", "5")
FILM_POLICY, FILM_SEED = "constant:0.3", "40"
"""Always the same throttle, and a drive in which it would meet a car, once: the guide brakes, hands
the wheel back when the car stands, and the next gap is wide enough."""
SEEN_MOMENTS = {"left_turn": (8, 3.4), "congestion": (3, 5.0)}
"""Scenario -> seed and time, s."""
SCALE, MARGIN, TITLE_PIXELS = 5, 16, 26
PAPER, INK = (255, 255, 255), (30, 34, 40)


def left_turn(out: Path, _work: Path) -> None:
    """The left turn from above."""
    run_command("trainer", "picture", "expert", *LEFT_TURN_MOMENT, "--out", str(out))


def congestion(out: Path, _work: Path) -> None:
    """The congestion from above."""
    words = ("--scenario", "congestion", *CONGESTION_MOMENT)
    run_command("trainer", "picture", "expert", *words, "--out", str(out))


def policy_sees(out: Path, _work: Path) -> None:
    """Both frames of both scenarios, enlarged pixel by pixel."""
    rows = [_row(scenario, *SEEN_MOMENTS[scenario]) for scenario in SCENARIOS]
    width = max(row.width for row in rows)
    picture = Image.new("RGB", (width, sum(row.height for row in rows)), PAPER)
    top = 0
    for row in rows:
        picture.paste(row, (0, top))
        top += row.height
    buffer = io.BytesIO()
    picture.save(buffer, format="png", optimize=True)
    write_atomic(out, buffer.getvalue())


def take_over(out: Path, _work: Path) -> None:
    """The same throttle throughout, and the scripted expert brakes for a car."""
    words = ("--human", "expert", "--seed", FILM_SEED, "--time", "15")
    run_command("trainer", "picture", FILM_POLICY, *words, "--out", str(out))


def cockpit(out: Path, _work: Path) -> None:
    """The browser cockpit in the middle of a take-over; needs Chromium."""
    run_command("trainer.person.tests.browser", "--picture", str(out))


def _row(scenario: str, seed: int, time_s: float) -> Image.Image:
    frames = _frames(scenario, seed, time_s)
    size = (frames.shape[2] * SCALE, frames.shape[1] * SCALE)
    width = MARGIN + 2 * (size[0] + MARGIN)
    row = Image.new("RGB", (width, TITLE_PIXELS + size[1] + MARGIN), PAPER)
    pen = ImageDraw.Draw(row)
    for number, (frame, when) in enumerate(zip(frames, ("0.1 s ago", "now"), strict=True)):
        left = MARGIN + number * (size[0] + MARGIN)
        enlarged = Image.fromarray(frame).resize(size, Image.Resampling.NEAREST)
        row.paste(enlarged.convert("RGB"), (left, TITLE_PIXELS))
        title = f"{scenario.replace('_', ' ')}, {when}: 80 x 45 pixels"
        pen.text((left, TITLE_PIXELS - 7), title, fill=INK, anchor="ls", font_size=15)
    return row


def _frames(scenario: str, seed: int, time_s: float) -> np.ndarray:
    env = make_environment(scenario)
    driver, _ = load_driver("expert", env)
    observation, _ = env.reset(seed=seed)
    driver.reset()
    for _ in range(round(time_s / env.config.control_period_s)):
        observation, *_ = env.step(driver.act(observation))
    return np.asarray(observation)
