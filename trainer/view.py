"""Show a training in rerun as it goes on (``train --rerun``), and test episodes, or film them.

The training loop only hands each step over, and never waits. A thread of its own draws, because
calls of rerun take time.
"""

import math
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bridge.environments import draws
from bridge.rerun import APPLIED, HUMAN, POLICY, flush, open_sink

# isort: split
import rerun as rr
import rerun.blueprint as rrb

from bridge.messages import Pace, SeenScene, read_scene
from bridge.rerun import draw
from bridge.rerun.draw import Canvas
from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import make_directory
from edge_runtime.util import UserError, counted
from trainer.environments import entries_of
from trainer.human.guide import REASONS, Intervention, Record
from trainer.learner.replay import Transition
from trainer.scenarios import SCENARIOS
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun

HELD_S = 1.0  # An episode's last picture in a film
MOST_WAITING = 5000
"""Entries, of which ten a second have pictures. A view that is slower loses some; the loop none."""
EPISODES = {
    "return": ("Return of an episode", ["episode_return"]),
    "success": ("Success of the policy alone, in validation", ["validation_success"]),
    "loss": ("Losses, means of an episode", ["critic_loss", "policy_loss", "cloning_loss"]),
    "priority": (
        "Mean priority in the replay buffer: the human's samples, the policy's",
        ["human_priority", "policy_priority"],
    ),
    "human": ("Steps of an episode, and the human's part of them", ["steps", "human_steps"]),
    "cost": (
        "So far: the human's seconds, take-overs, failures",
        ["total_human_s", "total_takeovers", "total_failures"],
    ),
}
"""Plot -> its title, and the fields of an episode's metrics in it."""
DRIVERS = {"policy": POLICY, **dict.fromkeys(REASONS, HUMAN)}
"""The policy, or the human for one of these reasons -> the colour on the time line."""
Entry = Callable[["TrainingLog"], None]
Layout = Callable[[SeenScene | None], rrb.Blueprint]


@contextmanager
def watched(run: TrainingRun, sink: str) -> Iterator[Callable[[EpisodeMetrics], None]]:
    """Show a run for as long as it lasts; call what is yielded after each episode."""
    waiting: queue.Queue[Entry | None] = queue.Queue(MOST_WAITING)
    number, pace = run.steps, Pace(draw.PICTURE_INTERVAL_S)

    def put(entry: Entry) -> None:
        with suppress(queue.Full):
            waiting.put_nowait(entry)

    def record(
        seen: Transition, intervention: Intervention | None, info: Mapping[str, Any]
    ) -> None:
        nonlocal number
        number, at = number + 1, number
        driver, speed_mps = intervention.reason if intervention else "policy", info["speed_mps"]
        shown = _shown(run.env, seen) if pace.due(time.monotonic()) else {}
        put(lambda log: log.draw_step(at, seen, driver, speed_mps, **shown))

    with sigterm_as_interrupt():  # Here, as signals are the main thread's.
        entries = iter(waiting.get, None)
        thread = threading.Thread(target=draw_all, args=(entries, sink), name="viewer", daemon=True)
        thread.start()
        run.recorders.append(record)
        try:
            yield lambda metrics: put(lambda log: log.draw_episode(metrics))
        finally:
            run.recorders.remove(record)
            waiting.put(None)  # After what still waits
            thread.join()


@contextmanager
def drives_watched(env: Any, sink: str) -> Iterator[Record]:
    """Show test episodes, every step of them; yield what takes a control period."""
    numbers = count()

    def record(seen: Transition, _: Any, info: Mapping[str, Any]) -> None:
        log.draw_step(next(numbers), seen, "policy", info["speed_mps"], **_shown(env, seen))
        log.canvas.scalar("reward/step", seen.reward)
        log.canvas.status(f"# episode {info['episode'] + 1}: {info.get('outcome', 'drives')}")

    with open_sink(sink, "phil_hil_evaluation", lay_out_drives(None)) as recording:
        log = TrainingLog(recording, lay_out_drives)
        yield record


@contextmanager
def filmed(env: Any, target: Path) -> Iterator[Record]:
    """Film test episodes; yield what takes a control period. A film appears when it is complete."""
    from bridge.lerobot import film  # It needs an extra

    if env.scenario not in SCENARIOS and not draws(env.env):
        raise UserError(f"{env.scenario} draws no rgb_array that could be filmed")
    make_directory(target.parent)
    part, period_s = target.with_name(f".{os.getpid()}.{target.name}"), env.control_period_s

    def record(seen: Transition, _: Any, info: Mapping[str, Any]) -> None:
        picture, at_s = Image.fromarray(np.asarray(env.render())), info["step"] * period_s
        said = f"episode {info['episode'] + 1}, {at_s:.1f} s {info.get('outcome', '')}"
        look: Any = {"font_size": 18, "stroke_width": 2, "stroke_fill": "white"}
        ImageDraw.Draw(picture).text((8, 6), said, "black", **look)
        for _ in range(round(HELD_S / period_s) if seen.terminal or seen.truncated else 1):
            add(np.asarray(picture))

    try:
        with film(part, Fraction(1 / period_s).limit_denominator(1000)) as add:
            yield record
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


def draw_all(entries: Iterable[Entry], sink: str) -> None:
    """Draw entries in order; an error is reported once, and ends the drawing, not the run."""
    try:
        with open_sink(sink, "phil_hil_training", lay_out(None)) as recording:
            log = TrainingLog(recording)
            for entry in entries:
                entry(log)
    except BaseException as error:  # a panic of rerun's Rust is no Exception
        print(f"{error}; the run is unharmed", file=sys.stderr, flush=True)
        for _ in entries:
            pass  # Else the last one would wait for ever for its place in the queue.


def _shown(env: Any, seen: Transition) -> dict[str, Any]:
    """Return what the policy sees, and the scene or the picture, where there is one."""
    found: dict[str, Any] = {"observation": entries_of(seen.observation, "frames")}
    with suppress(Exception):  # Of any kind: it is somebody else's code, and the training goes on.
        scene = env.scene()
        found |= {"picture": env.render()} if scene is None else {"scene": read_scene(scene)}
    return found


def lay_out(scene: SeenScene | None) -> rrb.Blueprint:
    """Lay out the views; ``scene`` fixes the ground shown (None: as rerun sees fit)."""
    left = rrb.Vertical(
        draw.road_view(scene),
        draw.sees_view(),
        draw.lanes_view("driver", "Who drives: the policy, or the human, and why"),
        draw.plot_view("action", "Action, from -1 to 1"),
        draw.plot_view("speed", "Speed, m/s"),
        row_shares=[3, 1.6, 0.9, 1.2, 1.1],
    )
    right = rrb.Vertical(
        *(draw.plot_view(origin, title) for origin, (title, _) in EPISODES.items())
    )
    return draw.two_columns(left, right, [1, 1], "step")


def lay_out_drives(scene: SeenScene | None) -> rrb.Blueprint:
    """Lay out the views of test episodes, as `lay_out`."""
    left = rrb.Vertical(draw.road_view(scene), draw.sees_view(), row_shares=[3, 1.4])
    plots = {"action": "Action, from -1 to 1", "speed": "Speed, m/s", "reward": "Reward of a step"}
    right = rrb.Vertical(*(draw.plot_view(*plot) for plot in plots.items()))
    return draw.two_columns(left, right, [3, 2], "step")


class TrainingLog:
    """Draws one run, or test episodes."""

    def __init__(self, recording: rr.RecordingStream, layout: Layout = lay_out) -> None:
        self.canvas, self._last_step = Canvas(recording, layout, {"driver": DRIVERS}), 0
        self.canvas.style("action/policy", POLICY, ["policy"])
        self.canvas.style("action/applied", APPLIED, ["applied"])

    def draw_step(
        self,
        number: int,
        seen: Transition,
        driver: str,
        speed_mps: float,
        observation: Mapping[str, NDArray[Any]] | None = None,
        scene: SeenScene | None = None,
        picture: NDArray[np.uint8] | None = None,
    ) -> None:
        """Draw a control period; with pictures in at most ten steps a second.

        ``number``: since the run began; ``driver``: "policy", or why the human acted.
        """
        canvas, self._last_step = self.canvas, number
        canvas.stand_at(number)
        assert seen.overruled is not None  # Of a policy that learns
        canvas.scalar("action/policy", *seen.overruled)
        canvas.scalar("action/applied", *seen.action)
        canvas.scalar("speed/ego", speed_mps)
        canvas.state("driver", driver)
        if observation is not None:
            canvas.observation(observation)
        if scene is not None or picture is not None:
            image = None if picture is None else rr.Image(picture, color_model="RGB")
            canvas.road(scene, image, DRIVERS.get(driver, HUMAN))

    def draw_episode(self, metrics: EpisodeMetrics) -> None:
        self.canvas.stand_at(self._last_step)
        for plot, (_, fields) in EPISODES.items():
            for name in fields:
                if not math.isnan(value := getattr(metrics, name)):
                    self.canvas.scalar(f"{plot}/{name}", value)
        self.canvas.status(
            f"# episode {metrics.episode + 1}: {metrics.outcome}",
            f"{counted(metrics.total_steps, 'step')} in all, {metrics.steps} in this episode",
            f"{counted(metrics.interventions, 'intervention')}, "
            f"{counted(metrics.human_steps, 'step')} the human's",
        )
        flush(self.canvas.recording)  # Only a flush notices that a viewer has gone.
