"""Make the pictures of this folder anew: ``python docs/make_pictures.py [NAME.png ...]``."""

from __future__ import annotations

import asyncio
import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from bridge.rerun import LOOPBACK, Viewer, ViewerGone, free_port
from edge_runtime.cli import run_cli
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError, read_json
from hil_tests.campaign import draw_axes
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, drive_shown, run_command
from trainer.environments import make_environment
from trainer.evaluation import load_driver
from trainer.person.tests.browser import (
    PERSON_DRIVES,
    POLICY_DRIVES,
    open_browser,
    quit_sitting,
    until,
)
from trainer.training.metrics import read_metrics, write_figure
from trainer.util import kept

MOMENTS = {"left_turn": (8, 3.4), "congestion": (3, 5.0)}  # Scenario -> seed and time, s
SHIPPED = Path(kept("results/latency/left_turn/shipped.json"))
WINDOW = "1400x900"
LOADED_S, DRAWN_S = 20.0, 5.0
"""Until some 10 MB are in the viewer, and until it has drawn them, in software."""
TRAINING = ("--episodes", "40", "--seed", "1", "--set", "batch_size=32",
            "--set", "evaluate_every_steps=10", "--set", "evaluation_runs=10")  # fmt: skip
VEHICLE_ID = "pictures"
NETWORK = ("--clock", "realtime", "--latency", "50ms+-10ms,outage=0.4s@3s", "--episodes", "2",
           "--seed", "8")  # fmt: skip
LOOP_TIME_S = 8.0
TRUST = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY))
TAKE_OVERS = 12  # Before the picture of the cockpit
SOME_MISSING = 1  # Exit status where a picture could not be made here
Make = Callable[[Path, Path], None]
"""Writes a picture, given its path and a directory for what is made on the way."""


def make_pictures(names: Sequence[str], out: Path = Path(__file__).parent) -> int:
    """Make the named pictures, or all; return the exit status, 1 where one cannot be made here.

    Raises UserError for an unknown name.
    """
    if unknown := set(names) - set(PICTURES):
        raise UserError(f"no picture {unknown.pop()!r}: choose from {', '.join(PICTURES)}")
    status = 0
    with tempfile.TemporaryDirectory(prefix="phil-pictures-") as folder:
        for name in names or PICTURES:
            try:
                PICTURES[name](out / name, Path(folder))
            except UserError as error:
                status = SOME_MISSING
                print(f"{name}: not made: {error}", file=sys.stderr)
            else:
                print(f"{out / name}: {(out / name).stat().st_size / 1000:.0f} kB")
    return status


def _moment(scenario: str) -> tuple[Any, Any]:
    """The environment there, the expert driving, and what is observed."""
    seed, time_s = MOMENTS[scenario]
    env = make_environment(scenario)
    driver, _ = load_driver("expert", env)
    frames, _ = env.reset(seed=seed)
    driver.reset()
    for _ in range(round(time_s / env.control_period_s)):
        frames, *_ = env.step(driver.act(frames))
    return env, frames


def _from_above(scenario: str) -> Make:
    def make(out: Path, _work: Path) -> None:
        buffer = io.BytesIO()
        Image.fromarray(_moment(scenario)[0].render()).save(buffer, format="png")
        write_atomic(out, buffer.getvalue())

    return make


def policy_sees(out: Path, _work: Path) -> None:
    """Both frames of both scenarios, enlarged pixel by pixel."""
    figure = Figure(figsize=(8.6, 5.6), layout="constrained")
    for row, scenario in enumerate(MOMENTS):
        _, frames = _moment(scenario)
        for column, (frame, when) in enumerate(zip(frames, ("0.1 s ago", "now"), strict=True)):
            panel = figure.add_subplot(len(MOMENTS), 2, 2 * row + column + 1)
            panel.imshow(np.asarray(frame), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            panel.set_title(f"{scenario.replace('_', ' ')}, {when}: 80 x 45 pixels", fontsize=10)
            panel.set_axis_off()
    write_figure(figure, out)


def success_against_latency(out: Path, _work: Path) -> None:
    """The shipped policy behind worse and worse networks."""
    write_figure(draw_axes(read_json(SHIPPED, "latency report")["latency"]), out)


def rerun_loop(out: Path, work: Path) -> None:
    """The view of the loop, some seconds into a drive in real time whose network fails once."""
    drive, rrd = work / "drive.mcap", work / "loop.rrd"
    record = ("record", "--out", str(drive), "--wait-s", "30")
    drive_shown(VEHICLE_ID, TRUST, NETWORK, record)
    words = ("--vehicle-id", VEHICLE_ID, "--save", str(rrd))
    run_command("bridge", "view", str(drive), *words)
    write_atomic(out, screenshot(rrd, "sim_time", duration=LOOP_TIME_S))


def rerun_training(out: Path, work: Path) -> None:
    """The view of a short training, at its end."""
    rrd = work / "training.rrd"
    words = (*TRAINING, "--rerun", str(rrd), "--out", str(work / "training"))
    run_command("trainer", "train", *words)
    rows = read_metrics(work / "training")
    last = int(rows[-1]["total_steps"]) - 1
    write_atomic(out, screenshot(rrd, "step", sequence=last))


def screenshot(rrd: Path, timeline: str, **moment: Any) -> bytes:
    """The window of rerun's viewer, without a screen, with this recording as a PNG.

    ``moment`` is where the cursor stands on the timeline, as ``ViewerClient.set_time`` takes it.
    Without a graphics card it draws in software, through Vulkan (Debian's mesa-vulkan-drivers).
    Raises UserError where it does not start here, or ends as soon as it is to draw.
    """
    from rerun.experimental import ViewerClient

    port = free_port()
    options = ["--headless", "--hide-welcome-screen", "--window-size", WINDOW]
    with contextlib.ExitStack() as stack:
        try:
            viewer = Viewer([*options, "--port", str(port)], [port])
            stack.callback(viewer.end)
            client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
            client.open(str(rrd.resolve()))
            time.sleep(LOADED_S)
            client.set_time(timeline, **moment, play_state="paused")
            time.sleep(DRAWN_S)
            picture: bytes = client.take_screenshot()
            return picture
        except (ConnectionError, ViewerGone) as error:
            needs = "it needs Vulkan, in software with apt install mesa-vulkan-drivers"
            raise UserError(f"rerun's viewer does not draw here ({error}): {needs}") from None


def cockpit(out: Path, work: Path) -> None:
    """A training in the browser, in the middle of a take-over; it needs Chromium."""
    often = ("--set", "evaluate_every_steps=60", "--set", "evaluation_runs=10")
    words = ("--human", "web", "--seed", "1", *often, "--out", str(work / "cockpit"))
    with Process("trainer", "train", *words) as training:
        training.wait_for_line("cockpit: open ")
        url = next(line for line in training.output.splitlines() if line.startswith("cockpit: "))
        asyncio.run(_take_over(url.split()[-1], out))
        training.succeed()


async def _take_over(url: str, out: Path) -> None:
    async with open_browser() as page:
        await page.goto(url)
        for key, count, seconds in (("ArrowUp", TAKE_OVERS, 1.5), ("ArrowDown", 1, 0.5)):
            for _ in range(count):  # The coach needs something to say.
                await until(page, POLICY_DRIVES)
                await asyncio.sleep(2.5)
                await page.keyboard.down(key)
                await until(page, PERSON_DRIVES)
                await asyncio.sleep(seconds)
                if key == "ArrowDown":
                    await page.screenshot(path=out, full_page=True)
                await page.keyboard.up(key)
        await quit_sitting(page)


PICTURES: dict[str, Make] = {
    "left_turn.png": _from_above("left_turn"),
    "congestion.png": _from_above("congestion"),
    "policy_sees.png": policy_sees,
    "cockpit.png": cockpit,
    "success_against_latency.png": success_against_latency,
    "rerun.png": rerun_loop,
    "rerun_training.png": rerun_training,
}

if __name__ == "__main__":
    sys.exit(run_cli(make_pictures))
