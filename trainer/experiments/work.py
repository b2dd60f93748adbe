"""One unit from its first episode to its result: train, test the best validated actor, keep."""

from __future__ import annotations

import csv
import io
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from edge_runtime.episode_report import EpisodeResult
from edge_runtime.files import make_directory
from trainer.benches.machine import processor_model
from trainer.conditions import CONDITIONS
from trainer.drivers import BEST_FILE, CHECKPOINT_FILE, load_actor, load_driver, make_environment
from trainer.evaluation import drive_episodes
from trainer.experiments.store import TESTS_FILE, UNIT_FILE, Store
from trainer.experiments.units import Unit, deciding, run_config
from trainer.learner.kernel import load as load_kernel
from trainer.learner.precision import multiplies_bfloat16
from trainer.revision import source_revision
from trainer.training.metrics import METRICS_FILE, EpisodeMetrics, read_metrics
from trainer.training.run import TrainingRun

KEPT_METRICS = (
    "episode",
    "total_steps",
    "steps",
    "episode_return",
    "distance_m",
    "outcome",
    "interventions",
    "human_steps",
    "validation_success",
    "validation_distance_m",
    "validation_reward",
)
"""Columns of a run's metrics that are committed."""
KEPT_TESTS = (
    "seed",
    "outcome",
    "distance_m",
    "time_s",
    "reward",
    "lateral_acceleration_mps2",
    "longitudinal_acceleration_mps2",
)
"""What is committed of each test episode."""
DIGITS = 5
FINISHED, STOPPED, BUSY = "finished", "stopped", "busy"
"""How work on a unit ends: with its result; at a checkpoint, for lack of time; at once, since
another process has it."""

PATIENCE_S = 1.0
"""How long a unit may be held before it counts as another process's work."""

OnEpisode = Callable[[int], None]
"""Told how many episodes of the unit are done."""


@dataclass(frozen=True)
class Task:
    """A unit to be computed, and how."""

    unit: Unit
    store: Store
    device: str = "cpu"
    stop_at_s: float = math.inf
    """Seconds of the epoch after which work stops at its next checkpoint."""


def compute(task: Task, on_episode: OnEpisode) -> str:
    """Compute a unit into its store, from where it stands; how that ended."""
    with task.store.lock(task.unit, PATIENCE_S) as free:
        if not free:
            return BUSY
        if task.store.done(task.unit):
            return FINISHED
        run_dir = task.store.run_dir(task.unit)
        files = advance(task, run_dir, on_episode)
        if files is None:
            return STOPPED
        task.store.put(task.unit, files)
        # The actor stays for export and for tests to come; what learning needs is large.
        (run_dir / CHECKPOINT_FILE).unlink(missing_ok=True)
        return FINISHED


def advance(task: Task, run_dir: Path, on_episode: OnEpisode) -> dict[str, bytes] | None:
    """Train and test a unit in ``run_dir``.

    Returns:
        The result's files; None where time ran out, and a checkpoint holds what was done.
    """
    if time.time() > task.stop_at_s:
        return None
    make_directory(run_dir)
    files: dict[str, bytes] = {}
    policy = str(task.store.humans / task.unit.scenario)
    if task.unit.trained:
        if not _train(task, run_dir, on_episode):
            return None
        policy = str(run_dir)
        files[METRICS_FILE] = _csv_of(read_metrics(run_dir))
    files[TESTS_FILE] = _lines_of(_test(task, policy))
    files[UNIT_FILE] = (json.dumps(_about(task, run_dir), indent=2) + "\n").encode()
    return files


class _OutOfTimeError(Exception):
    """Ends training at a checkpoint."""


def _train(task: Task, run_dir: Path, on_episode: OnEpisode) -> bool:
    """Train to the last episode; whether it was reached.

    Time is looked at only where a checkpoint was just written, and not through the deadline of
    ``train``: that one validates once more when it stops, a row that no unbroken run has.
    """
    config = run_config(task.unit, task.store.plan, task.store.humans, task.device)
    if _trained(run_dir, config.episodes):
        return True
    run = TrainingRun(config, run_dir, resume=(run_dir / CHECKPOINT_FILE).is_file())

    def after(metrics: EpisodeMetrics) -> None:
        on_episode(run.episode)
        at_checkpoint = run.episode % config.checkpoint_every == 0
        if at_checkpoint and run.episode < config.episodes and time.time() > task.stop_at_s:
            raise _OutOfTimeError

    try:
        run.train(after)
    except _OutOfTimeError:
        return False
    return True


def _trained(run_dir: Path, episodes: int) -> bool:
    """Whether training had ended before; its checkpoint may be gone already."""
    rows = read_metrics(run_dir)
    complete = len(rows) == episodes and None not in rows[-1].values()
    return complete and (run_dir / BEST_FILE).is_file() and bool(rows[-1]["validation_success"])


def _test(task: Task, policy: str) -> dict[str, list[EpisodeResult]]:
    """The test episodes in every condition."""
    results = {}
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # as in `trainer evaluate`: the last bits must not depend on it
    for condition in CONDITIONS:
        env = make_environment(task.unit.scenario, condition)
        driver, _ = load_driver(policy, env)
        results[condition] = drive_episodes(
            env, driver, range(task.store.plan.test_runs), condition
        )
    torch.set_num_threads(before)
    return results


def _about(task: Task, run_dir: Path) -> dict[str, Any]:
    rows = read_metrics(run_dir)
    names = ["environment_s", "acting_s", "storing_s"]
    if task.device == "cpu":
        names.append("waiting_s")  # elsewhere a part of acting
    seconds = sum(float(row.get(name) or 0.0) for row in rows for name in names)
    about = {
        "id": task.store.id(task.unit),
        **deciding(task.unit, task.store.plan, task.store.humans),
        "computed": {
            "device": task.device,
            "processor": processor_model(),
            "bfloat16": multiplies_bfloat16(task.device),
            "compiled_kernel": load_kernel("trunk") is not None,
            "torch": torch.__version__,
            "source_revision": source_revision(),
            "training_s": round(seconds),
        },
    }
    if task.unit.trained:
        # Counted from 1, as everywhere in the results: the actor after so many episodes.
        about["tested_actor_of_episode"] = load_actor(run_dir)[1]["episode"]
    return about


def _csv_of(rows: Sequence[dict[str, str]]) -> bytes:
    """The kept columns; five digits, and nothing where there is no number."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(KEPT_METRICS)
    for row in rows:
        writer.writerow([_short(row[name]) for name in KEPT_METRICS])
    return text.getvalue().encode()


def _short(text: str) -> str:
    try:
        value = float(text)
    except ValueError:
        return text  # an outcome
    if math.isnan(value):
        return ""
    return text if value.is_integer() and "." not in text else f"{value:.{DIGITS}g}"


def _lines_of(tests: dict[str, list[EpisodeResult]]) -> bytes:
    """JSON with one line for each condition and quantity, so that changes can be read."""
    conditions = []
    for condition, results in tests.items():
        columns = []
        for name in KEPT_TESTS:
            values = [_rounded(getattr(result, name)) for result in results]
            columns.append(f"{json.dumps(name)}: {json.dumps(values, allow_nan=False)}")
        conditions.append(f"{json.dumps(condition)}: {{\n" + ",\n".join(columns) + "\n}")
    return ("{\n" + ",\n".join(conditions) + "\n}\n").encode()


def _rounded(value: Any) -> Any:
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
