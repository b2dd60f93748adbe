"""One unit from its first step to its record: training, test drives, and what is kept of both.

What is killed goes on from its last checkpoint, to the same bits.
"""

import json
import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from bridge.outcomes import GOAL
from edge_runtime.files import write_json
from edge_runtime.util import read_bytes, read_json
from trainer import util
from trainer.environments import make_environment
from trainer.evaluation import (
    BEST_FILE,
    CHECKPOINT_FILE,
    CONSTANT,
    constant_driver,
    drive_episodes,
    drive_together,
    is_expert,
    load_actor,
    load_driver,
)
from trainer.experiments import plan
from trainer.experiments.plan import TASKS, Line, Study, Unit
from trainer.experiments.records import (
    ARRIVED_ONLY,
    DISTANCE,
    RECORD_FILE,
    REWARD,
    Record,
    Store,
    columns_of,
    summarise_tests,
)
from trainer.human import MODEL_FILE
from trainer.learner.kernel import load as load_kernel
from trainer.learner.networks import bfloat16_is_faster
from trainer.training.config import CONFIG_FILE, PRESETS, RunConfig
from trainer.training.metrics import METRICS_FILE, EpisodeMetrics, read_metrics, was_validated
from trainer.training.run import TrainingRun

FINISHED, STOPPED, BUSY, FAILED = "finished", "stopped", "busy", "failed"
"""How work on a unit ends: with its record; with a checkpoint, for lack of time; at once, since
another process has it; with an error."""
EPISODES = {
    "total_steps": "end_step",
    "episode_return": "return",
    "distance_m": "distance_m",
    "outcome": "outcome",
    "human_steps": "human_steps",
    "interventions": "takeovers",
    "validation_success": "validation_success",
    "validation_distance_m": "validation_distance_m",
    "validation_reward": "validation_reward",
}
"""Column of a run's metrics -> column of the table of episodes."""
TIMES = ["environment_s", "acting_s", "storing_s", "waiting_s"]
"""Columns of the metrics that add up to the time that a training took."""
UNLIMITED_EPISODES = 10**6  # So many that steps decide


@dataclass(frozen=True)
class Job:
    """A unit to be computed."""

    unit: Unit
    store: Store
    stop_at_s: float = math.inf
    """Seconds of the epoch after which work stops with the next episode."""
    device: str = "cpu"  # Where its learner computes

    @property
    def run_dir(self) -> Path:
        """Where the unit is trained."""
        return self.store.run_dir(self.unit)

    @property
    def human_model(self) -> Path:
        """The human model of its scenario."""
        return self.store.humans / self.unit.scenario / MODEL_FILE


def compute(job: Job) -> str:
    """Compute a unit from where it stands and write its record; return how that ended.

    torch works on one thread: the last bits must not depend on the machine's cores.
    """
    torch.set_num_threads(1)
    if time.time() > job.stop_at_s or (job.unit.trained and not _train(job)):
        return STOPPED
    write_json(job.run_dir / RECORD_FILE, make_record(job))
    # The actor stays, for export and for tests to come; what learning needs is large.
    (job.run_dir / CHECKPOINT_FILE).unlink(missing_ok=True)
    return FINISHED


def run_config(job: Job) -> RunConfig:
    """Return the settings of a unit's training."""
    values = job.store.study.config(job.unit)
    start, learner = PRESETS[values.pop("preset")], values.pop("learner")
    if job.unit.needs_human:
        values["human"] = str(job.human_model.parent)
    return replace(
        start,
        **values,
        episodes=UNLIMITED_EPISODES,
        checkpoint_every=job.store.study.checkpoint_every,
        threads=1,
        device=job.device,
        learner=replace(start.learner, **learner),
    )


def _train(job: Job) -> bool:
    """Train to the budget's end; return whether it was reached.

    The run quits when time is out, and has no deadline in ``TrainingRun.train``: that one validates
    once more when it stops, as no unbroken run does.
    """
    config, run_dir = run_config(job), job.run_dir
    rows = read_metrics(run_dir)
    over = rows and int(rows[-1]["total_steps"]) >= config.steps
    if over and was_validated(rows[-1]) and (run_dir / BEST_FILE).is_file():
        return True  # trained before; the checkpoint may be gone already
    run = TrainingRun(config, run_dir, resume=(run_dir / CHECKPOINT_FILE).is_file())

    def after(metrics: EpisodeMetrics) -> None:
        if time.time() > job.stop_at_s:
            run.quitting = True

    run.train(after)
    return run.over


def make_record(job: Job) -> Record:
    """Test a unit, trained or not; return its rows of each table."""
    unit, study = job.unit, job.store.study
    tables: dict[str, pd.DataFrame] = {}
    own: dict[str, Any] = {}
    device, policy = "cpu", unit.scripted_human
    if unit.trained:
        rows = pd.read_csv(job.run_dir / METRICS_FILE)
        episodes = rows[[*EPISODES]].rename(columns=EPISODES)
        tables["episodes"] = episodes.map(_rounded)
        env = make_environment(TASKS[unit.scenario][0])
        tested = load_actor(job.run_dir, env)[1]["episode"]  # counted from 1
        own = {
            "period_s": env.control_period_s,
            "updates": int(rows.updates.iloc[-1]),
            "tested_actor_at_step": int(rows.total_steps[tested - 1]),
            "training_s": round(rows[TIMES].sum(axis=None)),
        }
        # Not the job's: the unit may have been trained before.
        device = read_json(job.run_dir / CONFIG_FILE, "settings")["device"]
        policy = str(job.run_dir)
    elif unit.algorithm == plan.CONSTANT:
        own = best_constant(unit.scenario, study)
        policy = f"{CONSTANT}{own['action']}"
    elif unit.algorithm == plan.HUMAN_MODEL:
        policy = str(job.human_model.parent)
    began_s = time.monotonic()
    drives = drive_tests(unit, policy, study.of(unit.scenario))
    own["tests_s"] = round(time.monotonic() - began_s)
    tables["tests"] = summarise_tests(unit.scenario, drives)
    if Line(unit.algorithm, unit.setting) in plan.BOXED:
        tables["drives"] = arrivals(drives, plan.BOXES[unit.scenario])
    row = {
        "digest": study.digest(unit),
        "config": json.dumps(study.config(unit), separators=(",", ":")),
        "human_model": None,
        **own,
        **_computed_on(device),
    }
    if unit.needs_human:
        model = sha256(read_bytes(job.human_model, "human model"))
        row["human_model"] = model.hexdigest()[: plan.ID_LENGTH]
    record = {name: columns_of(table) for name, table in tables.items()}
    return {**record, "units": {name: [value] for name, value in row.items()}}


def _rounded(value: Any) -> Any:
    """Return a number with five digits; anything else as it is."""
    return float(f"{value:.5g}") if isinstance(value, float) else value


def drive_tests(unit: Unit, policy: str, study: Study) -> pd.DataFrame:
    """Return the test drives of a policy, a row each, condition by condition."""
    environment, seeds = TASKS[unit.scenario][0], range(study.test_runs)
    columns = ["outcome", DISTANCE, REWARD, *ARRIVED_ONLY]
    tests = []
    for condition in unit.conditions:
        env = make_environment(environment, condition)
        driver: Any = load_driver(policy, env)[0]
        if is_expert(policy):  # it has a memory, and drives its own environment only
            drives = drive_episodes(env, driver, seeds, condition)
        else:
            more = range(min(study.together, study.test_runs) - 1)
            envs = [env, *(make_environment(environment, condition) for _ in more)]
            drives = drive_together(envs, driver.act_together, seeds, condition)
        tests += [(condition, drive.seed, *(_rounded(getattr(drive, name)) for name in columns))
                  for drive in drives]  # fmt: skip
    return pd.DataFrame(tests, columns=["condition", "drive", *columns])


def arrivals(drives: pd.DataFrame, quantities: Iterable[str]) -> pd.DataFrame:
    """Return the rows of the table of drives: those that reach the goal."""
    return drives.loc[drives.outcome == GOAL, ["condition", "drive", *quantities]]


def best_constant(scenario: str, study: Study) -> dict[str, Any]:
    """Return the constant action that is best on validation drives, and its success there.

    Searched on two grids: from -1 to 1, then a step to either side of the best one.
    """
    envs = [make_environment(scenario) for _ in range(study.together)]
    seeds = [util.episode_seed(0, util.Purpose.VALIDATION, run) for run in range(study.search_runs)]
    worth: dict[float, tuple[float, float]] = {}

    def search(low: float, high: float) -> float:
        for action in np.linspace(low, high, study.search_points).round(3).tolist():
            if action not in worth:
                results = drive_together(envs, constant_driver(action).act_together, seeds)
                success = np.mean([result.outcome == GOAL for result in results])
                worth[action] = float(success), float(np.mean([r.distance_m for r in results]))
        return max(worth, key=lambda action: (*worth[action], -abs(action)))

    coarse, reach = search(-1.0, 1.0), 2.0 / (study.search_points - 1)
    best = search(max(coarse - reach, -1.0), min(coarse + reach, 1.0))
    return {"action": best, "searched": len(worth), "search_success": worth[best][0]}


def _computed_on(device: str) -> dict[str, Any]:
    """Return what computed: the same settings give other bits elsewhere."""
    there = torch.cuda.is_available()
    gpu = torch.cuda.get_device_name() if there else "of another machine"
    return {
        "processor": util.processor_model(),
        "gpu": gpu if device == "cuda" else None,
        "bfloat16": bfloat16_is_faster(device),
        "compiled_kernel": load_kernel() is not None,
        "torch": torch.__version__,
        "source_revision": util.source_revision(),
    }
