"""Measure the learner, the environments and a training on this machine."""

import argparse
import contextlib
import json
import os
import tempfile
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bridge.report import ProgressBar
from edge_runtime.files import check_writable, write_json_out
from trainer.environments import make_environment
from trainer.learner.config import LearnerConfig
from trainer.scenarios import SCENARIOS
from trainer.training.config import RunConfig
from trainer.training.learning import LearningThread
from trainer.training.run import TrainingRun
from trainer.util import processor_model, set_threads, source_revision

ROUNDS = 20
UPDATES, STEPS = 5, 200  # In a round; so many steps are about three episodes
PARTS = ("environment", "acting", "storing", "learning", "waiting")


def run(arguments: argparse.Namespace) -> int:
    check_writable(arguments.out)
    set_threads(arguments.threads)
    report = measure()
    write_json_out(arguments.out, report)
    print(json.dumps(report, indent=2))
    return 0


def measure(batch_size: int = LearnerConfig.batch_size) -> dict[str, Any]:
    """Return the report: machine and versions, and the contract's three figures."""
    learner = LearnerConfig(batch_size=batch_size, warmup_steps=batch_size)
    with (
        ProgressBar("bench", 2 + len(SCENARIOS)) as bar,
        tempfile.TemporaryDirectory() as directory,
    ):
        run = TrainingRun(RunConfig(evaluate_every_steps=0, learner=learner), Path(directory))
        with contextlib.closing(run.learning):
            training = measure_training(run)
            bar.advance({})
            update_s = run.learning.in_thread(median_s, whole_update(run.learning), UPDATES)
            bar.advance({"update": f"{1e3 * update_s:.1f} ms"})
        step_s = {}
        for name in SCENARIOS:
            step_s[name] = median_s(steps_of(name), STEPS)
            bar.advance({name: f"{1 / step_s[name]:.0f} steps/s"})
    return {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "source_revision": source_revision(),
        "batch_size": batch_size,
        "learner_ms_per_update": 1e3 * update_s,
        "environment_steps_per_s": {name: 1.0 / value for name, value in step_s.items()},
        "train_s_per_10k_steps": training,
    }


def median_s(work: Callable[[], object], pieces: int) -> float:
    """Return the median over rounds of a piece's seconds; one more round is not counted."""
    times = []
    for _ in range(1 + ROUNDS):
        began_s = time.perf_counter()
        for _ in range(pieces):
            work()
        times.append((time.perf_counter() - began_s) / pieces)
    return float(np.median(times[1:]))


def whole_update(learning: LearningThread) -> Callable[[], None]:
    """Return an update of PHIL-TD3 on what was driven: drawing, learning, new priorities."""
    random, replay = np.random.default_rng(0), learning.replay

    def update() -> None:
        batch = replay.sample(learning.config.batch_size, random)
        losses = learning.learner.update(batch, 0.0)
        replay.update_priorities(batch.indices, losses.priorities)

    return update


def steps_of(scenario: str) -> Callable[[], None]:
    """Return a step of a scenario, with its observation, under random actions."""
    env, random, seeds = make_environment(scenario), np.random.default_rng(0), count()
    env.reset(seed=next(seeds))

    def drive() -> None:
        _, _, terminated, truncated, _ = env.step(random.uniform(-1, 1, 1).astype(np.float32))
        if terminated or truncated:
            env.reset(seed=next(seeds))

    return drive


def measure_training(run: TrainingRun) -> dict[str, float]:
    """Train with an update a step, without validation or checkpoint.

    Returns seconds for 10,000 steps, scaled up: the wall-clock total, and its parts.
    """
    while run.learning.replay.added < run.config.learner.warmup_steps:
        run.advance()
    began_s = time.perf_counter()
    driven = [run.advance() for _ in range(ROUNDS // 2)]
    seconds = {"total": time.perf_counter() - began_s}
    seconds |= {name: sum(getattr(each, f"{name}_s") for each in driven) for name in PARTS}
    steps = sum(each.steps for each in driven)
    return {name: 1e4 / steps * value for name, value in seconds.items()}
