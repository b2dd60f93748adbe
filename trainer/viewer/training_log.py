"""A training's entries, written into a rerun recording; used by one thread."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, get_args

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bridge.messages import SeenScene, read_scene
from bridge.report import GOAL
from bridge.rerun import HUMAN, POLICY
from bridge.rerun.draw import (
    Plot,
    draw_cars,
    draw_ground,
    style_lines,
    style_points,
)
from bridge.rerun.sinks import flush
from edge_runtime.util import counted
from trainer.human.guide import Reason
from trainer.training.metrics import EpisodeMetrics
from trainer.viewer.advantage import q_advantage
from trainer.viewer.blueprint import LINES, POINTS, TIMELINE, make_blueprint
from trainer.viewer.entries import Entry, Episode, Picture, StepEntry, Steps

BY_POLICY = "policy"
DRIVERS = {BY_POLICY: POLICY, **dict.fromkeys(get_args(Reason), HUMAN)}
"""Who drives: the policy, or the human for one of these reasons; their colours on the time line."""
WINDOW = 20
"""Episodes of the moving means."""


class TrainingLog:
    """Draws one run.

    Args:
        recording: where.
        episodes: the plots of whole episodes that are laid out.
    """

    def __init__(self, recording: rr.RecordingStream, episodes: Sequence[Plot]) -> None:
        self._recording, self._episodes = recording, episodes
        self._driver = ""
        self._ground: tuple[Any, ...] = ()
        """What is drawn of the ground: recordings may be of several scenarios."""
        self._returns: deque[float] = deque(maxlen=WINDOW)
        self._successes: deque[float] = deque(maxlen=WINDOW)
        self._define_series()

    def draw(self, entry: Entry) -> None:
        """Draw what the loop has handed over."""
        if isinstance(entry, Steps):
            self._draw_steps(entry.entries)
            if entry.picture is not None:
                self._draw_picture(entry.picture)
        else:
            self._draw_episode(entry)

    def _define_series(self) -> None:
        style_lines(self._recording, LINES)
        style_points(self._recording, POINTS)
        lanes = rr.StateConfiguration(
            values=list(DRIVERS), labels=list(DRIVERS), colors=list(DRIVERS.values())
        )
        self._recording.log("driver", lanes, static=True)

    def _draw_steps(self, entries: list[StepEntry]) -> None:
        steps = np.array([entry.step for entry in entries])
        for path, values in (
            ("action/policy", [entry.policy_action for entry in entries]),
            ("action/applied", [entry.action for entry in entries]),
            ("speed/ego", [entry.speed_mps for entry in entries]),
        ):
            self._columns(path, steps, np.array(values))
        for entry in entries:
            self._tell_driver(entry)

    def _tell_driver(self, entry: StepEntry) -> None:
        """Draw who drives where that changes."""
        driver = BY_POLICY if entry.reason is None else entry.reason
        if driver == self._driver:
            return
        self._driver = driver
        self._stand_at(entry.step)
        self._recording.log("driver", rr.StateChange(state=driver))

    def _draw_picture(self, picture: Picture) -> None:
        self._stand_at(picture.step)
        if picture.scene:
            self._draw_road(read_scene(picture.scene))
        before, now = picture.frames
        self._recording.log("frames/before", rr.Image(before, color_model="L"))
        self._recording.log("frames/now", rr.Image(now, color_model="L"))

    def _draw_road(self, scene: SeenScene) -> None:
        ground = (scene.roads, scene.path, scene.goal)
        if ground != self._ground:
            self._ground = ground
            self._recording.send_blueprint(make_blueprint(scene, self._episodes))
            draw_ground(self._recording, scene)
        draw_cars(self._recording, scene, DRIVERS[self._driver or BY_POLICY])

    def _draw_episode(self, episode: Episode) -> None:
        metrics = episode.metrics
        self._returns.append(metrics.episode_return)
        self._successes.append(float(metrics.outcome == GOAL))
        self._stand_at(episode.step)
        self._recording.set_time("episode", sequence=metrics.episode)
        for path, value in self._numbers(metrics).items():
            if not math.isnan(value):
                self._recording.log(path, rr.Scalars(value))
        self._recording.log("status", _status(metrics))
        self._recording.reset_time()
        if episode.critic is not None:
            steps = np.array([correction.step for correction in episode.corrections])
            values = [q_advantage(episode.critic, each) for each in episode.corrections]
            self._columns("advantage/of_the_human", steps, np.array(values))
        flush(self._recording)  # A viewer that is gone takes everything without a word.

    def _numbers(self, metrics: EpisodeMetrics) -> dict[str, float]:
        return {
            "return/episode": metrics.episode_return,
            "return/mean_of_20": float(np.mean(self._returns)),
            "success/mean_of_20": float(np.mean(self._successes)),
            "success/validation": metrics.validation_success,
            "loss/critic": metrics.critic_loss,
            "loss/policy": metrics.policy_loss,
            "loss/cloning": metrics.cloning_loss,
            "priority/human": metrics.human_priority,
            "priority/policy": metrics.policy_priority,
            "human/share": metrics.human_steps / metrics.steps,
        }

    def _columns(self, path: str, steps: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Many numbers in one call: each of its own costs as much as all of these."""
        rr.send_columns(
            path,
            indexes=[rr.TimeColumn(TIMELINE, sequence=steps)],
            columns=rr.Scalars.columns(scalars=values),
            recording=self._recording,
        )

    def _stand_at(self, step: int) -> None:
        self._recording.reset_time()
        self._recording.set_time(TIMELINE, sequence=step)


def _status(metrics: EpisodeMetrics) -> rr.TextDocument:
    lines = [
        f"# episode {metrics.episode}: {metrics.outcome}",
        f"{counted(metrics.total_steps, 'step')} in all, {metrics.steps} in this episode",
        f"{counted(metrics.interventions, 'intervention')}, "
        f"{counted(metrics.human_steps, 'step')} the human's",
        f"{metrics.distance_m:.1f} m, return {metrics.episode_return:.1f}",
    ]
    if not math.isnan(metrics.validation_success):
        lines.append(f"validation: success {metrics.validation_success:.0%}")
    return rr.TextDocument("\n\n".join(lines), media_type="text/markdown")
