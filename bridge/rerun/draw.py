"""Draw a drive in rerun; and ``python -m bridge view``, which draws the wire.

A `Canvas` draws; the functions after it lay out views, also those of ``trainer.view``. Metres; y
grows downwards, as in the scene. Cars are lines: rerun cannot turn its flat boxes.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bridge import messages
from bridge import rerun as shown
from bridge.inbound import BRAKE_PERIODS
from bridge.messages import DECODERS, Heard, Pace, Point, Scene, SeenScene
from bridge.rerun import Colour
from edge_runtime import wire
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.link import link_words
from edge_runtime.manifest import Layout, Task
from edge_runtime.util import UserError, counted
from edge_runtime.wire import DRIVE, Command, Feedback, Health, State

RED, GREY = (220, 50, 50), (120, 124, 130)
MARGIN_M = 8.0  # Ground shown beyond the path
CAMERA = "camera"  # Origin of the view from above
MOST_LINES = 16  # Numbers of an observation that are plotted, at most
MOST_DRAWN = 2**32  # Steps on the time axis: rerun counts its ns in 64 bits
PICTURE_INTERVAL_S = 0.1
"""Ten pictures a second, our usual control rate, are plenty for an eye."""
WHOLE = rrb.TimeRange(start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
"""The whole time axis; without it rerun scrolls the axis with the cursor."""


class Canvas:
    """Draws on a recording at the time that ``stand_at`` has set; used by one thread.

    ``states``: path of each state -> the colours of its values. ``layout`` makes the blueprint; a
    scene fixes the ground shown.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        layout: Callable[[SeenScene | None], rrb.Blueprint],
        states: Mapping[str, Mapping[str, Colour]],
    ) -> None:
        self.recording, self.log, self._layout = recording, recording.log, layout
        self._states, self._ground = dict.fromkeys(states, ""), object()
        for path, of in states.items():
            names, colours = list(of), list(of.values())
            look = rr.StateConfiguration(values=names, labels=names, colors=colours)
            self.log(path, look, static=True)

    def stand_at(self, step: int, **seconds: float) -> None:
        self.recording.set_time("step", sequence=step)
        for timeline, time_s in seconds.items():
            self.recording.set_time(timeline, duration=time_s)

    def scalar(self, path: str, *values: float) -> None:
        self.log(path, rr.Scalars(values))

    def style(self, path: str, colour: Colour, names: Sequence[str]) -> None:
        colours, widths = shown.shades(colour, len(names)), [2.0] * len(names)
        self.log(path, rr.SeriesLines(colors=colours, names=names, widths=widths), static=True)

    def state(self, path: str, value: str) -> None:
        if self._states[path] != value:
            self._states[path] = value
            self.log(path, rr.StateChange(state=value))

    def status(self, *lines: str) -> None:
        text = "\n\n".join(filter(None, lines))
        self.log("status", rr.TextDocument(text, media_type="text/markdown"))

    def observation(self, entries: Mapping[str, np.ndarray]) -> None:
        """Draw an observation: its pictures (the newest is the last), and its first numbers."""
        for name, array in entries.items():
            if not messages.is_picture(array):
                self.scalar(f"observation/{name}", *array.ravel()[:MOST_LINES])
                continue
            newest_first = messages.images_of(array)[::-1]
            for place, image in zip(("now", "before"), newest_first, strict=False):
                model = rr.ColorModel.L if image.shape[-1] == 1 else rr.ColorModel.RGB
                self.log(f"frames/{place}", rr.Image(image, color_model=model))

    def road(self, scene: SeenScene | None, picture: Any, ego_colour: Colour) -> None:
        """Draw the road from above, or else the picture; lay out anew for a new ground."""
        ground = (scene.roads, scene.path, scene.goal) if scene else ()
        if self._ground != ground:
            self._ground = ground
            self.log("road", rr.Clear(recursive=True))
            self.recording.send_blueprint(self._layout(scene))
            if scene:
                self._draw_ground(scene)
        if scene is None:
            self.log("road/picture", picture)
            return
        self.log(CAMERA, rr.Transform3D(translation=[*away_m(scene), 0.0]))
        for name, colour in (("traffic", shown.APPLIED), ("ego", ego_colour)):
            cars = [car for car in scene.vehicles if car.ego == (name == "ego")]
            half_m, bodies = [car.width_m / 2 for car in cars], list(map(messages.body, cars))
            self._strips(f"road/{name}/body", bodies, colour, half_m, order=3.0)
            glass = map(messages.windscreen, cars)
            self._strips(f"road/{name}/glass", glass, shown.GLASS, 0.3, order=4.0)

    def _draw_ground(self, scene: SeenScene) -> None:
        self._strips("road/roads", scene.roads, shown.ROAD, scene.road_width_m / 2, order=0.0)
        self._strips("road/lanes", scene.lane_lines, shown.MARKING, 0.06, order=0.5)
        self._strips("road/path", [scene.path] if scene.path else [], shown.PATH, 0.15, order=1.0)
        if scene.goal is not None:
            goal: Any = {"colors": [shown.GOAL], "radii": [0.9], "labels": ["goal"]}
            self.log("road/goal", rr.Points2D([scene.goal], **goal, draw_order=2.0))

    def _strips(self, path: str, strips: Any, colour: Colour, radii_m: Any, order: float) -> None:
        look: Any = {"colors": [colour], "radii": radii_m, "draw_order": order}
        self.log(path, rr.LineStrips2D(list(strips), **look))


def bounds_of(path: Sequence[Point]) -> list[tuple[float, float]]:
    return [(min(at) - MARGIN_M, max(at) + MARGIN_M) for at in zip(*path, strict=True)]


def away_m(scene: SeenScene) -> list[float]:
    """Return the view's shift (x, y) to an ego car outside of it; [0, 0] while it is inside."""
    for ego in (car for car in scene.vehicles if car.ego and scene.path):
        place = list(zip((ego.x, ego.y), bounds_of(scene.path), strict=True))
        if not all(low <= at <= high for at, (low, high) in place):
            return [at - (low + high) / 2 for at, (low, high) in place]
    return [0.0, 0.0]


def plot_view(origin: str, title: str) -> rrb.TimeSeriesView:
    legend, axis = rrb.Corner2D.LeftTop, rrb.TimeAxis(view_range=WHOLE)
    return rrb.TimeSeriesView(origin=origin, name=title, plot_legend=legend, axis_x=axis)


def road_view(scene: SeenScene | None) -> rrb.Spatial2DView:
    """Make the view from above of the scene's path; it follows a car that leaves it."""
    look: dict[str, Any] = {"name": "From above", "background": list(shown.GROUND)}
    if scene is None or not scene.path:
        return rrb.Spatial2DView(origin="road", **look)
    x_range, y_range = bounds_of(scene.path)
    bounds = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
    return rrb.Spatial2DView(origin=CAMERA, contents="/road/**", visual_bounds=bounds, **look)


def sees_view(frames: bool) -> rrb.Horizontal:
    views: list[Any] = [plot_view("observation", "Policy sees")]
    if frames:
        view = rrb.Spatial2DView
        times = {"before": "t-1", "now": "t"}.items()
        views = [view(origin=f"frames/{at}", name=f"Policy sees {t}") for at, t in times]
    now = rrb.TextDocumentView(origin="status", name="Now")
    return rrb.Horizontal(*views, now)


def two_columns(
    scene: SeenScene | None, right: rrb.Container, timeline: str, frames: bool = True
) -> rrb.Blueprint:
    """Lay out the road above what the policy sees, and ``right`` of both the other views."""
    left = rrb.Vertical(road_view(scene), sees_view(frames), row_shares=[3, 1.4])
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline),
    )


PLOTS = (
    ("action", "Command: asked, achieved; a shadow's, and what it adds"),
    ("speed", "Speed, m/s: of the simulated car and of the vehicle"),
    ("latency", "Latency, ms: round trip, and inference"),
    ("link", "Link each way: mean delay and jitter, ms; loss, %"),
    ("rejected", "Messages rejected so far, by either side"),
)
"""From top to bottom."""
ACTIONS = {"action/asked": shown.POLICY, "action/achieved": shown.APPLIED}
ACTIONS |= {"action/shadow": shown.SHADOW, "action/apart": RED}
NO_COMMAND, NO_REASON = "no command", "-"
MODES = {DRIVE: shown.POLICY, "safe_stop": RED, NO_COMMAND: (160, 30, 120)}
SHADOW = {DRIVE: shown.SHADOW}
STATES = {"mode/mode": MODES, "mode/reason": {NO_REASON: GREY}, "mode/shadow": SHADOW}


def lay_out(scene: SeenScene | None, pictures: bool = True) -> rrb.Blueprint:
    title, axis = "Mode, and why it does not drive", rrb.TimeAxis(view_range=WHOLE)
    mode = rrb.StateTimelineView(origin="mode", name=title, time_view=axis)
    plots = [plot_view(*plot) for plot in PLOTS]
    right = rrb.Vertical(mode, *plots, row_shares=[1.5, *[1] * len(plots)])
    return two_columns(scene, right, "sim_time", pictures)


class WireLog:
    """Draws the messages of one vehicle, its episodes end to end.

    Frames and scenes are drawn no more often than every ``picture_interval_s`` (0: all of them).
    """

    def __init__(self, recording: rr.RecordingStream, picture_interval_s: float = 0.0) -> None:
        self.left_out = 0  # Messages that could not be drawn
        self._canvas = Canvas(recording, self._lay_out, STATES)
        self._frames_pace, self._cars_pace = Pace(picture_interval_s), Pace(picture_interval_s)
        self._task: Task | None = None
        self._layout: Layout | None = None
        self._period_s = 0.0  # The control period, once a message has told it
        self._session = ""  # Of the newest state
        self._episode: tuple[str, int] | None = None  # The newest one seen
        self._starts: dict[tuple[str, int], int] = {}
        """Session and episode -> its first step on the time axis, for a viewer that comes late."""
        self._end_step = 0
        self._mode = self._reason = ""
        self._heard_command_ns = self._plan_periods = 0
        self._health: Health | None = None
        self._shadow: Command | None = None  # The newest answer of a policy in the shadow

    def write(self, heard: Heard) -> None:
        if heard.topic not in DECODERS:
            return
        message = messages.decode(heard)
        if isinstance(message, wire.Rejection):
            self.left_out += 1
        else:
            getattr(self, f"write_{heard.topic}")(message, heard.arrived_ns)

    def write_state(self, state: State, arrived_ns: int) -> None:
        if state.step:
            self._period_s = state.sim_time_s / state.step
        self._session, episode = state.session, (state.session, state.episode)
        self._stand_at(*episode, state.step)
        layout, due = self._layout, self._frames_pace.due(arrived_ns * 1e-9)
        if layout and due and not layout.refusal(state.observation):
            self._canvas.observation(layout.arrays(state.observation))
        if state.speed_mps is not None:
            self._canvas.scalar("speed/simulated", state.speed_mps)
        if self._episode != episode:
            # No command was due before, in a new episode or for a viewer that comes late.
            self._episode, self._heard_command_ns = episode, arrived_ns
        periods = BRAKE_PERIODS + self._plan_periods
        silent = arrived_ns - self._heard_command_ns > periods * self._period_s * 1e9
        # Between two episodes no command is due.
        if silent and state.step > 0 and not state.final:
            self._tell(NO_COMMAND, "the simulator brakes by itself")

    def write_command(self, command: Command, arrived_ns: int) -> None:
        self._stand_at(command.session, command.episode, command.step)
        self._heard_command_ns, self._plan_periods = arrived_ns, len(command.plan or ())
        self._canvas.scalar("action/asked", *command.action)
        self._canvas.scalar("latency/inference", command.inference_ns * 1e-6)
        self._tell(command.mode, command.reason)
        shadow, same = self._shadow, attrgetter("session", "episode", "step", "mode")
        if shadow and command.mode == DRIVE and same(shadow) == same(command):
            both = zip(shadow.action, command.action, strict=False)
            self._canvas.scalar("action/apart", *(ours - theirs for ours, theirs in both))

    def write_shadow(self, command: Command, _arrived_ns: int) -> None:
        self._shadow = command
        self._stand_at(command.session, command.episode, command.step)
        self._canvas.scalar("action/shadow", *command.action)
        self._canvas.scalar("latency/shadow", command.inference_ns * 1e-6)
        self._canvas.state("mode/shadow", command.reason or command.mode)

    def write_feedback(self, feedback: Feedback, _arrived_ns: int) -> None:
        self._canvas.scalar("action/achieved", *feedback.action)
        self._canvas.scalar("speed/vehicle", feedback.speed_mps)

    def write_health(self, health: Health, _arrived_ns: int) -> None:
        self._canvas.scalar("rejected/edge", sum(health.rejected.values()))
        for name, value in health.link.items():
            self._canvas.scalar(f"link/{name}", value)
        self._health = health
        self._draw_status()

    def write_scene(self, scene: Scene, arrived_ns: int) -> None:
        if scene.task is not None and scene.task != self._task:
            self._task, self._layout = scene.task, Layout(scene.task)
            self._period_s = scene.task.control_period_s
            for path, colour in ACTIONS.items():
                names = [f"{path[7:]} {action.name}" for action in scene.task.action]
                self._canvas.style(path, colour, names)
        session = scene.origin.session if scene.origin else self._session
        self._stand_at(session, scene.episode, scene.step)
        if scene.round_trip_ms is not None:
            self._canvas.scalar("latency/round_trip", scene.round_trip_ms)
        self._canvas.scalar("rejected/simulator", sum(scene.rejected.values()))
        if scene.ridden and self._mode == DRIVE:
            self._tell(DRIVE, "rides on the plan")
        if self._cars_pace.due(arrived_ns * 1e-9):
            picture = rr.EncodedImage(contents=scene.picture, media_type="image/jpeg")
            road = None if scene.picture else scene
            self._canvas.road(road, picture, MODES[self._mode or NO_COMMAND])

    def _lay_out(self, scene: SeenScene | None) -> rrb.Blueprint:
        entries = self._task.observation.values() if self._task else ()
        return lay_out(scene, not entries or any(map(messages.is_picture, entries)))

    def _stand_at(self, session: str, episode: int, step: int) -> None:
        step += self._starts.setdefault((session, episode), self._end_step)
        step = min(step, MOST_DRAWN)
        self._end_step = max(self._end_step, step + 1)
        self._canvas.stand_at(step, sim_time=step * self._period_s)

    def _tell(self, mode: str, reason: str) -> None:
        if (mode, reason) == (self._mode, self._reason):
            return
        self._mode, self._reason = mode, reason
        self._canvas.state("mode/mode", mode)
        self._canvas.state("mode/reason", reason or NO_REASON)
        self._draw_status()

    def _draw_status(self) -> None:
        lines = [f"# {self._mode or 'waiting'}", self._reason]
        if (health := self._health) is not None:
            lines += ["**waits for a re-arm**"] * health.needs_rearm
            counts = [f"{name} {count}" for name, count in health.rejected.items() if count]
            lines += [
                f"policy `{health.policy_id[:12]}`, vehicle `{health.vehicle}`",
                f"states accepted {health.accepted}, rejected: {', '.join(counts) or 'none'}",
                f"safe stops {health.safe_stops}, deadline misses {health.deadline_misses}",
                f"link: {link_words(health.link)}",
            ]
        self._canvas.status(*lines)


def run(arguments: Any, stage: Callable[[Any], Iterator[Heard]] | None = None) -> int:
    """Run the command until the simulator goes, or somebody interrupts.

    ``stage`` turns the messages of `bridge.ports.open_source` into those to show.
    """
    from bridge.ports import open_source, wait_to_be_told  # zenoh: test drives go without.

    if arguments.foxglove and (arguments.port or arguments.recording):
        raise UserError("--foxglove PORT listens: it goes with neither --port nor F.mcap")
    sink = "" if arguments.foxglove else shown.check_sink(arguments.sink, arguments.port)
    with (
        sigterm_as_interrupt(),
        open_source(arguments) as all_heard,
        _rerun(arguments, sink) if sink else _foxglove(arguments.foxglove) as show,
    ):
        try:
            for heard in stage(all_heard) if stage else filter(None, all_heard):
                show(heard)
            if arguments.recording and sink == shown.SERVE:
                print("everything is shown; ^C ends", flush=True)
                wait_to_be_told()
        except KeyboardInterrupt:  # The ordinary way to end a page and a live view, which is kept.
            if arguments.recording and sink != shown.SERVE:
                raise
    if sink.endswith(shown.SUFFIX):
        print(f"wrote {sink}")
    return 0


@contextlib.contextmanager
def _rerun(arguments: Any, sink: str) -> Iterator[Callable[[Heard], None]]:
    is_complete = arguments.recording or sink.endswith(shown.SUFFIX)
    with shown.open_sink(sink, "phil_hil", lay_out(None), arguments.port) as recording:
        log = WireLog(recording, 0.0 if is_complete else PICTURE_INTERVAL_S)
        yield log.write
    if log.left_out:
        count = counted(log.left_out, "message")
        print(f"left out: {count} that cannot be drawn", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _foxglove(port: int) -> Iterator[Callable[[Heard], None]]:
    """Yield a function that shows a message in Foxglove; UserError where the port is taken."""
    from bridge.recording import ENCODING, SCHEMA_ENCODING, Schema, ViewerCopies

    try:
        import foxglove
    except ImportError:
        raise UserError("--foxglove needs its SDK: pip install 'phil-hil[foxglove]'") from None
    context = foxglove.Context()

    @functools.cache
    def channel(topic: str, schema: Schema) -> Any:
        fields = foxglove.Schema(name=schema[0], encoding=SCHEMA_ENCODING, data=schema[1])
        return foxglove.Channel(topic, schema=fields, message_encoding=ENCODING, context=context)

    def add(topic: str, schema: Schema, now_ns: int, data: bytes) -> None:
        channel(topic, schema).log(data, log_time=now_ns)

    try:
        server = foxglove.start_server(name="phil", host=shown.LOOPBACK, port=port, context=context)
    except RuntimeError as error:
        raise UserError(f"cannot serve Foxglove at port {port}: {error}") from None
    try:
        print(f"open ws://{shown.LOOPBACK}:{port} in Foxglove", flush=True)
        yield ViewerCopies(add).write
    finally:
        server.stop()
