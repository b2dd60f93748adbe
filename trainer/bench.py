"""Measure learner, environments and training; the learner beside Stable-Baselines3's.

Contenders take turns within one run, so that the machine's noise hits all alike.
"""

import argparse
import contextlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import nn

from bridge.report import ProgressBar, markdown_table
from edge_runtime.files import check_writable, write_json_out
from trainer.environments import make_environment
from trainer.learner.config import PHIL, LearnerConfig
from trainer.learner.networks import bfloat16_is_faster
from trainer.learner.replay import ReplayBuffer, Transition
from trainer.learner.td3 import TD3Learner
from trainer.options import set_threads
from trainer.policy_file import real_observations
from trainer.scenarios import SCENARIOS
from trainer.training.config import RunConfig
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun
from trainer.util import processor_model, source_revision

OURS, FLOAT32, SB3 = "ours", "ours_float32", "stable_baselines3"
PEERS = {FLOAT32: "the same in float32", SB3: "Stable-Baselines3 TD3"}
BAR = 5.0  # Our learner shall be at least so many times as fast as Stable-Baselines3's
TRANSITIONS = 1000
"""In each learner's buffer, instead of the paper's 100,000: drawing costs the same."""
PARTS = ("environment", "acting", "storing", "learning", "waiting")
Work = Callable[[], object]  # A contender's piece of work: an update, or a step
Times = dict[str, list[float]]  # Contender -> seconds for a piece of work, round by round
Tick = Callable[[str], None]  # Called once a round with what was done


@dataclass(frozen=True)
class Effort:
    """Counts; higher ones give the same figures with less noise."""

    batch_size: int = LearnerConfig.batch_size  # Of every learner (table A5)
    rounds: int = 20  # Of the learners, and of each scenario
    updates_per_round: int = 5
    steps_per_round: int = 200  # About three episodes
    training_episodes: int = 10  # Besides those before the first update


FULL, QUICK = Effort(), Effort(rounds=4, updates_per_round=3, training_episodes=3)


def run(arguments: argparse.Namespace) -> int:
    check_writable(arguments.out)
    set_threads(arguments.threads)
    effort = QUICK if arguments.quick else FULL
    ticks = effort.rounds * (1 + len(SCENARIOS)) + effort.training_episodes
    with ProgressBar("bench", ticks) as bar:
        report = measure(effort, lambda done: bar.advance({"last": done}))
    write_json_out(arguments.out, report)
    show(report)
    return 0


def measure(effort: Effort, tick: Tick) -> dict[str, Any]:
    """Make the report: machine and versions, the contract's three figures, and each part."""
    learner = measure_learner(effort, tick)
    environment = {name: measure_environment(name, effort, tick) for name in SCENARIOS}
    training = measure_training(effort, tick)
    return {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "source_revision": source_revision(),
        "learner_ms_per_update": learner["ms_per_update"],
        "environment_steps_per_s": {name: it["steps_per_s"] for name, it in environment.items()},
        "train_s_per_10k_steps": training["s_per_10k_steps"],
        "learner": learner,
        "environment": environment,
        "training": training,
    }


def take_turns(contenders: Mapping[str, Work], rounds: int, pieces: int, tick: Tick) -> Times:
    """Time ``pieces`` of each contender's work a round, after one round that is not counted.

    Whoever begins a round ends the next: nobody is always measured first.
    """
    names = list(contenders)
    times: Times = {name: [] for name in names}
    for number in range(-1, rounds):
        first = max(number, 0) % len(names)
        for name in names[first:] + names[:first]:
            began_s = time.perf_counter()
            for _ in range(pieces):
                contenders[name]()
            times[name].append((time.perf_counter() - began_s) / pieces)
        if number >= 0:
            tick(" and ".join(names))
    return {name: each[1:] for name, each in times.items()}


def whole_update(learner: TD3Learner, replay: ReplayBuffer, batch_size: int) -> Work:
    """Return an update of our learner: drawing, learning, new priorities."""
    random = np.random.default_rng(0)

    def update() -> None:
        batch = replay.sample(batch_size, random)
        losses = learner.update(batch, 0.0)
        replay.update_priorities(batch.indices, losses.priorities)

    return update


def measure_learner(effort: Effort, tick: Tick) -> dict[str, Any]:
    """Measure a PHIL-TD3 update and, where it is installed, Stable-Baselines3's, in ms.

    Where bfloat16 is faster, ours is measured in float32, too.
    """
    config, experience = LearnerConfig(batch_size=effort.batch_size), gather(TRANSITIONS)
    precisions = {OURS: "float32"}
    if bfloat16_is_faster("cpu"):
        precisions = {OURS: "bfloat16", FLOAT32: "float32"}
    contenders: dict[str, Work] = {}
    for name, precision in precisions.items():
        learner = TD3Learner(replace(config, precision=precision), PHIL, seed=0)
        contenders[name] = whole_update(learner, filled(experience), config.batch_size)
    with contextlib.suppress(ImportError):
        model = make_sb3_model(experience)
        contenders[SB3] = partial(model.train, gradient_steps=1, batch_size=config.batch_size)
    times = take_turns(contenders, effort.rounds, effort.updates_per_round, tick)
    found = figures(times, "ms_per_update", lambda seconds: 1e3 * seconds)
    more = {"batch_size": config.batch_size, "precision": precisions[OURS]}
    return {**more, **found, "updates_per_s": 1e3 / found["ms_per_update"]}


def figures(times: Times, name: str, of: Callable[[float], float]) -> dict[str, Any]:
    """Return the figure ``of`` our median time, and each peer's with its ratio to our time."""
    medians = {each: float(np.median(times[each])) for each in times}
    ours = medians.pop(OURS)
    peers = {peer: {name: of(its), "ratio": its / ours} for peer, its in medians.items()}
    return {name: of(ours), "peers": peers}


def measure_environment(scenario: str, effort: Effort, tick: Tick) -> dict[str, Any]:
    """Measure a scenario's steps a second, with observation, under random actions."""
    env, random, seeds = make_environment(scenario), np.random.default_rng(0), count()
    env.reset(seed=next(seeds))

    def drive() -> None:
        _, _, terminated, truncated, _ = env.step(random.uniform(-1, 1, 1).astype(np.float32))
        if terminated or truncated:
            env.reset(seed=next(seeds))

    times = take_turns({OURS: drive}, effort.rounds, effort.steps_per_round, tick)
    return figures(times, "steps_per_s", lambda seconds: 1.0 / seconds)


def measure_training(effort: Effort, tick: Tick) -> dict[str, Any]:
    """Train PHIL-TD3 in the left turn with an update a step, without validation or checkpoint."""
    learner = LearnerConfig(batch_size=effort.batch_size, warmup_steps=effort.batch_size)
    episodes: list[EpisodeMetrics] = []
    with tempfile.TemporaryDirectory() as directory:
        run = TrainingRun(RunConfig(evaluate_every_steps=0, learner=learner), Path(directory))
        with contextlib.closing(run.learning):
            while run.learning.added < learner.warmup_steps:
                run.advance()
            began_s = time.perf_counter()
            for _ in range(effort.training_episodes):
                episodes.append(run.advance())
                tick("training")
            return training_figures(episodes, time.perf_counter() - began_s)


def training_figures(episodes: Sequence[EpisodeMetrics], whole_s: float) -> dict[str, Any]:
    """Return seconds for 10,000 steps, scaled up: the wall-clock total, and its parts."""
    steps = sum(episode.steps for episode in episodes)
    parts_s = {name: sum(getattr(each, f"{name}_s") for each in episodes) for name in PARTS}
    scaled = {name: 1e4 / steps * value for name, value in {"total": whole_s, **parts_s}.items()}
    return {"episodes": len(episodes), "steps": steps, "s_per_10k_steps": scaled}


def show(report: dict[str, Any]) -> None:
    machine = report["machine"]
    print(f"{machine['processor']}, {machine['cores']} cores, threads: {report['threads']}\n")
    print("\n".join(markdown_table(("what", "ours", "peer", "ratio", "bar"), rows(report))))


def rows(report: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield the table's rows: ours beside each peer's, and whether the bar is met."""
    learner, seconds = report["learner"], report["training"]["s_per_10k_steps"]
    what, ours = f"PHIL-TD3 update, batch {learner['batch_size']}, ms", learner["ms_per_update"]
    for peer, its in learner["peers"].items():
        verdict = "met" if its["ratio"] >= BAR else "MISSED"
        bar = f"≥ {BAR:g}  {verdict}" if peer == SB3 else ""
        theirs = f"{its['ms_per_update']:.1f}  {PEERS[peer]}"
        yield what, f"{ours:.1f}", theirs, f"{its['ratio']:.2f}", bar
    if SB3 not in learner["peers"]:
        yield what, f"{ours:.1f}", f"{PEERS[SB3]} is not installed", "", ""
    for name, found in report["environment"].items():
        yield f"{name} with observation, steps/s", f"{found['steps_per_s']:.1f}"
    yield "training, s per 10,000 steps", f"{seconds['total']:.1f}"
    yield from ((f"  of it {name}", f"{seconds[name]:.1f}") for name in PARTS)


Experience = list[tuple[Any, ...]]
"""Transitions of one long drive: frames [2, 45, 80], action [1], reward, next frames, and whether
the human acted. The observations are real, the rewards invented."""


def gather(size: int, seed: int = 0) -> Experience:
    """Drive the left turn at random; the human acts in a fifth, about as in a guided run."""
    random, frames = np.random.default_rng(seed), real_observations("left_turn", size + 1, seed)
    actions = random.uniform(-1, 1, (size, 1)).astype(np.float32)
    rewards = random.normal(size=size).astype(np.float32)
    human = random.random(size) < 0.2
    return [*zip(frames[:-1], actions, rewards, frames[1:], human, strict=True)]


def filled(experience: Experience) -> ReplayBuffer:
    replay = ReplayBuffer(len(experience))
    for before, action, reward, after, human in experience:
        replay.add(Transition(before, action, float(reward), after, False, human=bool(human)))
    return replay


def make_sb3_model(experience: Experience) -> Any:
    """Make Stable-Baselines3's TD3 with the networks of tables A2 and A3, and fill its replay.

    It does less than the paper asks for: both critics share one features extractor, the replay is
    uniform, and there is no Q advantage and no behaviour cloning. ImportError: not installed.
    """
    from stable_baselines3 import TD3
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class Trunk(BaseFeaturesExtractor):
        """The paper's two convolutions; the library normalises the pictures before."""

        def __init__(self, space: gymnasium.Space[Any]) -> None:
            super().__init__(space, features_dim=1792)
            first, second = nn.Conv2d(2, 6, 6), nn.Conv2d(6, 16, 6)
            pooled = [first, nn.ReLU(), nn.MaxPool2d(2), second, nn.ReLU(), nn.MaxPool2d(2)]
            self.layers = nn.Sequential(*pooled, nn.Flatten())

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return self.layers(images)

    model = TD3(
        "CnnPolicy", gymnasium.make(SCENARIOS["left_turn"]), learning_rate=2e-4, gamma=0.95,
        tau=1e-3, buffer_size=len(experience), policy_delay=1, device="cpu", seed=0,
        policy_kwargs={"features_extractor_class": Trunk, "net_arch": [256, 128, 64]},
    )  # fmt: skip
    model.set_logger(Logger(folder=None, output_formats=[]))
    assert model.replay_buffer is not None
    for *transition, _ in experience:
        before, action, reward, after = (each[None] for each in transition)
        model.replay_buffer.add(before, after, action, reward, np.zeros(1), [{}])
    return model
