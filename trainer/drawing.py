"""What a view of a training is made of, and how rerun draws it.

Entries are plain values, handed over whole by ``view.py``; one thread draws them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from bridge.rerun import APPLIED, HUMAN, POLICY, flush

# isort: split
import rerun as rr
import rerun.blueprint as rrb

from bridge.messages import SeenScene, read_scene
from bridge.report import GOAL
from bridge.rerun.draw import (
    ALL_OF_IT,
    BLUE,
    GREY,
    ORANGE,
    PURPLE,
    Plot,
    draw_cars,
    draw_ground,
    frames_view,
    full_blueprint,
    plot_view,
    road_view,
    style_lines,
    style_points,
)
from edge_runtime.util import counted
from trainer.human.guide import Reason
from trainer.learner.networks import Critic
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import Seen

APPLICATION, SITTING_APPLICATION = "phil_hil_training", "phil_hil_sittings"
TIMELINE = "step"
RECENT_STEPS = 200
"""Shown of what changes within an episode."""
EPISODES = (
    Plot("return", "Return of an episode, and the mean of 20"),
    Plot("success", "Success: mean of 20 episodes, and policy alone in validation", (-0.05, 1.05)),
    Plot("loss", "Losses, means of an episode"),
    Plot("priority", "Mean priority in the replay buffer: the human's samples, the policy's"),
    Plot("human", "The human's share of the steps", (-0.05, 1.05)),
    Plot("advantage", "Q advantage of the human's action, where it took over"),
)
"""The plots of a training, from top to bottom."""
SITTINGS = (EPISODES[0], EPISODES[1], EPISODES[4])
"""The plots of recorded sittings, which hold nothing of a learner."""
RECENT = (
    Plot("action", "Action in [-1, 1], the last 20 s", (-1.1, 1.1)),
    Plot("speed", "Speed, m/s, the last 20 s"),
)
LINES = {
    "return/episode": GREY,
    "return/mean_of_20": BLUE,
    "success/mean_of_20": BLUE,
    "success/validation": ORANGE,
    "loss/critic": PURPLE,
    "loss/policy": POLICY,
    "loss/cloning": HUMAN,
    "priority/human": HUMAN,
    "priority/policy": POLICY,
    "human/share": HUMAN,
    "action/policy": POLICY,
    "action/applied": APPLIED,
    "speed/ego": BLUE,
}
POINTS = {"advantage/of_the_human": HUMAN}
ROAD = "Road from above (blue: the policy drives, green: the human)"
BY_POLICY = "policy"
DRIVERS = {BY_POLICY: POLICY, **dict.fromkeys(get_args(Reason), HUMAN)}
"""Who drives: the policy, or the human for one of these reasons; their colours on the time line."""
WINDOW = 20
"""Episodes of the moving means."""


class StepEntry(NamedTuple):
    """The numbers of one control period."""

    step: int
    """Since the run began."""
    policy_action: float
    action: float
    speed_mps: float
    reason: Reason | None
    """Why the human acted; None where the policy did."""


class Steps(NamedTuple):
    """Some control periods, and perhaps the picture of the last one: not more than ten a second."""

    entries: list[StepEntry]
    frames: NDArray[np.uint8] | None = None
    """What the policy saw, [2, 45, 80]."""
    scene: dict[str, Any] | None = None
    """The environment's; None, too, where the road is not known."""


class Episode(NamedTuple):
    """An episode's end."""

    step: int
    metrics: EpisodeMetrics
    corrections: Sequence[tuple[int, Seen]] = ()
    """Steps at which the human acted, and what was seen there."""
    critic: Critic | None = None
    """A copy that nobody trains; None without corrections."""


Entry = Steps | Episode


@torch.no_grad()
def q_advantage(critic: Critic, seen: Seen) -> float:
    """Q'(s, a_human) - Q'(s, a_policy): eq. 21b's exponent, for the action that was overruled.

    One picture at a time: that takes this thread alone, where a batch would bring a second pool of
    threads beside the learner's.
    """
    picture = critic.embed(torch.from_numpy(seen.observation)[None])
    actions = torch.tensor([seen.action.tolist(), seen.policy_action.tolist()])
    human, policy = critic.value(picture.expand(2, -1), actions).tolist()
    return human - policy


def make_blueprint(scene: SeenScene | None, episodes: Sequence[Plot]) -> rrb.Blueprint:
    """Lay out the views; the ground shown is fixed by the first scene (None: as rerun sees fit)."""
    recent = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-RECENT_STEPS),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    left = rrb.Vertical(
        road_view(scene, ROAD),
        frames_view(),
        rrb.StateTimelineView(
            origin="driver",
            name="Who drives: the policy, or the human, and why",
            time_view=rrb.TimeAxis(view_range=ALL_OF_IT),
        ),
        *(plot_view(plot, recent) for plot in RECENT),
        row_shares=[3, 1.6, 0.9, 1.2, 1.1],
    )
    right = rrb.Vertical(*map(plot_view, episodes))
    return full_blueprint(left, right, [1, 1], TIMELINE)


class TrainingLog:
    """Draws one run, with the plots of whole ``episodes`` laid out."""

    def __init__(self, recording: rr.RecordingStream, episodes: Sequence[Plot]) -> None:
        self._recording, self._episodes = recording, episodes
        self._driver = ""
        self._ground: tuple[Any, ...] = ()
        """What is drawn of the ground: recordings may be of several scenarios."""
        self._returns: deque[float] = deque(maxlen=WINDOW)
        self._successes: deque[float] = deque(maxlen=WINDOW)
        style_lines(recording, LINES)
        style_points(recording, POINTS)
        names, colours = list(DRIVERS), list(DRIVERS.values())
        lanes = rr.StateConfiguration(values=names, labels=names, colors=colours)
        recording.log("driver", lanes, static=True)

    def draw(self, entry: Entry) -> None:
        """Draw what the loop has handed over."""
        if isinstance(entry, Episode):
            self._draw_episode(entry)
            return
        steps = np.array([each.step for each in entry.entries])
        for path, values in (
            ("action/policy", [each.policy_action for each in entry.entries]),
            ("action/applied", [each.action for each in entry.entries]),
            ("speed/ego", [each.speed_mps for each in entry.entries]),
        ):
            self._columns(path, steps, np.array(values))
        for each in entry.entries:
            driver = each.reason or BY_POLICY
            if driver != self._driver:
                self._driver = driver
                self._stand_at(each.step)
                self._recording.log("driver", rr.StateChange(state=driver))
        if entry.frames is not None:
            self._stand_at(entry.entries[-1].step)
            if entry.scene is not None:
                self._draw_road(read_scene(entry.scene))
            for name, frame in zip(("before", "now"), entry.frames, strict=True):
                self._recording.log(f"frames/{name}", rr.Image(frame, color_model="L"))

    def _draw_road(self, scene: SeenScene) -> None:
        ground = (scene.roads, scene.path, scene.goal)
        if ground != self._ground:
            self._ground = ground
            self._recording.send_blueprint(make_blueprint(scene, self._episodes))
            draw_ground(self._recording, scene)
        draw_cars(self._recording, scene, DRIVERS[self._driver])

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
            "success/validation": metrics.validation_success,
            "loss/critic": metrics.critic_loss,
            "loss/policy": metrics.policy_loss,
            "loss/cloning": metrics.cloning_loss,
            "priority/human": metrics.human_priority,
            "priority/policy": metrics.policy_priority,
            "human/share": metrics.human_steps / metrics.steps,
        }.items():
            if not math.isnan(value):
                self._recording.log(path, rr.Scalars(value))
        self._recording.log("status", _status(metrics))
        self._recording.reset_time()
        if episode.critic is not None:
            steps = np.array([step for step, _ in episode.corrections])
            values = [q_advantage(episode.critic, seen) for _, seen in episode.corrections]
            self._columns("advantage/of_the_human", steps, np.array(values))
        flush(self._recording)  # A viewer that is gone takes everything without a word.

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
