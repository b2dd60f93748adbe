"""Measure learner, environment and whole training."""

from __future__ import annotations

import argparse
import json
import platform
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_runtime.cli import write_json_out
from edge_runtime.files import check_writable
from trainer.commands.options import add_threads, set_threads
from trainer.drivers import make_environment
from trainer.export import real_observations
from trainer.learner.algorithms import PHIL
from trainer.learner.config import LearnerConfig
from trainer.learner.replay import ReplayBuffer
from trainer.learner.td3 import TD3Learner
from trainer.scenarios import SCENARIOS
from trainer.training.config import RunConfig
from trainer.training.run import TrainingRun

EXAMPLE = "example: python -m trainer bench --threads 2 --out bench.json"
TRANSITIONS = 1000
UPDATES = 30
STEPS = 4000
TRAINING_EPISODES = 6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", metavar="R.json", help="also write the figures to this file")
    add_threads(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure and print; returns the exit status."""
    if arguments.out:
        check_writable(arguments.out)
    set_threads(arguments.threads)
    report = {
        "threads": torch.get_num_threads(),
        "processor": platform.processor() or platform.machine(),
        "learner_ms_per_update": learner_ms_per_update(),
        "environment_steps_per_s": {name: environment_steps_per_s(name) for name in SCENARIOS},
        "train_s_per_10k_steps": train_s_per_10k_steps(),
    }
    print(json.dumps(report, indent=2))
    if arguments.out:
        write_json_out(arguments.out, report)
    return 0


def learner_ms_per_update() -> float:
    """Median of whole PHIL-TD3 updates at batch 128: drawing, update, new priorities."""
    config, random = LearnerConfig(), np.random.default_rng(0)
    learner, replay = TD3Learner(config, PHIL, seed=0), _filled_replay(random)
    times_ms = []
    for _ in range(UPDATES):
        began_s = time.perf_counter()
        batch = replay.sample(config.batch_size, random)
        losses = learner.update(batch)
        replay.update_priorities(batch.indices, losses.priorities)
        times_ms.append(1e3 * (time.perf_counter() - began_s))
    return float(np.median(times_ms))


def environment_steps_per_s(scenario: str) -> float:
    """Steps a second with observation, resets included, under a wandering pedal."""
    env = make_environment(scenario)
    random = np.random.default_rng(0)
    actions = random.uniform(-1, 1, (STEPS, *env.action_space.shape)).astype(np.float32)
    env.reset(seed=0)
    began_s = time.perf_counter()
    for step, action in enumerate(actions):
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset(seed=step)
    return STEPS / (time.perf_counter() - began_s)


def train_s_per_10k_steps() -> dict[str, float]:
    """Seconds for 10,000 steps of PHIL-TD3 in the left turn, scaled up, and where they go."""
    config = RunConfig(
        episodes=TRAINING_EPISODES,
        evaluate_every=0,
        checkpoint_every=TRAINING_EPISODES + 1,
        learner=LearnerConfig(warmup_steps=128),
    )
    parts = {"environment": 0.0, "acting": 0.0, "learning": 0.0}
    updated_steps = 0

    def add(metrics: Any) -> None:
        nonlocal updated_steps
        if metrics.critic_loss != metrics.critic_loss or metrics.total_steps - metrics.steps < 128:
            return
        updated_steps += metrics.steps
        for name in parts:
            parts[name] += getattr(metrics, f"{name}_s")

    with tempfile.TemporaryDirectory() as directory:
        TrainingRun(config, Path(directory)).train(add)
    scaled = {name: 1e4 * seconds / updated_steps for name, seconds in parts.items()}
    return {"total": sum(scaled.values()), **scaled}


def _filled_replay(random: np.random.Generator) -> ReplayBuffer:
    replay = ReplayBuffer(2 * TRANSITIONS)
    observations = real_observations("left_turn", TRANSITIONS + 1)
    replay.start_episode(observations[0])
    for observation in observations[1:]:
        action = random.uniform(-1, 1, 1).astype(np.float32)
        replay.add(action, float(random.normal()), observation, False, random.random() < 0.2)
    return replay
