"""Show a training in rerun as it goes on (``train --rerun``), or recorded sittings (``view``).

The training loop only gathers what must be taken while it is there, and never waits; a thread of
its own does everything that takes time, rerun's calls and the critic's. A sitting's recording does
not hold the road: the same seed and the same actions drive it again.
"""

from __future__ import annotations

import argparse
import copy
import math
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from bridge.messages import Pace
from bridge.rerun import (
    SERVE,
    Sink,
    ViewerGone,
    add_sink,
    check_sink,
    flush,
    open_sink,
    read_sink,
)
from bridge.rerun.draw import PICTURE_INTERVAL_S
from edge_runtime.cli import examples, sigterm_as_interrupt
from edge_runtime.util import counted
from trainer.drawing import (
    APPLICATION,
    EPISODES,
    SITTING_APPLICATION,
    SITTINGS,
    Entry,
    Episode,
    StepEntry,
    Steps,
    TrainingLog,
    make_blueprint,
)
from trainer.drivers import make_environment
from trainer.human.guide import Reason
from trainer.person.recording import Step, find_recordings, read_steps
from trainer.training.metrics import NAMES, EpisodeMetrics
from trainer.training.run import Seen, TrainingRun

EXAMPLE = examples(
    "python -m trainer view runs/drives --serve",
    "python -m trainer view runs/mine/sittings/sitting-0001.mcap --save sitting.rrd",
)
LOOK_S = 0.2
"""The kernel may hand a signal to any thread, which does not wake this one from a longer sleep."""
STEPS_TOGETHER = 50
"""Numbers are handed over with a picture, or when there are so many."""
CORRECTIONS = 32
"""The Q advantage is shown for so many of an episode, evenly spread: the critic takes time."""
MOST_WAITING = 500
"""Entries, some 50 s of pictures: a view that is slower loses some, and the loop nothing."""
Draw = Callable[[Entry], None]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "recordings",
        metavar="RECORDING",
        nargs="+",
        help="sitting-NNNN.mcap, a directory of such, or a run that a person guided",
    )
    add_sink(parser)


def run(arguments: argparse.Namespace) -> int:
    """Draw all of it; a page is served until somebody interrupts. Returns the exit status."""
    paths = find_recordings([Path(place) for place in arguments.recordings])
    sink = check_sink(arguments.sink)
    for path in paths:  # Before a window opens, or a file takes another's place.
        next(read_steps(path), None)
    with open_sink(sink, SITTING_APPLICATION, make_blueprint(None, SITTINGS)) as recording:
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
        try:
            while sink.kind == SERVE:
                time.sleep(LOOK_S)
        except KeyboardInterrupt:
            pass
    return 0


def check_word(word: str) -> Sink:
    """The sink that ``--rerun`` names; UserError where nothing could be shown there."""
    return check_sink(read_sink(word))


@contextmanager
def watched(run: TrainingRun, sink: Sink) -> Iterator[Callable[[EpisodeMetrics], None]]:
    """Show a run for as long as it lasts; what it yields is to be called after each episode."""

    @contextmanager
    def opened() -> Iterator[Draw]:
        with open_sink(sink, APPLICATION, make_blueprint(None, EPISODES)) as recording:
            yield TrainingLog(recording, EPISODES).draw

    # Here, as signals are the main thread's.
    with sigterm_as_interrupt():
        background = Background(opened)
        watcher = Watcher(run, background.put)
        run.on_step = watcher.on_step
        try:
            yield watcher.on_episode
        finally:
            run.on_step = None
            watcher.close()
            background.close()
            if background.dropped:
                print(f"{background.dropped} entries came faster than drawn", file=sys.stderr)


class Watcher:
    """Looks on at one run; ``put`` takes what is to be drawn, and must not block."""

    def __init__(self, run: TrainingRun, put: Draw) -> None:
        self._run, self._put = run, put
        self._pace = Pace(PICTURE_INTERVAL_S)
        self._step = run.learning.added
        self._entries: list[StepEntry] = []
        self._corrections: list[tuple[int, Seen]] = []

    def on_step(self, seen: Seen) -> None:
        """Take a control period."""
        reason = None
        if seen.intervention is not None:
            reason = seen.intervention.reason
            self._corrections.append((self._step, seen))
        actions = float(seen.policy_action[0]), float(seen.action[0])
        self._entries.append(StepEntry(self._step, *actions, seen.speed_mps, reason))
        self._step += 1
        if self._pace.due(time.monotonic()):
            self._hand_over(seen.observation, self._run.env.scene())
        elif len(self._entries) >= STEPS_TOGETHER:
            self._hand_over()

    def close(self) -> None:
        """Hand over what an episode that was broken off has left."""
        self._hand_over()

    def on_episode(self, metrics: EpisodeMetrics) -> None:
        """Take an episode's end; no update is under way."""
        self._hand_over()
        corrections, self._corrections = self._corrections, []
        critic = None
        if corrections:
            critic = copy.deepcopy(self._run.learning.learner.target_critics.first).cpu()
        stride = -(-len(corrections) // CORRECTIONS) or 1
        self._put(Episode(max(self._step - 1, 0), metrics, corrections[::stride], critic))

    def _hand_over(self, *picture: Any) -> None:
        entries, self._entries = self._entries, []
        if entries:
            self._put(Steps(entries, *picture))


class Background:
    """Opens a view, draws each entry in order, and closes it, in a thread of its own.

    What any of it raises is told once, and ends the drawing, not the run.
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
                pass  # The queue is emptied all the same: close() must not wait for ever.


@dataclass
class Shown:
    """What a view of sittings amounts to."""

    steps: int = 0
    human_steps: int = 0
    episodes: int = 0
    without_road: int = 0
    """Episodes whose scenario drives differently today: their road is not shown."""
    _envs: dict[str, Any] = field(default_factory=dict)

    def entries(self, paths: Iterable[Path]) -> Iterator[Entry]:
        """Everything in these recordings, end to end; each episode ends with its own entry."""
        for path in paths:
            for _, episode in groupby(read_steps(path), key=lambda step: step.episode):
                yield from self._episode(list(episode))

    def _episode(self, episode: list[Step]) -> Iterator[Entry]:
        road = self._drive_again(episode)
        for number, step in enumerate(episode):
            policy = math.nan if step.policy_action is None else step.policy_action
            reason: Reason | None = "person" if step.human else None
            entry = StepEntry(self.steps, policy, step.action, step.speed_mps, reason)
            yield Steps([entry], step.observation, road[number] if road else None)
            self.steps += 1
        human_steps = sum(step.human for step in episode)
        # What only a learner knows is nan.
        known: dict[str, Any] = {
            "episode": self.episodes,
            "total_steps": self.steps,
            "steps": len(episode),
            "episode_return": sum(step.reward for step in episode),
            "outcome": episode[-1].outcome or "cut off",
            "interventions": sum(step.first for step in episode),
            "human_steps": human_steps,
        }
        metrics = EpisodeMetrics(**{**dict.fromkeys(NAMES, math.nan), **known})
        yield Episode(self.steps - 1, metrics)
        self.human_steps += human_steps
        self.without_road += not road
        self.episodes += 1

    def _drive_again(self, episode: list[Step]) -> list[dict[str, Any]]:
        """The scene at each step, by the same seed and the same actions; empty where it differs."""
        first, scenes = episode[0], []
        if first.step != 0:
            return []  # Its beginning was in another file, which is gone.
        env = self._envs.setdefault(first.scenario, make_environment(first.scenario))
        observation, _ = env.reset(seed=first.seed)
        for step in episode:
            if not np.array_equal(observation, step.observation):
                return []
            scenes.append(env.scene())
            observation, *_ = env.step(np.array([step.action], np.float32))
        return scenes
