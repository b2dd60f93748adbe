"""``python -m bridge view``: the wire in rerun, as a listener of its own or from a recording.

Or, live, in Foxglove: the copies that `bridge record` makes for viewers, as a WebSocket.
"""

from __future__ import annotations

import contextlib
import functools
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from bridge.inbound import BRAKE_PERIODS
from bridge.messages import DECODERS, Heard, Pace, Scene, decode, images_of, is_picture
from bridge.ports import open_listener, wait_to_be_told
from bridge.recording import (
    ENCODING,
    SCHEMA_ENCODING,
    Recording,
    Schema,
    ViewerCopies,
    choose_vehicle,
    heard_of,
)
from bridge.rerun import (
    APPLIED,
    LOOPBACK,
    POLICY,
    SERVE,
    SUFFIX,
    check_sink,
    draw,
    flush,
    open_sink,
)
from bridge.rerun.draw import Canvas, Plot
from edge_runtime import wire
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.link import link_words
from edge_runtime.manifest import Layout, Task
from edge_runtime.transport import tls_for
from edge_runtime.util import UserError, counted
from edge_runtime.wire import DEFAULT_VEHICLE_ID, DRIVE, Command, Feedback, Health, State

APPLICATION = "phil_hil"


def run(arguments: Any) -> int:
    """Run the command until the simulator goes, the time is over, or somebody interrupts."""
    if arguments.foxglove and (arguments.port or arguments.recording):
        raise UserError("--foxglove PORT listens: it goes with neither --port nor F.mcap")
    if arguments.foxglove:
        try:
            import foxglove
        except ImportError:
            raise UserError("--foxglove needs its SDK: pip install 'phil-hil[foxglove]'") from None
        return _watch(arguments, _served(foxglove, arguments.foxglove))
    sink, port = check_sink(arguments.sink, arguments.port), arguments.port
    if arguments.recording is not None:
        _show_recording(arguments, sink)
    else:
        _watch(arguments, _drawn(sink, port))
    if sink.endswith(SUFFIX):
        print(f"wrote {sink}")
    return 0


def _show_recording(arguments: Any, sink: str) -> None:
    """Draw all of it; a page is served until somebody interrupts."""
    file = Recording(Path(arguments.recording))
    heard = heard_of(file, choose_vehicle(file, arguments.vehicle_id))
    with open_sink(sink, APPLICATION, make_blueprint(None), arguments.port) as recording:
        log = WireLog(recording)
        for each in heard:
            log.write(each)
        file.say_trouble()
        log.say_left_out()
        if sink == SERVE:
            flush(recording)
            print("all of it is there; ^C ends", flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                wait_to_be_told()


@contextlib.contextmanager
def _drawn(sink: str, port: int | None) -> Iterator[Callable[[Heard], None]]:
    with open_sink(sink, APPLICATION, make_blueprint(None), port) as recording:
        log = WireLog(recording, 0.0 if sink.endswith(SUFFIX) else draw.PICTURE_INTERVAL_S)
        yield log.write
        log.say_left_out()


@contextlib.contextmanager
def _served(foxglove: Any, port: int) -> Iterator[Callable[[Heard], None]]:
    """What shows a message in Foxglove; UserError where nothing can be served at the port."""
    context = foxglove.Context()

    @functools.cache
    def channel(topic: str, schema: Schema) -> Any:
        told = foxglove.Schema(name=schema.name, encoding=SCHEMA_ENCODING, data=schema.data)
        kind: Any = {"message_encoding": ENCODING, "schema": told, "context": context}
        return foxglove.Channel(topic, **kind)

    def add(topic: str, schema: Schema, now_ns: int, data: bytes) -> None:
        channel(topic, schema).log(data, log_time=now_ns)

    try:
        server = foxglove.start_server(name="phil", host=LOOPBACK, port=port, context=context)
    except RuntimeError as error:
        raise UserError(f"cannot serve Foxglove at port {port}: {error}") from None
    try:
        print(f"open ws://{LOOPBACK}:{port} in Foxglove", flush=True)
        yield ViewerCopies(add).write
    finally:
        server.stop()


def _watch(
    arguments: Any, opened: contextlib.AbstractContextManager[Callable[[Heard], None]]
) -> int:
    """Show until there is a reason to stop."""
    where, vehicle_id = arguments.connect, arguments.vehicle_id or DEFAULT_VEHICLE_ID
    tls = tls_for(arguments.tls, where)
    with (
        sigterm_as_interrupt(),
        open_listener(where, vehicle_id, arguments.wait_s, tls) as listener,
        opened as show,
        # Being interrupted is the ordinary way to end a view: what was drawn is kept.
        contextlib.suppress(KeyboardInterrupt),
    ):
        for heard in filter(None, listener.until_gone(arguments.duration_s)):
            show(heard)
    if listener.dropped:
        print(f"{listener.dropped} messages came faster than they could be drawn", file=sys.stderr)
    return 0


PLOTS = (
    Plot("action", "Command: asked and achieved"),
    Plot("speed", "Speed, m/s: of the simulated car and of the vehicle"),
    Plot("latency", "Latency, ms: round trip, and its parts"),
    Plot("link", "Link each way: mean delay and jitter, ms; loss, %"),
    Plot("rejected", "Messages rejected so far, by reason"),
)
"""From top to bottom."""
LINES = {
    "action/asked": POLICY,
    "action/achieved": APPLIED,
    "speed/simulated": draw.BLUE,
    "speed/vehicle": draw.ORANGE,
    "latency/uplink": draw.BLUE,
    "latency/inference": draw.GREEN,
    "latency/downlink": draw.PURPLE,
    "latency/round_trip": draw.ORANGE,
    "link/up_ms": draw.BLUE,
    "link/down_ms": draw.PURPLE,
    "link/up_jitter_ms": draw.GREEN,
    "link/down_jitter_ms": draw.GREY,
    "link/up_lost_percent": draw.ORANGE,
    "link/down_lost_percent": draw.RED,
}
"""Lines that are there from the start; those of rejections come with their reasons."""
MOST_LINES = 16  # Numbers of an observation that a plot can show
COLUMNS = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])


def make_blueprint(scene: Scene | None) -> rrb.Blueprint:
    """Lay out the views; the first scene fixes the ground shown (None: as rerun sees fit)."""
    shown = None if scene is None or scene.picture else scene  # A picture has its own bounds.
    seen = {} if scene is None or scene.task is None else scene.task.observation
    many = (name for name, entry in seen.items() if math.prod(entry.shape) > MOST_LINES)
    pictures = not seen or any(map(is_picture, seen.values()))
    left = rrb.Vertical(
        draw.road_view(shown, "Road from above" if shown or not seen else "From above"),
        draw.sees_view(pictures, next(many, "")),
        row_shares=[3, 1.4],
    )
    right = rrb.Vertical(
        draw.lanes_view("mode", "Mode, and why it does not drive"),
        *map(draw.plot_view, PLOTS),
        rrb.TextLogView(
            origin="events", name="Events: modes, rejections, episodes", columns=COLUMNS
        ),
        row_shares=[2.2, 2, 2, 2, 1.6, 1.6, 1.8],
    )
    return draw.two_columns(left, right, [3, 2], "sim_time")


Place = tuple[str, int, int]  # Session, episode and step of a state
NO_COMMAND = "no command"
NO_REASON = "-"
REMEMBERED_STATES = 64  # States whose sending time is kept, for the latency of their commands
EGO = {"drive": POLICY, "safe_stop": draw.RED, NO_COMMAND: (160, 30, 120)}
ALL = "all"  # The sum over the reasons, which has a line from the start
SIDES = {"edge": draw.ORANGE, "simulator": draw.BLUE}
"""The side that rejects, and the colour of all that it has rejected."""
INFO, WARN, ERROR = rr.TextLogLevel.INFO, rr.TextLogLevel.WARN, rr.TextLogLevel.ERROR


class WireLog:
    """Draws the messages of one vehicle; used by one thread. Times are passed in.

    Frames and scenes are drawn no more often than every ``picture_interval_s`` by their arrival;
    numbers always are. 0: all, as in a file, where simulated time is what counts.
    """

    def __init__(self, recording: rr.RecordingStream, picture_interval_s: float = 0.0) -> None:
        self.left_out = 0  # Messages that could not be drawn
        self._canvas = Canvas(recording, LINES)
        self._frames_pace, self._cars_pace = Pace(picture_interval_s), Pace(picture_interval_s)
        self._time = DriveTime()
        self._task: Task | None = None
        self._layout: Layout | None = None
        self._bounds: draw.Bounds | None = None
        self._session = ""  # Of the newest state
        self._mode = self._reason = ""
        self._episode: tuple[str, int] | None = None  # The newest one seen
        self._heard_command_ns = self._plan_periods = 0
        self._sent_ns: dict[Place, int] = {}
        self._answered_ns: dict[Place, int] = {}
        """From the sending of a state to that of its first command, by the stamps of both."""
        self._split: Place | None = None
        """The state whose round trip was drawn in its parts last."""
        self._health: Health | None = None
        self._rejecting: set[str] = set()
        """The lines of rejections that are there."""
        for side, colour in SIDES.items():
            self._canvas.style(f"rejected/{side}/{ALL}", [colour], [f"{side}: {ALL}"])
        self._canvas.lanes("mode/mode", EGO)
        quiet = rr.StateConfiguration(values=[NO_REASON], labels=[" "], colors=[draw.GREY])
        self._canvas.log("mode/reason", quiet, static=True)

    def write(self, heard: Heard) -> None:
        """Draw one message as it came; a token shows as silence."""
        if heard.topic not in DECODERS:
            return
        message = decode(heard)
        if isinstance(message, wire.Rejection):
            self.left_out += 1
            self._event(f"unreadable {heard.topic}: {message.detail}", ERROR)
        else:
            getattr(self, f"write_{heard.topic}")(message, heard.arrived_ns)

    def say_left_out(self) -> None:
        """Say in one line on stderr how many messages could not be drawn, if any."""
        if self.left_out:
            said = counted(self.left_out, "message")
            print(f"left out: {said} that cannot be drawn", file=sys.stderr, flush=True)

    def write_state(self, state: State, arrived_ns: int) -> None:
        """Draw the frames and the speed; a state after 2 T without a command shows the silence."""
        if state.step:
            self._time.period_s = state.sim_time_s / state.step
        self._session = state.session
        self._stand_at(place := (state.session, state.episode, state.step))
        _keep(self._sent_ns, place, state.sent_ns)
        if self._frames_pace.due(arrived_ns * 1e-9):
            self._draw_observation(state)
        if state.speed_mps is not None:
            self._canvas.scalar("speed/simulated", state.speed_mps)
        if state.step == 0:
            self._event(f"episode {state.episode} begins")
        if state.final:
            self._event(f"episode {state.episode} ends at step {state.step}")
        if self._episode != place[:2]:
            # For a viewer that comes late, or in a new episode, no command was due before.
            self._episode, self._heard_command_ns = place[:2], arrived_ns
        periods = BRAKE_PERIODS + self._plan_periods
        silent = arrived_ns - self._heard_command_ns > periods * self._time.period_s * 1e9
        # Between two episodes no command is due.
        if silent and state.step > 0 and not state.final:
            gap = [math.nan] * (len(self._task.action) if self._task else 1)
            self._canvas.scalar("action/asked", *gap)
            self._tell(NO_COMMAND, "the simulator brakes by itself", WARN)

    def write_command(self, command: Command, arrived_ns: int) -> None:
        """Draw what is asked, the mode, and where the time went."""
        self._stand_at(state := (command.session, command.episode, command.step))
        self._heard_command_ns, self._plan_periods = arrived_ns, len(command.plan or ())
        self._canvas.scalar("action/asked", *command.action)
        if (sent_ns := self._sent_ns.get(state)) is not None:
            self._canvas.scalar("latency/uplink", (command.received_ns - sent_ns) * 1e-6)
            # A safe stop is repeated for as long as it lasts: only the first is the answer.
            if state not in self._answered_ns:
                _keep(self._answered_ns, state, command.sent_ns - sent_ns)
        self._canvas.scalar("latency/inference", command.inference_ns * 1e-6)
        self._tell(command.mode, command.reason, INFO if command.mode == DRIVE else WARN)

    def write_feedback(self, feedback: Feedback, _arrived_ns: int) -> None:
        """Draw what the vehicle has reached."""
        self._canvas.scalar("action/achieved", *feedback.action)
        self._canvas.scalar("speed/vehicle", feedback.speed_mps)

    def write_health(self, health: Health, _arrived_ns: int) -> None:
        """Refresh the status text, and note what the edge runtime has newly rejected."""
        before = self._health.rejected if self._health else {}
        for reason, count in health.rejected.items():
            if (new := count - before.get(reason, 0)) > 0:
                self._event(f"edge rejected {new} states: {reason}", WARN)
        self._draw_rejections("edge", health.rejected)
        for name, value in health.link.items():
            if (path := f"link/{name}") in LINES:
                self._canvas.scalar(path, value)
        self._health = health
        self._draw_status()

    def write_scene(self, scene: Scene, arrived_ns: int) -> None:
        """Draw the road from above, or the picture that is in its place.

        The first scene also decides which ground is shown.
        """
        if scene.task is not None:
            self._take_task(scene.task)
        session = scene.origin.session if scene.origin else self._session
        self._stand_at((session, scene.episode, scene.step))
        if self._bounds is None:
            self._bounds = draw.view_bounds(scene)
            self._canvas.recording.send_blueprint(make_blueprint(scene))
        if self._canvas.is_new_ground((session, scene.episode)):
            self._canvas.draw_ground(scene)
        self._draw_round_trip(session, scene)
        self._draw_rejections("simulator", scene.rejected)
        if scene.ridden and self._mode == DRIVE:
            self._tell(DRIVE, "rides on the plan", WARN)
        if not self._cars_pace.due(arrived_ns * 1e-9):
            return
        if scene.picture:
            picture = rr.EncodedImage(contents=scene.picture, media_type="image/jpeg")
            self._canvas.log("road/picture", picture)
        else:
            self._canvas.draw_cars(scene, self._bounds, EGO[self._mode or NO_COMMAND])

    def _take_task(self, task: Task) -> None:
        self._time.period_s = task.control_period_s
        if self._task != task:
            self._task, self._layout = task, Layout(task)
            for path in ("action/asked", "action/achieved"):
                self._canvas.name_actions(path, [action.name for action in task.action])

    def _draw_observation(self, state: State) -> None:
        """Draw its images, the newest last, and few numbers as lines."""
        if self._layout is None or self._layout.refusal(state.observation) is not None:
            return
        # The layout has views for the first camera; a person may add those of others.
        root = "frames"
        for name, array in self._layout.arrays(state.observation).items():
            if (images := images_of(array)) is not None:
                for place, image in zip(("now", "before"), images[::-1], strict=False):
                    model = rr.ColorModel.L if image.shape[-1] == 1 else rr.ColorModel.RGB
                    path = f"{root}/{place}" if root == "frames" else f"frames/{name}/{place}"
                    self._canvas.log(path, rr.Image(image, color_model=model))
                root = ""
            elif array.size <= MOST_LINES:
                self._canvas.scalar(f"observation/{name}", *array.ravel())
            else:  # As numbers: rerun has no tensor of truth values.
                self._canvas.log(f"observation/{name}", rr.Tensor(array * 1))

    def _stand_at(self, place: Place) -> None:
        name, total_step = self._time.place(*place)
        period_s = self._time.period_s
        seconds = {"sim_time": total_step * period_s, name: place[2] * period_s}
        self._canvas.stand_at({"step": total_step}, seconds)

    def _draw_round_trip(self, session: str, scene: Scene) -> None:
        """Draw the newest round trip, and what is left of it for the way down."""
        if scene.round_trip_ms is None or scene.answered_step is None:
            return
        self._canvas.scalar("latency/round_trip", scene.round_trip_ms)
        state = (session, scene.episode, scene.answered_step)
        # Every scene tells it until the next one is known.
        if state in self._answered_ns and state != self._split:
            self._split, answered_ms = state, self._answered_ns[state] * 1e-6
            self._canvas.scalar("latency/downlink", scene.round_trip_ms - answered_ms)

    def _draw_rejections(self, side: str, counts: Mapping[str, int]) -> None:
        self._canvas.scalar(f"rejected/{side}/{ALL}", sum(counts.values()))
        for reason, count in counts.items():
            path = f"rejected/{side}/{reason}"
            if count and path not in self._rejecting:
                self._rejecting.add(path)
                self._canvas.style(path, [draw.GREY], [f"{side}: {reason}"])
                self._canvas.scalar(path, 0)  # So that the line shows the step.
            if count:
                self._canvas.scalar(path, count)

    def _tell(self, mode: str, reason: str, level: Any) -> None:
        """Draw the mode where it changes."""
        if (mode, reason) == (self._mode, self._reason):
            return
        self._mode, self._reason = mode, reason
        self._canvas.log("mode/mode", rr.StateChange(state=mode))
        self._canvas.log("mode/reason", rr.StateChange(state=reason or NO_REASON))
        self._event(f"{mode}: {reason}" if reason else mode, level)
        self._draw_status()

    def _event(self, text: str, level: Any = INFO) -> None:
        self._canvas.log("events", rr.TextLog(text, level=level))

    def _draw_status(self) -> None:
        lines = [f"# {self._mode or 'waiting'}", self._reason]
        if (health := self._health) is not None:
            counts = [f"{name} {count}" for name, count in health.rejected.items() if count]
            lines += [
                f"policy `{health.policy_id[:12]}`, vehicle `{health.vehicle}`",
                f"states accepted {health.accepted}, rejected: {', '.join(counts) or 'none'}",
                f"safe stops {health.safe_stops}, deadline misses {health.deadline_misses}",
                f"link: {link_words(health.link)}",
            ]
            if {"p50", "p99"} <= set(health.inference_ms):
                times = "inference p50 {p50:.2f} ms, p99 {p99:.2f} ms"
                lines.append(times.format(**health.inference_ms))
        self._canvas.status(lines)


def _keep(table: dict[Place, int], key: Place, value: int) -> None:
    """Remember a value, and forget the oldest where there are too many."""
    table[key] = value
    if len(table) > REMEMBERED_STATES:
        del table[next(iter(table))]


class DriveTime:
    """Where a message stands in time.

    Each episode's steps begin at 0. On the timelines ``sim_time`` and ``step`` the episodes are put
    end to end, and each has its own timeline besides, ``episode_0`` and so on, that begins at 0
    (``episode_0_of_session_2`` where the simulator was started again). Where each begins is learnt
    from what is seen, so that a viewer may come late: its first step is the first that it saw.
    """

    def __init__(self) -> None:
        self._starts: dict[tuple[str, int], int] = {}
        self._sessions: dict[str, int] = {}  # In the order of their first messages, from 1
        self._end_step = 0
        self.period_s = 0.0  # The control period, as soon as a message tells it

    def place(self, session: str, episode: int, step: int) -> tuple[str, int]:
        """Return the episode's own timeline, and the step with the episodes end to end."""
        total_step = self._starts.setdefault((session, episode), self._end_step) + step
        self._end_step = max(self._end_step, total_step + 1)
        nth = self._sessions.setdefault(session, len(self._sessions) + 1)
        name = f"episode_{episode}" if nth == 1 else f"episode_{episode}_of_session_{nth}"
        return name, total_step
