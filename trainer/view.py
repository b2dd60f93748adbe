"""Show a training in rerun as it goes on (``train --rerun``), or recorded sittings (``view``).

The training loop only collects what must be taken while it is there, and never waits. A thread of
its own draws, because calls of rerun take time. A recording of a sitting does not hold
the road: driving the same seed with the same actions again gives it back.
"""

import argparse
import math
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge.rerun import (
    APPLIED,
    HUMAN,
    POLICY,
    SERVE,
    ViewerGone,
    check_sink,
    draw,
    flush,
    open_sink,
)

# isort: split
import rerun as rr
import rerun.blueprint as rrb

from bridge.messages import Pace, SeenScene, read_scene
from bridge.report import GOAL
from bridge.rerun.draw import Plot
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.util import UserError, counted
from trainer.environments import make_environment
from trainer.human.guide import REASONS, Intervention, Reason
from trainer.learner.networks import FRAMES_SPACE
from trainer.learner.replay import Transition
from trainer.person.interface import Amount, amount, vector
from trainer.person.recording import RecordedStep, find_recordings, read_steps
from trainer.training.metrics import NAMES, EpisodeMetrics
from trainer.training.run import TrainingRun

LOOK_S = 0.2
"""The kernel may hand a signal to any thread, which does not wake this one from a longer sleep."""
MOST_WAITING = 500
"""Entries, some 50 s of pictures. A view that is slower loses some; the loop loses nothing."""
APPLICATION, SITTING_APPLICATION = "phil_hil_training", "phil_hil_sittings"
TIMELINE = "step"
RECENT_STEPS = 200  # Shown of what changes within an episode
WINDOW = 20  # Episodes of the moving means
EPISODES = (
    Plot("return", "Return of an episode, and the mean of 20"),
    Plot("success", "Success: mean of 20 episodes, and policy alone in validation", (-0.05, 1.05)),
    Plot("loss", "Losses, means of an episode"),
    Plot("priority", "Mean priority in the replay buffer: the human's samples, the policy's"),
    Plot("human", "The human's share of the steps", (-0.05, 1.05)),
    Plot(
        "cost",
        "So far: the human's seconds, take-overs, failures; its seconds until 90 and 98 % alone",
    ),
)
SITTINGS = (EPISODES[0], EPISODES[1], EPISODES[4])
"""The plots of recorded sittings, which hold nothing of a learner."""
RECENT = (
    Plot("action", f"Action in [-1, 1], the last {RECENT_STEPS} steps", (-1.1, 1.1)),
    Plot("speed", f"Speed, m/s, the last {RECENT_STEPS} steps"),
)
MEASURED = {
    "success/validation": (draw.ORANGE, "validation_success"),
    "loss/critic": (draw.PURPLE, "critic_loss"),
    "loss/policy": (POLICY, "policy_loss"),
    "loss/cloning": (HUMAN, "cloning_loss"),
    "priority/human": (HUMAN, "human_priority"),
    "priority/policy": (POLICY, "policy_priority"),
    "cost/human_s": (HUMAN, "total_human_s"),
    "cost/takeovers": (draw.ORANGE, "total_takeovers"),
    "cost/failures": (draw.PURPLE, "total_failures"),
    "cost/human_s_to_90": (draw.GREY, "human_s_to_90"),
    "cost/human_s_to_98": (draw.BLUE, "human_s_to_98"),
}
"""Line -> its colour, and the field of an episode's metrics."""
LINES = {
    "return/episode": draw.GREY,
    "return/mean_of_20": draw.BLUE,
    "success/mean_of_20": draw.BLUE,
    "human/share": HUMAN,
    "action/policy": POLICY,
    "action/applied": APPLIED,
    "speed/ego": draw.BLUE,
    **{path: colour for path, (colour, _) in MEASURED.items()},
}
DRIVERS = {"policy": POLICY, **dict.fromkeys(REASONS, HUMAN)}
"""The policy, or the human for one of these reasons -> the colour on the time line."""


def run(arguments: argparse.Namespace) -> int:
    """Draw all of it; a page is served until somebody interrupts. Returns the exit status."""
    paths = find_recordings([Path(place) for place in arguments.recordings])
    sink = check_sink(arguments.sink, arguments.port)
    for path in paths:  # Before a window opens, or a file takes another's place.
        next(read_steps(path), None)
    blueprint = make_blueprint(None, SITTINGS)
    with open_sink(sink, SITTING_APPLICATION, blueprint, arguments.port) as recording:
        log, shown = TrainingLog(recording, SITTINGS), Shown()
        for entry in shown.entries(paths):
            log.draw(entry)
        flush(recording)
        road = f"; {shown.without_road} without their road" if shown.without_road else ""
        print(
            f"{counted(shown.episodes, 'episode')}, {counted(shown.steps, 'step')}, "
            f"{shown.human_steps} of them the person's{road}",
            flush=True,
        )
        with suppress(KeyboardInterrupt):
            while sink == SERVE:
                time.sleep(LOOK_S)
    return 0


class StepEntry(NamedTuple):
    """The numbers of one control period."""

    step: int  # Since the run began
    policy_action: Amount
    action: Amount
    speed_mps: float
    reason: Reason | None  # Why the human acted; None where the policy did


class Steps(NamedTuple):
    """Some control periods, and perhaps the picture of the last one: at most ten a second."""

    entries: list[StepEntry]
    frames: NDArray[Any] | None = None  # What the policy saw; shown where it is [2, 45, 80]
    scene: SeenScene | NDArray[np.uint8] | None = None
    """The environment's, or what it draws; None, too, where the road is not known."""


class Episode(NamedTuple):
    """The end of an episode."""

    step: int
    metrics: EpisodeMetrics


Entry = Steps | Episode
Draw = Callable[[Entry], None]


@contextmanager
def watched(run: TrainingRun, sink: str) -> Iterator[Callable[[EpisodeMetrics], None]]:
    """Show a run for as long as it lasts; what it yields is to be called after each episode."""

    @contextmanager
    def opened() -> Iterator[Draw]:
        with open_sink(sink, APPLICATION, make_blueprint(None, EPISODES)) as recording:
            yield TrainingLog(recording, EPISODES).draw

    with sigterm_as_interrupt():  # Here, as signals are the main thread's.
        background = Background(opened)
        watcher = Watcher(run, background.put)
        run.recorders.append(watcher)
        try:
            yield watcher.on_episode
        finally:
            run.recorders.remove(watcher)
            watcher.hand_over()
            background.close()
            if background.dropped:
                print(f"{background.dropped} entries came faster than drawn", file=sys.stderr)


class Watcher:
    """Watches one run; ``put`` takes what is to be drawn, and must not block."""

    def __init__(self, run: TrainingRun, put: Draw) -> None:
        self._run, self._put = run, put
        self._pace = Pace(draw.PICTURE_INTERVAL_S)
        self._step = run.steps
        self._entries: list[StepEntry] = []

    def record(
        self, transition: Transition, intervention: Intervention | None, info: dict[str, Any]
    ) -> None:
        """Take a control period."""
        reason = None if intervention is None else intervention.reason
        actions = amount(transition.overruled), amount(transition.action)
        self._entries.append(StepEntry(self._step, *actions, float(info["speed_mps"]), reason))
        self._step += 1
        if self._pace.due(time.monotonic()):
            self.hand_over(transition.observation, _shown(self._run.env))

    def on_episode(self, metrics: EpisodeMetrics) -> None:
        """Take an episode's end."""
        self.hand_over()
        self._put(Episode(max(self._step - 1, 0), metrics))

    def hand_over(self, *picture: Any) -> None:
        """Pass on the steps so far, also those of an episode that was broken off."""
        entries, self._entries = self._entries, []
        if entries:
            self._put(Steps(entries, *picture))


class Background:
    """Opens a view, draws each entry in order, and closes it, in a thread of its own.

    An error in any of it is reported once, and ends the drawing, not the run.
    """

    def __init__(self, opened: Callable[[], AbstractContextManager[Draw]]) -> None:
        self.dropped = 0
        self._opened = opened
        self._queue: queue.Queue[Entry | None] = queue.Queue(MOST_WAITING)
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._thread.start()

    def put(self, entry: Entry) -> None:
        """Hand an entry over; never blocks."""
        try:
            self._queue.put_nowait(entry)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Draw what still waits, and close the view."""
        self._queue.put(None)
        self._thread.join()

    def _work(self) -> None:
        entries: Iterator[Entry] = iter(self._queue.get, None)
        try:
            with self._opened() as draw:
                for entry in entries:
                    draw(entry)
        except BaseException as error:  # a panic of rerun's Rust is no Exception
            why = error.why if isinstance(error, ViewerGone) else error
            print(f"viewer gone; the run is unharmed: {why}", file=sys.stderr, flush=True)
            for _ in entries:
                pass  # Empty the queue all the same, or close() would wait for ever.


class Shown:
    """The entries of recorded sittings, and what they amount to."""

    def __init__(self) -> None:
        self.steps = self.human_steps = self.episodes = 0
        self.without_road = 0
        """Episodes whose scenario drives differently today: their road is not shown."""
        self._environment = cache(make_environment)

    def entries(self, paths: Iterable[Path]) -> Iterator[Entry]:
        """Everything in these recordings, end to end; each episode ends with its own entry."""
        for path in paths:
            for _, steps in groupby(read_steps(path), key=lambda step: step.episode):
                yield from self._episode(list(steps))

    def _episode(self, episode: list[RecordedStep]) -> Iterator[Entry]:
        road = self._drive_again(episode)
        for number, step in enumerate(episode):
            policy = math.nan if step.policy_action is None else step.policy_action
            reason: Reason | None = "person" if step.human else None
            entry = StepEntry(self.steps, policy, step.action, step.speed_mps, reason)
            yield Steps([entry], step.observation, road[number] if road else None)
            self.steps += 1
        human_steps = sum(step.human for step in episode)
        known: dict[str, Any] = {
            "episode": self.episodes,
            "total_steps": self.steps,
            "steps": len(episode),
            "episode_return": sum(step.reward for step in episode),
            "outcome": episode[-1].outcome or "cut off",
            "interventions": sum(step.first for step in episode),
            "human_steps": human_steps,
        }
        # What only a learner knows is nan.
        metrics = EpisodeMetrics(**{**dict.fromkeys(NAMES, math.nan), **known})
        yield Episode(self.steps - 1, metrics)
        self.human_steps += human_steps
        self.without_road += not road
        self.episodes += 1

    def _drive_again(self, episode: list[RecordedStep]) -> list[Any]:
        """The scene at each step, by the same seed and the same actions; empty where it differs."""
        first, scenes = episode[0], []
        module = first.scenario.rpartition(":")[0]
        # Its beginning was in another file, which is gone; or no file decides what is imported.
        if first.step != 0 or (module and module not in sys.modules):
            return []
        try:
            env = self._environment(first.scenario)
        except UserError:  # It is not installed here.
            return []
        observation, _ = env.reset(seed=first.seed)
        for step in episode:
            if not np.array_equal(observation, step.observation):
                return []
            scenes.append(_shown(env))
            observation, *_ = env.step(vector(step.action))
        return scenes


def _shown(env: Any) -> Any:
    """The scene, or what the environment draws where it has none; None where it draws nothing."""
    with suppress(Exception):  # Of any kind: it is somebody else's code, and the training goes on.
        scene = env.scene()
        return env.render() if scene is None else read_scene(scene)
    return None


def make_blueprint(scene: SeenScene | None, episodes: Sequence[Plot]) -> rrb.Blueprint:
    """Lay out the views; the ground shown is fixed by the first scene (None: as rerun sees fit)."""
    recent = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-RECENT_STEPS),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    left = rrb.Vertical(
        draw.road_view(scene, "Road from above (blue: the policy drives, green: the human)"),
        draw.frames_view(),
        rrb.StateTimelineView(
            origin="driver",
            name="Who drives: the policy, or the human, and why",
            time_view=rrb.TimeAxis(view_range=draw.ALL_OF_IT),
        ),
        *(draw.plot_view(plot, recent) for plot in RECENT),
        row_shares=[3, 1.6, 0.9, 1.2, 1.1],
    )
    right = rrb.Vertical(*map(draw.plot_view, episodes))
    return draw.full_blueprint(left, right, [1, 1], TIMELINE)


class TrainingLog:
    """Draws one run, with the plots of whole ``episodes`` laid out."""

    def __init__(self, recording: rr.RecordingStream, episodes: Sequence[Plot]) -> None:
        self._recording, self._episodes = recording, episodes
        self._driver = ""
        self._ground: Any = False
        """What is drawn: a road's lines, a picture (True) or nothing; recordings hold several."""
        self._actions: dict[str, int] = {}
        """How many actions the lines at a path are styled for, where it is not one."""
        self._returns: deque[float] = deque(maxlen=WINDOW)
        self._successes: deque[float] = deque(maxlen=WINDOW)
        draw.style_lines(recording, LINES)
        names, colours = list(DRIVERS), list(DRIVERS.values())
        lanes = rr.StateConfiguration(values=names, labels=names, colors=colours)
        recording.log("driver", lanes, static=True)

    def draw(self, entry: Entry) -> None:
        """Draw what the loop has handed over."""
        if isinstance(entry, Episode):
            self._draw_episode(entry)
            return
        steps, policy, applied, speeds, reasons = zip(*entry.entries, strict=True)
        for name, actions in (("policy", policy), ("applied", applied)):
            path = f"action/{name}"
            values = np.array(actions).reshape(len(steps), -1)
            if values.shape[1] != self._actions.setdefault(path, 1):
                self._actions[path] = values.shape[1]
                numbers = [str(number) for number in range(1, values.shape[1] + 1)]
                draw.style_actions(self._recording, path, LINES[path], numbers)
            self._columns(path, steps, values)
        self._columns("speed/ego", steps, speeds)
        for step, reason in zip(steps, reasons, strict=True):
            driver = reason or "policy"
            if driver != self._driver:
                self._driver = driver
                self._stand_at(step)
                self._recording.log("driver", rr.StateChange(state=driver))
        if entry.frames is not None:
            self._stand_at(steps[-1])
            self._draw_scene(entry.scene)
            if entry.frames.shape == FRAMES_SPACE.shape:
                for name, frame in zip(("before", "now"), entry.frames, strict=True):
                    self._recording.log(f"frames/{name}", rr.Image(frame, color_model="L"))

    def _draw_scene(self, scene: Any) -> None:
        """A road with its cars, a picture, or nothing, in the place of what was there."""
        road = scene if isinstance(scene, SeenScene) else None
        ground = (road.roads, road.path, road.goal) if road else scene is not None
        if ground != self._ground:
            self._ground = ground
            self._recording.log("road", rr.Clear(recursive=True))
            if road:
                self._bounds = draw.view_bounds(road)
                self._recording.send_blueprint(make_blueprint(road, self._episodes))
                draw.draw_ground(self._recording, road)
        if road:
            draw.follow(self._recording, road, self._bounds)
            draw.draw_cars(self._recording, road, DRIVERS.get(self._driver, HUMAN))
        elif scene is not None:
            self._recording.log("road", rr.Image(scene, color_model="RGB"))

    def _draw_episode(self, episode: Episode) -> None:
        metrics = episode.metrics
        self._returns.append(metrics.episode_return)
        self._successes.append(float(metrics.outcome == GOAL))
        self._stand_at(episode.step)
        self._recording.set_time("episode", sequence=metrics.episode)
        for path, value in {
            "return/episode": metrics.episode_return,
            "return/mean_of_20": float(np.mean(self._returns)),
            "success/mean_of_20": float(np.mean(self._successes)),
            "human/share": metrics.human_steps / metrics.steps,
            **{path: getattr(metrics, name) for path, (_, name) in MEASURED.items()},
        }.items():
            if not math.isnan(value):
                self._recording.log(path, rr.Scalars(value))
        self._recording.log("status", _status(metrics))
        self._recording.reset_time()
        flush(self._recording)  # Only a flush notices that a viewer has gone.

    def _columns(self, path: str, steps: Sequence[int], values: Any) -> None:
        """Log the numbers of many steps, one or more a step, in one call: a call for each step
        would cost as much as this one.
        """
        numbers = np.array(values).reshape(len(steps), -1)
        rows = rr.Scalars.columns(scalars=numbers.ravel())
        rr.send_columns(
            path,
            indexes=[rr.TimeColumn(TIMELINE, sequence=np.array(steps))],
            columns=rows.partition([numbers.shape[1]] * len(steps)),
            recording=self._recording,
        )

    def _stand_at(self, step: int) -> None:
        self._recording.reset_time()
        self._recording.set_time(TIMELINE, sequence=step)


def _status(metrics: EpisodeMetrics) -> rr.TextDocument:
    lines = [
        f"# episode {metrics.episode + 1}: {metrics.outcome}",
        f"{counted(metrics.total_steps, 'step')} in all, {metrics.steps} in this episode",
        f"{counted(metrics.interventions, 'intervention')}, "
        f"{counted(metrics.human_steps, 'step')} the human's",
        f"{metrics.distance_m:.1f} m, " * math.isfinite(metrics.distance_m)
        + f"return {metrics.episode_return:.1f}",
    ]
    if not math.isnan(metrics.validation_success):
        lines.append(f"validation: success {metrics.validation_success:.0%}")
    return rr.TextDocument("\n\n".join(lines), media_type="text/markdown")
