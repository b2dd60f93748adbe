"""``python -m hil_tests pictures``: every picture of the READMEs, made by commands.

The loop's own pictures are drawn from a recording: the shipped policy in real time, with a mock
vehicle and a network that fails once.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bridge.messages import Scene, decode_scene
from bridge.recording import Recording, read_heard
from bridge.rerun.wire_view import Timeline
from edge_runtime import wire
from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError, read_json
from edge_runtime.wire import CONTROL_PERIOD_S
from hil_tests.processes import (
    POLICY,
    PUBLIC_KEY,
    drive_shown,
    headless_viewer,
    run_command,
)
from hil_tests.report import write_figures, write_png
from trainer.drivers import load_driver, make_environment
from trainer.training.metrics import read_metrics

MOMENTS = {"left_turn": ("8", "3.4"), "congestion": ("3", "5.0")}
"""Scenario -> seed and time, s."""
FILM_POLICY, FILM_SEED = "constant:0.3", "40"
"""Always the same throttle, and a drive in which it would meet a car, once: the guide brakes, hands
the wheel back when the car stands, and the next gap is wide enough."""
SHIPPED = Path("results/latency/left_turn/shipped.json")
LOADED_S, DRAWN_S = 20.0, 5.0
"""Until some 10 MB are in the viewer, and until it has drawn them, in software."""
TRAINING = ("--episodes", "40", "--seed", "1", "--set", "batch_size=32",
            "--set", "evaluate_every_steps=10", "--set", "evaluation_runs=10")  # fmt: skip
VEHICLE_ID = "pictures"
LATENCY = "50ms+-10ms,outage=0.4s@3s"
EPISODES, SEED = "2", "8"
LOOP_TIME_S = 8.0
PARTS = {
    "uplink": "#2878e6",
    "inference and queue": "#3caa5a",
    "downlink (where the simulator told it)": "#9650c8",
}
STOPPED, LOST = "#dc3232", "0.5"
SOME_MISSING = 1
"""Exit status where a picture could not be made here."""
EXAMPLE = examples(
    "python -m hil_tests pictures --out docs",
    "python -m hil_tests pictures take_over.gif loop.png --out runs",
)
Make = Callable[[Path, Path], None]
"""Writes a picture, given its path and a directory for what is made on the way."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "names", metavar="NAME", nargs="*", help=f"of {', '.join(PICTURES)} (default: all)"
    )
    parser.add_argument("--out", metavar="DIR", default="docs", help="where they go")


def run(arguments: argparse.Namespace) -> int:
    """Make them, each as far as it can be made here; returns the exit status.

    Raises:
        UserError: no such picture, or nowhere to put it.
    """
    names = arguments.names or list(PICTURES)
    for name in names:
        if name not in PICTURES:
            raise UserError(f"no picture {name!r}: choose from {', '.join(PICTURES)}")
    out, status = Path(arguments.out), 0
    for name in names:
        check_writable(out / name)
    with tempfile.TemporaryDirectory(prefix="phil-pictures-") as folder:
        for name in names:
            try:
                PICTURES[name](out / name, Path(folder))
            except UserError as error:
                status = SOME_MISSING
                print(f"{name}: not made: {error}", file=sys.stderr)
            else:
                print(f"{out / name}: {(out / name).stat().st_size / 1000:.0f} kB")
    return status


def _by_command(*words: str) -> Make:
    return lambda out, _work: run_command(*words, "--out", str(out))


def _from_above(scenario: str) -> Make:
    seed, time_s = MOMENTS[scenario]
    moment = ("--scenario", scenario, "--seed", seed, "--time", time_s)
    return _by_command("trainer", "picture", "expert", *moment)


def policy_sees(out: Path, _work: Path) -> None:
    """Both frames of both scenarios, enlarged pixel by pixel."""
    figure = Figure(figsize=(8.6, 5.6), layout="constrained")
    for row, (scenario, (seed, time_s)) in enumerate(MOMENTS.items()):
        frames = _frames(scenario, int(seed), float(time_s))
        for column, (frame, when) in enumerate(zip(frames, ("0.1 s ago", "now"), strict=True)):
            panel = figure.add_subplot(len(MOMENTS), 2, 2 * row + column + 1)
            panel.imshow(frame, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            panel.set_title(f"{scenario.replace('_', ' ')}, {when}: 80 x 45 pixels", fontsize=10)
            panel.set_axis_off()
    write_png(out, figure)


def _frames(scenario: str, seed: int, time_s: float) -> np.ndarray:
    env = make_environment(scenario)
    driver, _ = load_driver("expert", env)
    observation, _ = env.reset(seed=seed)
    driver.reset()
    for _ in range(round(time_s / env.config.control_period_s)):
        observation, *_ = env.step(driver.act(observation))
    return np.asarray(observation)


def success_against_latency(out: Path, work: Path) -> None:
    """The shipped policy behind worse and worse networks."""
    report = read_json(SHIPPED, "latency report")
    names = write_figures(work / SHIPPED.name, report["latency"])
    shutil.copyfile(work / names["success"], out)


def rerun_loop(out: Path, work: Path) -> None:
    """The view of the loop, some seconds into the recorded drive."""
    rrd = work / "loop.rrd"
    words = ("--vehicle-id", VEHICLE_ID, "--save", str(rrd))
    run_command("bridge", "view", str(recorded_drive(work)), *words)
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


def recorded_drive(work: Path) -> Path:
    """The recording of the drive, made once for all pictures of it."""
    out = work / "drive.mcap"
    if out.exists():
        return out
    trust = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY))
    simulate = ("--clock", "realtime", "--latency", LATENCY, "--episodes", EPISODES, "--seed", SEED)
    drive_shown(VEHICLE_ID, trust, simulate, ("record", "--out", str(out), "--wait-s", "30"))
    return out


@dataclass
class Trip:
    """One state and its answer."""

    time_s: float
    sent_ns: int
    speed_mps: float
    received_ns: int | None = None
    answered_ns: int | None = None
    round_trip_ms: float | None = None
    mode: str = ""

    @property
    def parts_ms(self) -> tuple[float, float, float]:
        """Uplink, runtime and downlink; 0 for what nobody has told."""
        if self.received_ns is None or self.answered_ns is None:
            return 0.0, 0.0, 0.0
        up_ms = (self.received_ns - self.sent_ns) * 1e-6
        inside_ms = (self.answered_ns - self.received_ns) * 1e-6
        if self.round_trip_ms is None:
            return up_ms, inside_ms, 0.0
        return up_ms, inside_ms, max(0.0, self.round_trip_ms - up_ms - inside_ms)


Trips = Mapping[tuple[int, int], Trip]
"""By episode and step, in their order."""


def trips_of(messages: Iterable[Any]) -> Trips:
    """A drive's states with their answers, from the messages of its wire."""
    trips: dict[tuple[int, int], Trip] = {}
    timeline = Timeline()
    for message in messages:
        if isinstance(message, wire.State) and not message.final:
            key = (message.episode, message.step)
            time_s = timeline.place(*key).sim_time_s
            trips[key] = Trip(time_s, message.sent_ns, message.speed_mps)
        elif isinstance(message, wire.Command):
            trip = trips.get((message.episode, message.step))
            if trip is not None and trip.answered_ns is None:
                trip.received_ns, trip.answered_ns = message.received_ns, message.sent_ns
                trip.mode = message.mode
        elif isinstance(message, Scene) and message.answered_step is not None:
            trip = trips.get((message.episode, message.answered_step))
            if trip is not None:
                trip.round_trip_ms = message.round_trip_ms
    return trips


def begins_s(trips: Trips) -> list[float]:
    """When the first episode ended and the next ones began."""
    first_s: dict[int, float] = {}
    for (episode, _), trip in trips.items():
        first_s.setdefault(episode, trip.time_s)
    return sorted(first_s.values())[1:]


def lost_s(trips: Trips) -> list[float]:
    """When a state was due that never came out of the network, since the first one that did."""
    there = {round(trip.time_s / CONTROL_PERIOD_S) for trip in trips.values()}
    return [n * CONTROL_PERIOD_S for n in range(min(there), max(there)) if n not in there]


def _messages(recording: Path) -> Iterator[Any]:
    decoders: dict[str, Callable[[bytes], Any]] = {
        "state": wire.decode_state,
        "command": wire.decode_command,
        "scene": decode_scene,
    }
    for heard in read_heard(Recording(recording), VEHICLE_ID):
        if heard.topic in decoders:
            yield decoders[heard.topic](heard.payload)


def loop(out: Path, work: Path) -> None:
    """Speed and mode above, and each state's round trip in its parts below."""
    found = trips_of(_messages(recorded_drive(work)))
    trips = sorted(found.values(), key=lambda trip: trip.time_s)
    times_s = [trip.time_s for trip in trips]
    figure = Figure(figsize=(10, 5.4), layout="constrained")
    speed, latency = figure.subplots(2, 1, sharex=True, height_ratios=(1, 1.5))
    speed.plot(times_s, [trip.speed_mps for trip in trips], color="0.2")
    speed.set_ylabel("speed, m/s")
    low, high = speed.get_ylim()
    bars = {"width": CONTROL_PERIOD_S, "align": "edge", "linewidth": 0}
    for at_s, colour, label in (
        (lost_s(found), LOST, "the state was lost"),
        ([trip.time_s for trip in trips if trip.mode == wire.SAFE_STOP], STOPPED,
         "answered with a safe stop"),
    ):  # fmt: skip
        style = {"color": colour, "alpha": 0.35, "zorder": 0, "label": label, **bars}
        speed.bar(at_s, high - low, bottom=low, **style)
    speed.set_ylim(low, high)
    speed.legend(loc="lower right", fontsize=9)
    speed.grid(alpha=0.3)
    bottoms = np.zeros(len(trips))
    for (label, colour), heights in zip(
        PARTS.items(), np.array([trip.parts_ms for trip in trips]).T, strict=True
    ):
        latency.bar(times_s, heights, bottom=bottoms, color=colour, label=label, **bars)
        bottoms = bottoms + heights
    latency.set_ylabel("state sent to command received, ms")
    latency.set_xlabel("simulated time, s, the episodes end to end")
    latency.legend(loc="upper right", fontsize=9, ncols=3)
    latency.grid(alpha=0.3, axis="y")
    latency.set_ylim(0, 1.25 * max(bottoms))
    for begin_s in begins_s(found):
        for panel in (speed, latency):
            panel.axvline(begin_s, color="black", linestyle="--", linewidth=1)
        speed.annotate(
            "next episode", (begin_s, 1.0), (4, -4), xycoords=("data", "axes fraction"),
            textcoords="offset points", va="top", fontsize=9,
        )  # fmt: skip
    figure.suptitle(f"bridge simulate --clock realtime --latency {LATENCY}", fontsize=11)
    write_png(out, figure)


PICTURES: dict[str, Make] = {
    "left_turn.png": _from_above("left_turn"),
    "congestion.png": _from_above("congestion"),
    "policy_sees.png": policy_sees,
    # The same throttle throughout, and the scripted expert brakes for a car.
    "take_over.gif": _by_command(
        "trainer", "picture", FILM_POLICY, "--human", "expert", "--seed", FILM_SEED, "--time", "15"
    ),
    # In the middle of a take-over; needs Chromium.
    "cockpit.png": lambda out, _work: run_command(
        "trainer.person.tests.browser", "--picture", str(out)
    ),
    "success_against_latency.png": success_against_latency,
    "loop.png": loop,
    "rerun.png": rerun_loop,
    "rerun_training.png": rerun_training,
}
