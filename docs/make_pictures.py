"""Make the pictures of this folder anew: ``python docs/make_pictures.py [NAME.png ...]``."""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from bridge.rerun import LOOPBACK, Viewer, free_port
from edge_runtime.cli import run_cli
from edge_runtime.util import UserError, read_json
from hil_tests.campaign import draw_axes
from hil_tests.processes import POLICY, PUBLIC_KEY, drive_shown, run_command
from trainer.environments import make_environment
from trainer.evaluation import load_driver
from trainer.training.metrics import read_metrics, write_figure
from trainer.util import kept

MOMENTS = {"left_turn": (8, 3.4), "congestion": (3, 5.0)}  # Scenario -> seed and time, s
LOADED_S, DRAWN_S = 20.0, 5.0
"""Until some 10 MB are in the viewer, and until it has drawn them, in software."""


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


def from_above(out: Path, _: Path) -> None:
    Image.fromarray(moment(out.stem)[0].render()).save(out)


def policy_sees(out: Path, _: Path) -> None:
    """Draw both frames of both scenarios, enlarged pixel by pixel."""
    figure = Figure(figsize=(8.6, 5.6), layout="constrained")
    for panels, scenario in zip(figure.subplots(len(MOMENTS), 2), MOMENTS, strict=True):
        frames = moment(scenario)[1]
        for panel, frame, when in zip(panels, frames, ("0.1 s ago", "now"), strict=True):
            panel.imshow(np.asarray(frame), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            panel.set_title(f"{scenario.replace('_', ' ')}, {when}: 80 x 45 pixels", fontsize=10)
            panel.set_axis_off()
    write_figure(figure, out)


def success_against_latency(out: Path, _: Path) -> None:
    shipped = Path(kept("results/latency/left_turn/shipped.json"))
    write_figure(draw_axes(read_json(shipped, "latency report")["latency"]), out)


def rerun_loop(out: Path, work: Path) -> None:
    """Show the loop, some seconds into a drive in real time whose network fails once."""
    drive, rrd = work / "drive.mcap", work / "loop.rrd"
    network = "--clock realtime --latency 50ms+-10ms,outage=0.4s@3s --episodes 2 --seed 8"
    trust = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY))
    record = ("record", "--out", str(drive), "--wait-s", "30")
    drive_shown("pictures", trust, tuple(network.split()), record)
    run_command("bridge", "view", str(drive), "--vehicle-id", "pictures", "--save", str(rrd))
    screenshot(out, rrd, "sim_time", duration=8.0)


def rerun_training(out: Path, work: Path) -> None:
    """Show a short training at its end."""
    rrd = work / "training.rrd"
    words = "--episodes 40 --seed 1 --set batch_size=32 --set evaluate_every_steps=10"
    words += f" --set evaluation_runs=10 --rerun {rrd} --out {work}/training"
    run_command("trainer", "train", *words.split())
    last = int(read_metrics(work / "training")[-1]["total_steps"]) - 1
    screenshot(out, rrd, "step", sequence=last)


def screenshot(out: Path, rrd: Path, timeline: str, **moment: Any) -> None:
    """Write a recording's picture in rerun's viewer, without a screen.

    ``moment`` is where the cursor stands on the timeline, as ``ViewerClient.set_time`` takes it.
    Without a graphics card it draws in software, through Vulkan (Debian's mesa-vulkan-drivers).
    """
    from rerun.experimental import ViewerClient

    port = free_port()
    options = ["--headless", "--hide-welcome-screen", "--window-size", "1400x900"]
    viewer = Viewer([*options, "--port", str(port)], [port])
    try:
        client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        client.open(str(rrd.resolve()))
        time.sleep(LOADED_S)
        client.set_time(timeline, **moment, play_state="paused")
        time.sleep(DRAWN_S)
        out.write_bytes(client.take_screenshot())
    finally:
        viewer.end()


PICTURES: dict[str, Callable[[Path, Path], None]] = {
    "left_turn.png": from_above,
    "congestion.png": from_above,
    "policy_sees.png": policy_sees,
    "success_against_latency.png": success_against_latency,
    "rerun.png": rerun_loop,
    "rerun_training.png": rerun_training,
}
"""Name -> what writes it, given its path and a directory for what is made on the way."""


def main(names: list[str], out: Path = Path(__file__).parent) -> int:
    """Make the named pictures, or all."""
    if not set(names) <= set(PICTURES):
        raise UserError(f"choose from {', '.join(PICTURES)}")
    with tempfile.TemporaryDirectory(prefix="phil-pictures-") as folder:
        for name in names or PICTURES:
            PICTURES[name](out / name, Path(folder))
            print(out / name)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
