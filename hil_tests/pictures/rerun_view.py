"""Pictures of rerun's viewer with a recording in it."""

from __future__ import annotations

import time
from pathlib import Path

from edge_runtime.files import write_atomic
from hil_tests.commands import run_command
from hil_tests.pictures.drive import VEHICLE, recorded_drive
from hil_tests.pictures.headless import headless_viewer
from trainer.training.metrics import read_metrics

LOADED_S, DRAWN_S = 20.0, 5.0
"""Until some 10 MB are in the viewer, and until it has drawn them, in software."""
LOOP_TIME_S = 8.0
TRAINING = ("--episodes", "40", "--seed", "1", "--set", "batch_size=32",
            "--set", "evaluate_every_steps=10", "--set", "evaluation_runs=10")  # fmt: skip


def rerun_loop(out: Path, work: Path) -> None:
    """The view of the loop, some seconds into the recorded drive."""
    rrd = work / "loop.rrd"
    recording = str(recorded_drive(work))
    words = ("--vehicle-id", VEHICLE, "--save", str(rrd))
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
