"""The loop with its latencies, drawn from a recording: what each state met on its way.

The drive is the shipped policy's, in real time, with a mock vehicle and a network that fails once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from bridge.messages import Scene, decode_scene
from bridge.recording import Recording, read_heard
from bridge.rerun.wire_view import Timeline
from edge_runtime import wire
from edge_runtime.link_probe import free_endpoint
from edge_runtime.wire import CONTROL_PERIOD_S
from hil_tests.processes import POLICY, PUBLIC_KEY, BackgroundCommand, Operator, run_command
from hil_tests.report import write_png

VEHICLE_ID = "pictures"
LATENCY = "50ms+-10ms,outage=0.4s@3s"
EPISODES, SEED = 2, 8
PATIENCE_S = 30.0
PARTS = {
    "uplink": "#2878e6",
    "inference and queue": "#3caa5a",
    "downlink (where the simulator told it)": "#9650c8",
}
STOPPED, LOST = "#dc3232", "0.5"


def loop(out: Path, work: Path) -> None:
    """Speed and mode above, and each state's round trip in its parts below."""
    found = Trips()
    for message in _messages(recorded_drive(work)):
        found.take(message)
    figure = Figure(figsize=(10, 5.4), layout="constrained")
    speed, latency = figure.subplots(2, 1, sharex=True, height_ratios=(1, 1.5))
    trips = sorted(found.trips.values(), key=lambda trip: trip.time_s)
    _draw_speed(speed, trips, found.lost_s())
    _draw_latency(latency, trips)
    _mark_begins((speed, latency), found.begins_s())
    figure.suptitle(f"bridge simulate --clock realtime --latency {LATENCY}", fontsize=11)
    write_png(out, figure)


def _messages(recording: Path) -> Iterator[Any]:
    decoders = {
        "state": wire.decode_state,
        "command": wire.decode_command,
        "scene": decode_scene,
    }
    for heard in read_heard(Recording(recording), VEHICLE_ID):
        if heard.topic in decoders:
            yield decoders[heard.topic](heard.payload)


def _mark_begins(panels: Sequence[Any], begins_s: list[float]) -> None:
    for panel in panels:
        for begin_s in begins_s:
            panel.axvline(begin_s, color="black", linestyle="--", linewidth=1)
    for begin_s in begins_s:
        panels[0].annotate(
            "next episode", (begin_s, 1.0), (4, -4), xycoords=("data", "axes fraction"),
            textcoords="offset points", va="top", fontsize=9,
        )  # fmt: skip


def _draw_speed(panel: Any, trips: list[Trip], lost_s: list[float]) -> None:
    panel.plot([trip.time_s for trip in trips], [trip.speed_mps for trip in trips], color="0.2")
    panel.set_ylabel("speed, m/s")
    stopped_s = [trip.time_s for trip in trips if trip.mode == wire.SAFE_STOP]
    low, high = panel.get_ylim()
    for times_s, colour, label in (
        (lost_s, LOST, "the state was lost"),
        (stopped_s, STOPPED, "answered with a safe stop"),
    ):
        bars = {"color": colour, "alpha": 0.35, "align": "edge", "linewidth": 0, "zorder": 0}
        panel.bar(times_s, high - low, CONTROL_PERIOD_S, bottom=low, label=label, **bars)
    panel.set_ylim(low, high)
    panel.legend(loc="lower right", fontsize=9)
    panel.grid(alpha=0.3)


def _draw_latency(panel: Any, trips: list[Trip]) -> None:
    times_s = [trip.time_s for trip in trips]
    bottoms = [0.0] * len(trips)
    for number, (name, colour) in enumerate(PARTS.items()):
        heights = [trip.parts_ms[number] for trip in trips]
        panel.bar(
            times_s, heights, CONTROL_PERIOD_S, bottom=bottoms, color=colour, label=name,
            align="edge", linewidth=0,
        )  # fmt: skip
        bottoms = [bottom + height for bottom, height in zip(bottoms, heights, strict=True)]
    panel.set_ylabel("state sent to command received, ms")
    panel.set_xlabel("simulated time, s, the episodes end to end")
    panel.legend(loc="upper right", fontsize=9, ncols=3)
    panel.grid(alpha=0.3, axis="y")
    panel.set_ylim(0, 1.25 * max(bottoms, default=1.0))


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


class Trips:
    """A drive's states by episode and step, in their order."""

    def __init__(self) -> None:
        self.trips: dict[tuple[int, int], Trip] = {}
        self._timeline = Timeline()

    def take(self, message: Any) -> None:
        """Take a message of the wire."""
        if isinstance(message, wire.State) and not message.final:
            key = (message.episode, message.step)
            time_s = self._timeline.place(*key).sim_time_s
            self.trips[key] = Trip(time_s, message.sent_ns, message.speed_mps)
        elif isinstance(message, wire.Command):
            trip = self.trips.get((message.episode, message.step))
            if trip is not None and trip.answered_ns is None:
                trip.received_ns, trip.answered_ns = message.received_ns, message.sent_ns
                trip.mode = message.mode
        elif isinstance(message, Scene) and message.answered_step is not None:
            trip = self.trips.get((message.episode, message.answered_step))
            if trip is not None:
                trip.round_trip_ms = message.round_trip_ms

    def begins_s(self) -> list[float]:
        """When the first episode ended and the next ones began."""
        first_s: dict[int, float] = {}
        for (episode, _), trip in self.trips.items():
            first_s.setdefault(episode, trip.time_s)
        return sorted(first_s.values())[1:]

    def lost_s(self) -> list[float]:
        """When a state was due that never came out of the network, since the first one that did."""
        times_s = [trip.time_s for trip in self.trips.values()]
        there = {round(time_s / CONTROL_PERIOD_S) for time_s in times_s}
        return [n * CONTROL_PERIOD_S for n in range(min(there), max(there)) if n not in there]


def recorded_drive(work: Path) -> Path:
    """The recording of the drive, made once for all pictures of it."""
    out = work / "drive.mcap"
    if not out.exists():
        _drive(out)
    return out


def _drive(out: Path) -> None:
    endpoint = free_endpoint()
    common = ("--connect", endpoint, "--vehicle-id", VEHICLE_ID)
    trust = ("--policy", str(POLICY), "--public-key", str(PUBLIC_KEY))
    with ExitStack() as stack:
        edge = ("edge_runtime", "run", *trust, *common, "--vehicle", "mock")
        stack.enter_context(BackgroundCommand(*edge, ready="ready"))
        record = ("bridge", "record", "--out", str(out), *common, "--wait-s", "30")
        recorder = stack.enter_context(BackgroundCommand(*record))
        stack.enter_context(Operator(endpoint, VEHICLE_ID))
        run_command(
            "bridge", "simulate", "--env", "left_turn", "--clock", "realtime",
            "--latency", LATENCY, "--episodes", str(EPISODES), "--seed", str(SEED),
            "--listen", endpoint, "--vehicle-id", VEHICLE_ID,
        )  # fmt: skip
        recorder.wait(PATIENCE_S)
