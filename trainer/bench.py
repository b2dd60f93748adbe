"""Measure learner, environments and training, beside Stable-Baselines3 and highway-env.

Contenders take turns within one run, so that the machine's noise hits all of them alike.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from edge_runtime.cli import examples
from edge_runtime.files import check_writable, write_json_out
from trainer.bench_peers import HighwayPicture, check_varies, filled, gather, make_sb3_model
from trainer.drivers import make_environment
from trainer.learner.config import PHIL, LearnerConfig
from trainer.learner.networks import multiplies_bfloat16
from trainer.learner.replay import ReplayBuffer
from trainer.learner.td3 import TD3Learner
from trainer.options import add_threads, set_threads
from trainer.scenarios import SCENARIOS
from trainer.training.config import RunConfig
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun
from trainer.util import ProgressBar, about

EXAMPLE = examples(
    "python -m trainer bench --quick --threads 1",
    "python -m trainer bench --threads 2 --out b.json",
)
OURS, FLOAT32, SB3, HIGHWAY = "ours", "ours_float32", "stable_baselines3", "highway_env_grayscale"
PEERS = {
    FLOAT32: "the same in float32",
    SB3: "Stable-Baselines3 TD3",
    HIGHWAY: "highway-env grayscale",
}
SB3_BAR = 4.0
"""At least as many times Stable-Baselines3's updates."""
ENVIRONMENT_BARS = {"left_turn": 10.0, "congestion": 8.0}
"""At least as many times highway-env's steps."""
TRANSITIONS = 1000
"""In each learner's buffer, not the paper's 100,000: drawing from a full one costs no more."""
PARTS = ("environment", "acting", "storing", "learning", "waiting")
FILE_WIDTH = 120
Contender = Callable[[], Sequence[float]]
"""Works for a moment and gives the time of each piece of its work."""
Rounds = list[list[float]]
"""The times that one contender gave, round by round."""
Tick = Callable[[str], None]
"""Told what was done, once a round."""


@dataclass(frozen=True)
class Effort:
    """Counts. More of them give the same figures with less noise."""

    batch_size: int = LearnerConfig.batch_size
    """Transitions in a minibatch of every learner (table A5)."""
    rounds: int = 20
    """Of the learners, and of each scenario."""
    updates_per_round: int = 5
    steps_per_round: int = 200
    """About three episodes."""
    training_episodes: int = 10
    """Counted ones: those before the first update come on top."""

    @property
    def ticks(self) -> int:
        """What the progress bar counts to."""
        return self.rounds * (1 + len(SCENARIOS)) + self.training_episodes


FULL = Effort()
QUICK = Effort(rounds=4, updates_per_round=3, training_episodes=3)
"""A look, not a measurement."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", metavar="R.json", help="also write the figures to this file")
    parser.add_argument("--quick", action="store_true", help="take few rounds: a look only")
    add_threads(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure and print; returns the exit status."""
    if arguments.out:
        check_writable(arguments.out)
    set_threads(arguments.threads)
    effort = QUICK if arguments.quick else FULL
    with ProgressBar("bench", effort.ticks) as bar:
        report = measure(effort, lambda done: bar.advance({"last": done}))
    show(report)
    write_json_out(arguments.out, report)
    return 0


def measure(effort: Effort, tick: Tick) -> dict[str, Any]:
    """The report: machine and versions, the contract's three figures, and each part in full."""
    learner = measure_learner(effort, tick)
    environment = {name: measure_environment(name, effort, tick) for name in SCENARIOS}
    training = measure_training(effort, tick)
    return {
        **about(),
        "learner_ms_per_update": learner["ms_per_update"],
        "environment_steps_per_s": {
            name: figures["steps_per_s"] for name, figures in environment.items()
        },
        "train_s_per_10k_steps": training["s_per_10k_steps"],
        "learner": learner,
        "environment": environment,
        "training": training,
    }


def take_turns(
    contenders: Mapping[str, Contender], rounds: int, tick: Tick = lambda done: None
) -> dict[str, Rounds]:
    """Each contender once a round, after one round that is not counted.

    The one that begins a round ends the next: none is always measured first.
    """
    names = list(contenders)
    times: dict[str, Rounds] = {name: [] for name in names}
    for name in names:
        contenders[name]()
    for number in range(rounds):
        first = number % len(names)
        for name in names[first:] + names[:first]:
            times[name].append(list(contenders[name]()))
        tick(" and ".join(names))
    return times


def median(rounds: Rounds) -> float:
    """Of all the times."""
    return float(np.median([time for times in rounds for time in times]))


def compare(ours: Rounds, peer: Rounds) -> dict[str, float]:
    """How many times as long the peer takes in the same rounds; above 1 we are faster.

    The median of the rounds' own ratios is beside that of all times: what slows one whole round
    down cancels out of it.
    """
    each = [median([theirs]) / median([own]) for own, theirs in zip(ours, peer, strict=True)]
    return {"of_medians": median(peer) / median(ours), "median_of_rounds": float(np.median(each))}


def timed_ms(work: Callable[[], object]) -> float:
    """How long a call takes, ms."""
    began_s = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - began_s)


def updates(learner: TD3Learner, replay: ReplayBuffer, batch_size: int, count: int) -> Contender:
    """Whole updates of a learner of ours, ms each: drawing, update, new priorities."""
    random = np.random.default_rng(0)

    def update() -> None:
        batch = replay.sample(batch_size, random)
        losses = learner.update(batch, 0.0)
        replay.update_priorities(batch.indices, losses.priorities)

    return lambda: [timed_ms(update) for _ in range(count)]


def measure_learner(effort: Effort, tick: Tick) -> dict[str, Any]:
    """Milliseconds of a PHIL-TD3 update and of Stable-Baselines3's, where that is installed.

    Ours in float32 is beside them where the processor has bfloat16; elsewhere ours is just that.
    """
    config, experience = LearnerConfig(batch_size=effort.batch_size), gather(TRANSITIONS)
    count = effort.updates_per_round
    precision = config.precision if multiplies_bfloat16("cpu") else "float32"
    configs = {OURS: config}
    if precision != "float32":
        configs[FLOAT32] = replace(config, precision="float32")
    contenders: dict[str, Contender] = {
        name: updates(TD3Learner(own, PHIL, seed=0), filled(experience), own.batch_size, count)
        for name, own in configs.items()
    }
    with contextlib.suppress(ImportError):
        model = make_sb3_model(experience)
        train = partial(model.train, gradient_steps=1, batch_size=config.batch_size)
        contenders[SB3] = lambda: [timed_ms(train) for _ in range(count)]
    found = figures(take_turns(contenders, effort.rounds, tick), "ms_per_update")
    more = {"batch_size": config.batch_size, "precision": precision}
    return {**more, **found, "updates_per_s": 1e3 / found["ms_per_update"]}


def figures(
    times: dict[str, Rounds], name: str, of: Callable[[float], float] = float
) -> dict[str, Any]:
    """A figure ``of`` the median time of ours and of each peer, and each peer's ratio to ours."""
    ours = times[OURS]
    peers = {
        peer: {name: of(median(rounds)), "ratio": compare(ours, rounds)}
        for peer, rounds in times.items()
        if peer != OURS
    }
    return {name: of(median(ours)), "peers": peers}


class Drive:
    """Drives on where it stopped, episode after episode.

    Args:
        step: takes an action [1] and says whether the episode ended.
        reset: starts the episode with a seed.
    """

    def __init__(
        self, step: Callable[[NDArray[np.float32]], bool], reset: Callable[[int], Any]
    ) -> None:
        self._step, self._reset = step, reset
        self._random = np.random.default_rng(0)  # All contenders drive the same episodes.
        self.episodes = 0
        reset(0)

    def run(self, steps: int) -> list[float]:
        """Seconds a step, resets included, under actions at random."""
        actions = self._random.uniform(-1, 1, (steps, 1)).astype(np.float32)
        began_s = time.perf_counter()
        for action in actions:
            if self._step(action):
                self.episodes += 1
                self._reset(self.episodes)
        return [(time.perf_counter() - began_s) / steps]


def our_drive(scenario: str) -> Drive:
    """The scenario as it is."""
    env = make_environment(scenario)
    return Drive(lambda action: any(env.step(action)[2:4]), lambda seed: env.reset(seed=seed))


def highway_drive(scenario: str) -> Drive:
    """The same traffic in highway-env's picture."""
    picture = HighwayPicture(make_environment(scenario))
    check_varies(picture)
    return Drive(lambda action: picture.step(action)[1], lambda seed: picture.reset(seed=seed))


def measure_environment(scenario: str, effort: Effort, tick: Tick) -> dict[str, Any]:
    """The scenario's steps a second with observation, and its peer's."""
    drives = {OURS: our_drive(scenario), HIGHWAY: highway_drive(scenario)}
    contenders = {name: partial(each.run, effort.steps_per_round) for name, each in drives.items()}
    return figures(take_turns(contenders, effort.rounds, tick), "steps_per_s", lambda s: 1.0 / s)


def measure_training(effort: Effort, tick: Tick) -> dict[str, Any]:
    """PHIL-TD3 in the left turn with an update in every step; no validation, no checkpoint."""
    learner = LearnerConfig(batch_size=effort.batch_size, warmup_steps=effort.batch_size)
    config = RunConfig(evaluate_every_steps=0, learner=learner)
    episodes: list[EpisodeMetrics] = []
    with tempfile.TemporaryDirectory() as directory:
        run = TrainingRun(config, Path(directory))
        try:
            while run.learning.added < learner.warmup_steps:
                run.advance()
            began_s = time.perf_counter()
            for _ in range(effort.training_episodes):
                episodes.append(run.advance())
                tick("training")
            whole_s = time.perf_counter() - began_s
        finally:
            run.learning.close()
    return training_figures(episodes, whole_s)


def training_figures(episodes: Sequence[EpisodeMetrics], whole_s: float) -> dict[str, Any]:
    """Seconds for 10,000 steps, scaled up: the whole by the clock on the wall, and its parts."""
    steps = sum(episode.steps for episode in episodes)
    parts_s = {name: sum(getattr(each, f"{name}_s") for each in episodes) for name in PARTS}
    seconds = {"total": whole_s, **parts_s}
    scaled = {name: 1e4 / steps * value for name, value in seconds.items()}
    return {"episodes": len(episodes), "steps": steps, "s_per_10k_steps": scaled}


class Row(NamedTuple):
    """One line."""

    what: str
    ours: str
    peer: str = ""
    ratio: str = ""
    bar: str = ""


def show(report: dict[str, Any]) -> None:
    """Print the table to stdout."""
    machine = report["machine"]
    title = f"{machine['processor']}, {machine['cores']} cores, threads: {report['threads']}"
    table = Table(title=title, box=box.SIMPLE, title_justify="left")
    for name in Row._fields:
        number = name in ("ours", "ratio")
        table.add_column(name, no_wrap=number, justify="right" if number else "left")
    for row in rows(report):
        table.add_row(*row)
    # A file has no width; rich would fold its lines at 80.
    width = None if sys.stdout.isatty() else FILE_WIDTH
    Console(markup=False, highlight=False, width=width).print(table)


def rows(report: dict[str, Any]) -> Iterator[Row]:
    """The lines of what was measured."""
    learner, seconds = report["learner"], report["training"]["s_per_10k_steps"]
    what = f"PHIL-TD3 update, batch {learner['batch_size']}, ms"
    yield from _beside(what, learner, "ms_per_update", {SB3: SB3_BAR})
    if SB3 not in learner["peers"]:
        yield Row(what, f"{learner['ms_per_update']:.1f}", f"{PEERS[SB3]} is not installed")
    for scenario, found in report["environment"].items():
        bars = {HIGHWAY: ENVIRONMENT_BARS[scenario]}
        yield from _beside(f"{scenario} with observation, steps/s", found, "steps_per_s", bars)
    yield Row("training, s per 10,000 steps", f"{seconds['total']:.1f}")
    for name in PARTS:
        yield Row(f"  of it {name}", f"{seconds[name]:.1f}")


def _beside(what: str, found: dict[str, Any], key: str, bars: dict[str, float]) -> Iterator[Row]:
    """Ours beside each peer's, and whether the ratio is as high as it is to be."""
    for name, peer in found["peers"].items():
        ratio, bar = peer["ratio"]["of_medians"], ""
        if name in bars:
            bar = f"≥ {bars[name]:g}  {'met' if ratio >= bars[name] else 'MISSED'}"
        theirs = f"{peer[key]:.1f}  {PEERS[name]}"
        yield Row(what, f"{found[key]:.1f}", theirs, f"{ratio:.2f}", bar)
