"""Pictures of rerun's viewer, which runs without a screen for it.

Without a graphics card it draws in software, through Vulkan (Debian's mesa-vulkan-drivers).
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edge_runtime.errors import UserError
from edge_runtime.files import write_atomic
from hil_tests.commands import run_command
from hil_tests.pictures.drive import VEHICLE, recorded_drive
from trainer.training.metrics import read_metrics

SIZE = "1400x900"
NEEDS = "it needs Vulkan, in software with apt install mesa-vulkan-drivers"
START_S, LOOK_S = 60.0, 0.5
LOADED_S, DRAWN_S = 20.0, 5.0
"""Until some 10 MB are in the viewer, and until it has drawn them, in software."""
LOOP_TIME_S = 8.0
TRAINING = ("--episodes", "40", "--seed", "1", "--set", "batch_size=32",
            "--set", "evaluate_every=10", "--set", "evaluation_runs=10")  # fmt: skip


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
    with _viewer() as client:
        client.open(str(rrd.resolve()))
        time.sleep(LOADED_S)
        client.set_time(timeline, **moment, play_state="paused")
        time.sleep(DRAWN_S)
        picture: bytes = client.take_screenshot()
        return picture


@contextlib.contextmanager
def _viewer() -> Iterator[Any]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "rerun", "--headless", "--hide-welcome-screen"]
    command += ["--bind", "127.0.0.1", "--port", str(port), "--window-size", SIZE]
    # A group of its own: the module starts the real viewer as a child, which must end with it.
    viewer = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        yield _connect(viewer, f"rerun+http://127.0.0.1:{port}/proxy")
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait()


def _connect(viewer: subprocess.Popen[bytes], url: str) -> Any:
    from rerun.experimental import ViewerClient

    give_up_s = time.monotonic() + START_S
    while True:
        try:
            client = ViewerClient.connect(url)
            client.get_state()
            return client
        except Exception as error:
            if viewer.poll() is not None or time.monotonic() > give_up_s:
                raise UserError(f"rerun's viewer does not start here ({error}): {NEEDS}") from None
            time.sleep(LOOK_S)
