"""The wire's messages, written into a rerun recording. No socket, no clock: time is passed in."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence

import rerun as rr

from bridge.scene import Scene
from bridge.viewer.blueprint import SERIES, make_blueprint
from edge_runtime.latency.command_hold import SILENCE_LIMIT_S
from edge_runtime.wire import Command, Feedback, Health, State
from viewing.colours import POLICY
from viewing.pace import Pace
from viewing.road import draw_cars, draw_ground
from viewing.series import BLUE, GREY, ORANGE, RED, style_lines
from viewing.timeline import Moment, Timeline

SILENT = "no command"
NOTHING_WRONG = "-"
REMEMBERED_STATES = 64
"""States whose sending time is kept, for the latency of their commands."""
EGO = {"drive": POLICY, "safe_stop": RED, SILENT: (160, 30, 120)}
"""Colour of the ego car by what it is told."""
ALL = "all"
"""The sum over the reasons, which has a line from the start."""
SIDES = {"edge": ORANGE, "simulator": BLUE}
"""Who rejects, and the colour of all that it has rejected."""


class WireLog:
    """Draws the messages of one vehicle; used by one thread.

    Args:
        recording: where.
        picture_interval_s: frames and scenes are drawn no more often than this by their arrival;
            numbers always are. 0: all, as in a file, where simulated time is what counts.
    """

    def __init__(self, recording: rr.RecordingStream, picture_interval_s: float = 0.0) -> None:
        self._recording = recording
        self._frames_pace, self._cars_pace = Pace(picture_interval_s), Pace(picture_interval_s)
        self._timeline = Timeline()
        self._told, self._reason = "", ""
        self._heard_command_ns: int | None = None
        self._sent_ns: OrderedDict[tuple[int, int], int] = OrderedDict()
        self._answered_ns: OrderedDict[tuple[int, int], int] = OrderedDict()
        """From the sending of a state to that of its command, by the stamps of both."""
        self._split: tuple[int, int] | None = None
        """The state whose round trip was drawn in its parts last."""
        self._edge_counts: dict[str, int] = {}
        self._reasons: set[tuple[str, str]] = set()
        self._drawn_episode = -1
        self._health: Health | None = None
        self._define_series()

    def write_state(self, state: State, arrived_ns: int) -> None:
        """Draw the frames and the speed; a state after 2 T without a command shows the silence."""
        self._stand_at(self._timeline.place(state.episode, state.step))
        self._remember(state)
        if self._frames_pace.due(arrived_ns * 1e-9):
            before, now = state.frames_array()
            self._recording.log("frames/before", rr.Image(before, color_model="L"))
            self._recording.log("frames/now", rr.Image(now, color_model="L"))
        self._scalar("speed/simulated", state.speed_mps)
        if state.step == 0:
            self._event(f"episode {state.episode} begins")
        if state.final:
            self._event(f"episode {state.episode} ends at step {state.step}")
        if self._heard_command_ns is None:
            # A viewer that comes late has not yet had the time to hear one.
            self._heard_command_ns = arrived_ns
        silent = arrived_ns - self._heard_command_ns > SILENCE_LIMIT_S * 1e9
        # Between two episodes nobody owes a command.
        if silent and state.step > 0 and not state.final:
            self._scalar("action/asked", math.nan)  # A gap in the line: nothing is asked.
            self._tell(SILENT, "the simulator brakes by itself", rr.TextLogLevel.WARN)

    def write_command(self, command: Command, arrived_ns: int) -> None:
        """Draw what is asked, the mode, and where the time went."""
        self._stand_at(self._timeline.place(command.episode, command.step))
        self._heard_command_ns = arrived_ns
        self._action("action/asked", command.action)
        sent_ns = self._sent_ns.get((command.episode, command.step))
        if sent_ns is not None:
            self._scalar("latency/uplink", (command.received_ns - sent_ns) * 1e-6)
            # A safe stop is repeated for as long as it lasts: only the first is the answer.
            if (command.episode, command.step) not in self._answered_ns:
                answered_ns = command.sent_ns - sent_ns
                _keep(self._answered_ns, (command.episode, command.step), answered_ns)
        self._scalar("latency/inference", command.inference_ns * 1e-6)
        driving = command.mode == "drive"
        level = rr.TextLogLevel.INFO if driving else rr.TextLogLevel.WARN
        self._tell(command.mode, command.reason, level)

    def write_feedback(self, feedback: Feedback, _arrived_ns: int) -> None:
        """Draw what the vehicle has reached."""
        self._action("action/achieved", feedback.action)
        self._scalar("speed/vehicle", feedback.speed_mps)

    def write_health(self, health: Health, _arrived_ns: int) -> None:
        """Refresh the status text, and note what the edge runtime has newly rejected."""
        for reason, count in health.rejected.items():
            new = count - self._edge_counts.get(reason, 0)
            if new > 0:
                self._event(f"edge rejected {new} states: {reason}", rr.TextLogLevel.WARN)
        self._edge_counts = dict(health.rejected)
        self._rejections("edge", health.rejected)
        self._health = health
        self._write_status()

    def write_scene(self, scene: Scene, arrived_ns: int) -> None:
        """Draw the road from above; the first scene also decides which ground is shown."""
        self._stand_at(self._timeline.place(scene.episode, scene.step))
        if self._drawn_episode < 0:
            self._recording.send_blueprint(make_blueprint(scene))
        if self._drawn_episode != scene.episode:
            self._drawn_episode = scene.episode
            draw_ground(self._recording, scene)
        self._round_trip(scene)
        self._rejections("simulator", scene.rejected)
        if self._cars_pace.due(arrived_ns * 1e-9):
            draw_cars(self._recording, scene, EGO[self._told or SILENT])

    def write_unreadable(self, topic: str, why: str) -> None:
        """Note a message that the viewer cannot read."""
        self._event(f"unreadable {topic}: {why}", rr.TextLogLevel.ERROR)

    def _define_series(self) -> None:
        style_lines(self._recording, SERIES)
        for side, colour in SIDES.items():
            self._style_rejections(side, ALL, colour)
        lanes = rr.StateConfiguration(values=list(EGO), labels=list(EGO), colors=list(EGO.values()))
        self._recording.log("mode/mode", lanes, static=True)
        quiet = rr.StateConfiguration(values=[NOTHING_WRONG], labels=[" "], colors=[GREY])
        self._recording.log("mode/reason", quiet, static=True)

    def _stand_at(self, moment: Moment) -> None:
        recording = self._recording
        recording.reset_time()
        recording.set_time("sim_time", duration=moment.sim_time_s)
        recording.set_time("step", sequence=moment.total_step)
        recording.set_time(f"episode_{moment.episode}", duration=moment.episode_time_s)

    def _remember(self, state: State) -> None:
        _keep(self._sent_ns, (state.episode, state.step), state.sent_ns)

    def _round_trip(self, scene: Scene) -> None:
        """The newest round trip, and what is left of it for the way down."""
        if scene.round_trip_ms is None or scene.answered_step is None:
            return
        self._scalar("latency/round_trip", scene.round_trip_ms)
        answered_ns = self._answered_ns.get((scene.episode, scene.answered_step))
        # It is told with every scene until the next one is known.
        is_new = (scene.episode, scene.answered_step) != self._split
        if answered_ns is not None and is_new:
            self._split = (scene.episode, scene.answered_step)
            self._scalar("latency/downlink", scene.round_trip_ms - answered_ns * 1e-6)

    def _rejections(self, side: str, counts: Mapping[str, int]) -> None:
        self._scalar(f"rejected/{side}/{ALL}", sum(counts.values()))
        for reason, count in counts.items():
            if count and (side, reason) not in self._reasons:
                self._reasons.add((side, reason))
                self._style_rejections(side, reason, GREY)
                self._scalar(f"rejected/{side}/{reason}", 0)
            if count:
                self._scalar(f"rejected/{side}/{reason}", count)

    def _style_rejections(self, side: str, reason: str, colour: tuple[int, int, int]) -> None:
        style = rr.SeriesLines(colors=[colour], names=[f"{side}: {reason}"], widths=[2.0])
        self._recording.log(f"rejected/{side}/{reason}", style, static=True)

    def _tell(self, mode: str, reason: str, level: rr.TextLogLevel) -> None:
        """Draw the mode where it changes."""
        if (mode, reason) == (self._told, self._reason):
            return
        self._told, self._reason = mode, reason
        self._recording.log("mode/mode", rr.StateChange(state=mode))
        self._recording.log("mode/reason", rr.StateChange(state=reason or NOTHING_WRONG))
        self._event(f"{mode}: {reason}" if reason else mode, level)
        self._write_status()

    def _action(self, path: str, action: Sequence[float]) -> None:
        self._recording.log(path, rr.Scalars(list(action)))

    def _scalar(self, path: str, value: float) -> None:
        self._recording.log(path, rr.Scalars(value))

    def _event(self, text: str, level: rr.TextLogLevel = rr.TextLogLevel.INFO) -> None:
        self._recording.log("events", rr.TextLog(text, level=level))

    def _write_status(self) -> None:
        lines = [f"# {self._told or 'waiting'}", self._reason]
        if self._health is not None:
            lines += _health_lines(self._health)
        text = "\n\n".join(line for line in lines if line)
        self._recording.log("status", rr.TextDocument(text, media_type="text/markdown"))


def _keep(table: OrderedDict[tuple[int, int], int], key: tuple[int, int], value: int) -> None:
    table[key] = value
    if len(table) > REMEMBERED_STATES:
        table.popitem(last=False)


def _health_lines(health: Health) -> list[str]:
    rejected = ", ".join(f"{reason} {count}" for reason, count in health.rejected.items() if count)
    return [
        f"policy `{health.policy_id[:12]}`, vehicle `{health.vehicle}`",
        f"states accepted {health.accepted}, rejected: {rejected or 'none'}",
        f"safe stops {health.safe_stops}, deadline misses {health.deadline_misses}",
        "inference p50 {p50:.2f} ms, p99 {p99:.2f} ms".format(**health.inference_ms)
        if {"p50", "p99"} <= set(health.inference_ms)
        else "",
    ]
