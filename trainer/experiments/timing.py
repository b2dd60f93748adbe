"""Seconds for 10,000 training steps of each algorithm, in turns within one process."""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edge_runtime.files import make_directory
from trainer.experiments.plan import FOUR, NORMAL, TIME, Unit, run_config, training_id
from trainer.experiments.run import one_thread
from trainer.experiments.statistics import RESAMPLES, Estimate, bootstrap
from trainer.experiments.store import Store
from trainer.training.run import TrainingRun
from trainer.util import ProgressBar, about

TIME_FILE = f"{TIME}.json"
PAPER_S = dict(zip(FOUR, (360.70, 348.71, 328.93, 329.39), strict=True))
"""The paper's table of time efficiency: seconds for 10,000 steps."""
SCENARIO = "left_turn"
STEPS = 10_000
Turns = list[tuple[int, float]]
"""Steps and seconds of each turn of an algorithm."""


def measure(store: Store) -> dict[str, Any]:
    """Train all algorithms in turns of one episode, so that a machine that slows down slows all
    down; what comes before the first update is not counted.

    Who begins a round ends the next one.
    """
    turns: dict[str, Turns] = {name: [] for name in FOUR}
    steps = dict.fromkeys(FOUR, 0)
    units = [Unit(SCENARIO, name, NORMAL, 1) for name in FOUR]
    wanted = store.plan.timed_steps
    with one_thread(), tempfile.TemporaryDirectory() as directory, ExitStack() as closing:
        runs = {}
        for unit in units:
            config = run_config(unit, store.plan, store.humans)
            run_dir = Path(directory) / unit.algorithm
            make_directory(run_dir)
            run = runs[unit.algorithm] = TrainingRun(
                replace(config, evaluate_every_steps=0), run_dir
            )
            closing.callback(run.learning.close)
            while run.learning.added < config.learner.warmup_steps:
                run.advance()
        names, bar = list(FOUR), closing.enter_context(ProgressBar("steps", len(FOUR) * wanted))
        while min(steps.values()) < wanted:
            for name in names:
                began_s = time.perf_counter()
                driven = runs[name].advance().steps
                turns[name].append((driven, round(time.perf_counter() - began_s, 4)))
                bar.advance({"last": name}, min(driven, max(wanted - steps[name], 0)))
                steps[name] += driven
            names = names[1:] + names[:1]
        machine = about()
    ids = {unit.algorithm: training_id(unit, store.plan, store.humans) for unit in units}
    return {**machine, "trainings": ids, "turns": turns}


def seconds(turns: Turns) -> float:
    """For 10,000 steps."""
    driven, spent_s = np.sum(turns, axis=0)
    return float(STEPS * spent_s / driven)


def ratio(ours: Turns, other: Turns) -> Estimate:
    """Our time for a step over another's, with a 95 % bootstrap interval over the rounds."""
    count = min(len(ours), len(other))
    rounds = np.random.default_rng(0).integers(count, size=(RESAMPLES, count))
    own, its = (np.asarray(turns, float)[:count][rounds].sum(axis=1) for turns in (ours, other))
    ratios = (own[:, 1] / own[:, 0]) / (its[:, 1] / its[:, 0])
    return bootstrap(ratios.tolist(), seconds(ours) / seconds(other), count)
