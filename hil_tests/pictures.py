"""``python -m hil_tests pictures``: every picture of the READMEs, made by commands."""

from __future__ import annotations

import argparse
import io
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.files import check_writable, make_directory, write_atomic
from edge_runtime.util import UserError, read_json
from hil_tests.loop_picture import VEHICLE_ID, loop, recorded_drive
from hil_tests.processes import headless_viewer, run_command
from hil_tests.report import write_figures
from trainer.drivers import load_driver, make_environment
from trainer.scenarios import SCENARIOS
from trainer.training.metrics import read_metrics

MOMENTS = {"left_turn": (8, 3.4), "congestion": (3, 5.0)}
"""Scenario -> seed and time, s."""
FILM_POLICY, FILM_SEED = "constant:0.3", "40"
"""Always the same throttle, and a drive in which it would meet a car, once: the guide brakes, hands
the wheel back when the car stands, and the next gap is wide enough."""
RUNS = Path("results/units/left_turn/phil_td3/normal")
SHIPPED = Path("results/latency/left_turn/shipped.json")
LOADED_S, DRAWN_S = 20.0, 5.0
"""Until some 10 MB are in the viewer, and until it has drawn them, in software."""
LOOP_TIME_S = 8.0
TRAINING = ("--episodes", "40", "--seed", "1", "--set", "batch_size=32",
            "--set", "evaluate_every_steps=10", "--set", "evaluation_runs=10")  # fmt: skip
SCALE, MARGIN, TITLE_PIXELS = 5, 16, 26
PAPER, INK = (255, 255, 255), (30, 34, 40)
SOME_MISSING = 1
"""Exit status where a picture could not be made here."""
EXAMPLE = examples(
    "python -m hil_tests pictures --out docs",
    "python -m hil_tests pictures take_over.gif loop.png --out runs",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "names", metavar="NAME", nargs="*", help=f"of {', '.join(PICTURES)} (default: all)"
    )
    parser.add_argument("--out", metavar="DIR", default="docs", help="where they go")
    parser.add_argument(
        "--work",
        metavar="DIR",
        help="keep what is made on the way (default: thrown away)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Make them; returns the exit status.

    Raises:
        UserError: no such picture, or nowhere to put it.
    """
    names = arguments.names or list(PICTURES)
    for name in names:
        if name not in PICTURES:
            raise UserError(f"no picture {name!r}: choose from {', '.join(PICTURES)}")
    out = Path(arguments.out)
    for name in names:
        check_writable(out / name)
    if arguments.work is not None:
        make_directory(Path(arguments.work))
        return _make(names, out, Path(arguments.work))
    with tempfile.TemporaryDirectory(prefix="phil-pictures-") as work:
        return _make(names, out, Path(work))


def _make(names: list[str], out: Path, work: Path) -> int:
    """Make each; one that cannot be made here does not keep the others from it."""
    missing = []
    for name in names:
        try:
            PICTURES[name](out / name, work)
        except UserError as error:
            missing.append(name)
            print(f"{name}: not made: {error}", file=sys.stderr)
        else:
            print(f"{out / name}: {(out / name).stat().st_size / 1000:.0f} kB")
    return SOME_MISSING if missing else 0


def left_turn(out: Path, _work: Path) -> None:
    """The left turn from above."""
    _from_above("left_turn", out)


def congestion(out: Path, _work: Path) -> None:
    """The congestion from above."""
    _from_above("congestion", out)


def _from_above(scenario: str, out: Path) -> None:
    seed, time_s = MOMENTS[scenario]
    moment = ("--scenario", scenario, "--seed", str(seed), "--time", f"{time_s:g}")
    run_command("trainer", "picture", "expert", *moment, "--out", str(out))


def policy_sees(out: Path, _work: Path) -> None:
    """Both frames of both scenarios, enlarged pixel by pixel."""
    rows = [_row(scenario, *MOMENTS[scenario]) for scenario in SCENARIOS]
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


def learning_curve(out: Path, _work: Path) -> None:
    """Three seeds of PHIL-TD3 in the left turn."""
    run_dirs = sorted(str(path) for path in RUNS.glob("seed_*"))
    run_command("trainer", "plot", *run_dirs, "--out", str(out))


def success_against_latency(out: Path, work: Path) -> None:
    """The shipped policy behind worse and worse networks."""
    report = read_json(SHIPPED, "latency report")
    names = write_figures(work / SHIPPED.name, report["latency"])
    shutil.copyfile(work / names["success"], out)


def rerun_loop(out: Path, work: Path) -> None:
    """The view of the loop, some seconds into the recorded drive."""
    rrd = work / "loop.rrd"
    recording = str(recorded_drive(work))
    words = ("--vehicle-id", VEHICLE_ID, "--save", str(rrd))
    run_command("bridge", "view", recording, *words)
    write_atomic(out, screenshot(rrd, "sim_time", duration=LOOP_TIME_S))


def rerun_training(out: Path, work: Path) -> None:
    """The view of a short training, at its end."""
    rrd = work / "training.rrd"
    words = (*TRAINING, "--rerun", str(rrd), "--out", str(work / "training"))
    run_command("trainer", "train", *words)
    rows = read_metrics(work / "training")
    last = int(rows[-1]["total_steps"]) - 1
    write_atomic(out, screenshot(rrd, "step", sequence=last))


def screenshot(rrd: Path, timeline: str, **moment: float) -> bytes:
    """The viewer's window with this recording as a PNG.

    Args:
        rrd: the recording.
        timeline: which one is active.
        moment: where the cursor stands, as ``ViewerClient.set_time`` takes it.

    Raises:
        UserError: the viewer does not start here.
    """
    with headless_viewer() as client:
        client.open(str(rrd.resolve()))
        time.sleep(LOADED_S)
        client.set_time(timeline, **moment, play_state="paused")
        time.sleep(DRAWN_S)
        picture: bytes = client.take_screenshot()
        return picture


PICTURES: dict[str, Callable[[Path, Path], None]] = {
    "left_turn.png": left_turn,
    "congestion.png": congestion,
    "policy_sees.png": policy_sees,
    "take_over.gif": take_over,
    "cockpit.png": cockpit,
    "learning_curve.png": learning_curve,
    "success_against_latency.png": success_against_latency,
    "loop.png": loop,
    "rerun.png": rerun_loop,
    "rerun_training.png": rerun_training,
}
"""File -> writes it, given its path and a directory for what is made on the way."""
