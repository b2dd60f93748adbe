"""Show a training in rerun as it goes on (``train --rerun``), or recorded sittings (``view``).

The training loop only hands each step over, and never waits. A thread of its own draws, because
calls of rerun take time. A recording of a sitting does not hold the road: driving the same seed
with the same actions again gives it back.
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
from itertools import chain, groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bridge.rerun import APPLIED, HUMAN, POLICY, SERVE, ViewerGone, check_sink, flush, open_sink

# isort: split
import rerun as rr
import rerun.blueprint as rrb

from bridge.messages import Pace, SeenScene, read_scene
from bridge.outcomes import GOAL
from bridge.rerun import draw
from bridge.rerun.draw import Canvas, Plot
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.util import UserError, counted
from trainer.environments import make_environment
from trainer.human.guide import BY_PERSON, REASONS, Intervention, Reason
from trainer.learner.networks import FRAMES_SPACE
from trainer.learner.replay import Transition
from trainer.person.interface import Amount, amount, vector
from trainer.person.recording import RecordedStep, find_recordings, read_steps
from trainer.training.metrics import NAMES, EpisodeMetrics
from trainer.training.run import TrainingRun

LOOK_S = 0.2
"""The kernel may hand a signal to any thread, which does not wake this one from a longer sleep."""
MOST_WAITING = 5000
"""Entries, of which ten a second have pictures. A view that is slower loses some; the loop none."""
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
NUMBERS = {"action/policy": "policy_action", "action/applied": "action", "speed/ego": "speed_mps"}
"""Line -> the field of a step."""
DRIVERS = {"policy": POLICY, **dict.fromkeys(REASONS, HUMAN)}
"""The policy, or the human for one of these reasons -> the colour on the time line."""


class ShownStep(NamedTuple):
    """One control period, as it is drawn; with pictures in at most ten steps a second."""

    number: int  # Since the run began
    policy_action: Amount
    action: Amount
    speed_mps: float
    reason: Reason | None  # Why the human acted; None where the policy did
    frames: NDArray[Any] | None = None  # What the policy saw; drawn where it is [2, 45, 80]
    scene: SeenScene | NDArray[np.uint8] | None = None
    """The road, or what the environment draws; None where neither is known."""


class ShownEpisode(NamedTuple):
    """The end of an episode."""

    last_step: int
    metrics: EpisodeMetrics


Entry = ShownStep | ShownEpisode
Draw = Callable[[Entry], None]


def run(arguments: argparse.Namespace) -> int:
    """Draw recorded sittings; a page is served until somebody interrupts. Returns the status."""
    paths = find_recordings([Path(place) for place in arguments.recordings])
    sink = check_sink(arguments.sink, arguments.port)
    for path in paths:  # Before a window opens, or a file takes another's place.
        next(read_steps(path), None)
    blueprint = make_blueprint(None, SITTINGS)
    with open_sink(sink, "phil_hil_sittings", blueprint, arguments.port) as recording:
        log, episodes, steps = TrainingLog(recording, SITTINGS), 0, 0
        for entry in sitting_entries(paths):
            log.draw(entry)
            episodes += isinstance(entry, ShownEpisode)
            steps += isinstance(entry, ShownStep)
        flush(recording)
        print(f"{counted(episodes, 'episode')}, {counted(steps, 'step')}", flush=True)
        with suppress(KeyboardInterrupt):
            while sink == SERVE:
                time.sleep(LOOK_S)
    return 0


def sitting_entries(paths: Iterable[Path]) -> Iterator[Entry]:
    """Yield everything in these recordings, end to end."""
    environment, total_steps = cache(make_environment), 0
    recorded = (groupby(read_steps(path), key=lambda step: step.episode) for path in paths)
    for number, (_, steps) in enumerate(chain.from_iterable(recorded)):
        episode = list(steps)
        road = _drive_again(episode, environment)
        for step, scene in zip(episode, road or [None] * len(episode), strict=True):
            policy = math.nan if step.policy_action is None else step.policy_action
            reason = BY_PERSON if step.human else None
            yield ShownStep(
                total_steps, policy, step.action, step.speed_mps, reason, step.observation, scene
            )
            total_steps += 1
        known: dict[str, Any] = {
            "episode": number,
            "total_steps": total_steps,
            "steps": len(episode),
            "episode_return": sum(step.reward for step in episode),
            "outcome": episode[-1].outcome or "cut off",
            "interventions": sum(step.first for step in episode),
            "human_steps": sum(step.human for step in episode),
        }
        # What only a learner knows is nan.
        metrics = EpisodeMetrics(**{**dict.fromkeys(NAMES, math.nan), **known})
        yield ShownEpisode(total_steps - 1, metrics)


def _drive_again(episode: list[RecordedStep], environment: Callable[[str], Any]) -> list[Any]:
    """Drive with the same seed and actions; the scene at each step, none where it differs."""
    first, scenes = episode[0], []
    module = first.scenario.rpartition(":")[0]
    # Its beginning was in another file, which is gone; or no file decides what is imported.
    if first.step != 0 or (module and module not in sys.modules):
        return []
    try:
        env = environment(first.scenario)
    except UserError:  # It is not installed here.
        return []
    observation, _ = env.reset(seed=first.seed)
    for step in episode:
        if not np.array_equal(observation, step.observation):
            return []
        scenes.append(_scene(env))
        observation, *_ = env.step(vector(step.action))
    return scenes


def _scene(env: Any) -> Any:
    with suppress(Exception):  # Of any kind: it is somebody else's code, and the training goes on.
        scene = env.scene()
        return env.render() if scene is None else read_scene(scene)
    return None


@contextmanager
def watched(run: TrainingRun, sink: str) -> Iterator[Callable[[EpisodeMetrics], None]]:
    """Show a run for as long as it lasts; call what is yielded after each episode."""

    @contextmanager
    def opened() -> Iterator[Draw]:
        with open_sink(sink, "phil_hil_training", make_blueprint(None, EPISODES)) as recording:
            log = TrainingLog(recording, EPISODES)
            yield log.draw
            log.draw_steps()

    with sigterm_as_interrupt():  # Here, as signals are the main thread's.
        background = Background(opened)
        watcher = Watcher(run, background.put)
        run.recorders.append(watcher.record)
        try:
            yield watcher.on_episode
        finally:
            run.recorders.remove(watcher.record)
            background.close()


class Watcher:
    """Hands a run's steps over to ``put``, which must not block; with pictures where due."""

    def __init__(self, run: TrainingRun, put: Draw) -> None:
        self._run, self._put, self._steps = run, put, run.steps
        self._pace = Pace(draw.PICTURE_INTERVAL_S)

    def record(
        self, seen: Transition, intervention: Intervention | None, info: dict[str, Any]
    ) -> None:
        reason = None if intervention is None else intervention.reason
        actions = amount(seen.overruled), amount(seen.action)
        step = ShownStep(self._steps, *actions, float(info["speed_mps"]), reason)
        self._steps += 1
        if self._pace.due(time.monotonic()):
            step = step._replace(frames=seen.observation, scene=_scene(self._run.env))
        self._put(step)

    def on_episode(self, metrics: EpisodeMetrics) -> None:
        self._put(ShownEpisode(max(self._steps - 1, 0), metrics))


class Background:
    """Opens a view, draws each entry in order, and closes it, in a thread of its own.

    An error in any of it is reported once, and ends the drawing, not the run.
    """

    def __init__(self, opened: Callable[[], AbstractContextManager[Draw]]) -> None:
        self._opened = opened
        self._queue: queue.Queue[Entry | None] = queue.Queue(MOST_WAITING)
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._thread.start()

    def put(self, entry: Entry) -> None:
        """Hand an entry over; never blocks."""
        with suppress(queue.Full):
            self._queue.put_nowait(entry)

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


def make_blueprint(scene: SeenScene | None, episodes: Sequence[Plot]) -> rrb.Blueprint:
    """Lay out the views; ``scene`` fixes the ground shown (None: as rerun sees fit)."""
    recent = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-RECENT_STEPS),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    left = rrb.Vertical(
        draw.road_view(scene, "Road from above (blue: the policy drives, green: the human)"),
        draw.sees_view(),
        draw.lanes_view("driver", "Who drives: the policy, or the human, and why"),
        *(draw.plot_view(plot, recent) for plot in RECENT),
        row_shares=[3, 1.6, 0.9, 1.2, 1.1],
    )
    right = rrb.Vertical(*map(draw.plot_view, episodes))
    return draw.two_columns(left, right, [1, 1], TIMELINE)


class TrainingLog:
    """Draws one run, with the plots of whole ``episodes`` laid out."""

    def __init__(self, recording: rr.RecordingStream, episodes: Sequence[Plot]) -> None:
        self._canvas, self._episodes = Canvas(recording, LINES), episodes
        self._steps: list[ShownStep] = []  # Whose numbers are not drawn yet
        self._driver = ""
        self._returns: deque[float] = deque(maxlen=WINDOW)
        self._successes: deque[float] = deque(maxlen=WINDOW)
        self._canvas.lanes("driver", DRIVERS)

    def draw(self, entry: Entry) -> None:
        """Draw an entry; a step's numbers wait for the next picture, or for the episode's end."""
        if isinstance(entry, ShownEpisode):
            self.draw_steps()
            self._draw_episode(entry)
            return
        self._steps.append(entry)
        if entry.frames is not None:
            self.draw_steps()
            self._canvas.stand_at({TIMELINE: entry.number})
            self._draw_scene(entry.scene)
            if entry.frames.shape == FRAMES_SPACE.shape:
                for name, frame in zip(("before", "now"), entry.frames, strict=True):
                    self._canvas.log(f"frames/{name}", rr.Image(frame, color_model="L"))

    def draw_steps(self) -> None:
        """Draw the numbers that wait: a call for each step would cost as much as one for all."""
        steps, self._steps = self._steps, []
        if not steps:
            return
        times = rr.TimeColumn(TIMELINE, sequence=[step.number for step in steps])
        for path, name in NUMBERS.items():
            values = np.array([getattr(step, name) for step in steps]).reshape(len(steps), -1)
            count = values.shape[1]
            self._canvas.name_actions(path, [str(number) for number in range(1, count + 1)])
            rows = rr.Scalars.columns(scalars=values.ravel()).partition([count] * len(steps))
            self._canvas.recording.send_columns(path, indexes=[times], columns=rows)
        for step in steps:
            driver = step.reason or "policy"
            if driver != self._driver:
                self._driver = driver
                self._canvas.stand_at({TIMELINE: step.number})
                self._canvas.log("driver", rr.StateChange(state=driver))

    def _draw_scene(self, scene: Any) -> None:
        road = scene if isinstance(scene, SeenScene) else None
        lines = (road.roads, road.path, road.goal) if road else None
        if self._canvas.is_new_ground(lines or (scene is not None) or None):
            self._canvas.log("road", rr.Clear(recursive=True))
            if road:
                self._bounds = draw.view_bounds(road)
                self._canvas.recording.send_blueprint(make_blueprint(road, self._episodes))
                self._canvas.draw_ground(road)
        if road:
            self._canvas.draw_cars(road, self._bounds, DRIVERS.get(self._driver, HUMAN))
        elif scene is not None:
            self._canvas.log("road", rr.Image(scene, color_model="RGB"))

    def _draw_episode(self, episode: ShownEpisode) -> None:
        metrics = episode.metrics
        self._returns.append(metrics.episode_return)
        self._successes.append(float(metrics.outcome == GOAL))
        self._canvas.stand_at({TIMELINE: episode.last_step, "episode": metrics.episode})
        for path, value in {
            "return/episode": metrics.episode_return,
            "return/mean_of_20": float(np.mean(self._returns)),
            "success/mean_of_20": float(np.mean(self._successes)),
            "human/share": metrics.human_steps / metrics.steps,
            **{path: getattr(metrics, name) for path, (_, name) in MEASURED.items()},
        }.items():
            if not math.isnan(value):
                self._canvas.scalar(path, value)
        self._canvas.status(
            [
                f"# episode {metrics.episode + 1}: {metrics.outcome}",
                f"{counted(metrics.total_steps, 'step')} in all, {metrics.steps} in this episode",
                f"{counted(metrics.interventions, 'intervention')}, "
                f"{counted(metrics.human_steps, 'step')} the human's",
            ]
        )
        flush(self._canvas.recording)  # Only a flush notices that a viewer has gone.
