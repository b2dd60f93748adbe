"""One unit from its first step to its record: training, test drives, and what is kept of both.

What is killed goes on from its last checkpoint, to the same bits.
"""

import json
import math
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bridge.outcomes import GOAL
from edge_runtime.files import write_json
from edge_runtime.util import read_bytes, read_json
from trainer import drivers, util
from trainer.drivers import BEST_FILE, CHECKPOINT_FILE, load_actor, load_driver
from trainer.environments import make_environment
from trainer.evaluation import drive_episodes, drive_together
from trainer.experiments import plan, records
from trainer.experiments.plan import Line, Study, Unit
from trainer.experiments.records import ARRIVED_ONLY, RECORD_FILE, Columns, Record, Store, rounded
from trainer.human.config import MODEL_FILE
from trainer.learner.kernel import load as load_kernel
from trainer.learner.networks import bfloat16_is_faster
from trainer.training.config import CONFIG_FILE, PRESETS, RunConfig
from trainer.training.metrics import METRICS_FILE, EpisodeMetrics, read_metrics, was_validated
from trainer.training.run import TrainingRun

FINISHED, STOPPED, BUSY, FAILED = "finished", "stopped", "busy", "failed"
"""How work on a unit ends: with its record; with a checkpoint, for lack of time; at once, since
another process has it; with an error."""
FILES = (CHECKPOINT_FILE, BEST_FILE, METRICS_FILE, CONFIG_FILE, RECORD_FILE)
"""What a unit goes on from, and what it leaves."""
EPISODES = {
    "end_step": "total_steps",
    "return": "episode_return",
    "distance_m": "distance_m",
    "outcome": "outcome",
    "human_steps": "human_steps",
    "takeovers": "interventions",
    "validation_success": "validation_success",
    "validation_distance_m": "validation_distance_m",
    "validation_reward": "validation_reward",
}
"""Column of the table of episodes -> column of a run's metrics."""
DRIVES = ("outcome", "distance_m", "reward", *ARRIVED_ONLY)  # What is measured in a test drive
TIMES = ("environment_s", "acting_s", "storing_s", "waiting_s")
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
    """Compute a unit from where it stands and write its record; return how that ended."""
    record = make_record(job)
    if record is None:
        return STOPPED
    write_json(job.run_dir / RECORD_FILE, record)
    # The actor stays, for export and for tests to come; what learning needs is large.
    (job.run_dir / CHECKPOINT_FILE).unlink(missing_ok=True)
    return FINISHED


def make_record(job: Job) -> Record | None:
    """Train and test a unit; return its rows of each table, or None where time ran out.

    torch works on one thread: the last bits must not depend on the machine's cores.
    """
    unit, study = job.unit, job.store.study
    if time.time() > job.stop_at_s:
        return None
    torch.set_num_threads(1)
    record: dict[str, Columns] = {}
    own: dict[str, Any] = {}
    device, policy = "cpu", unit.scripted_human
    if unit.trained:
        if not _train(job):
            return None
        rows = read_metrics(job.run_dir)
        record["episodes"] = {ours: [_value(row[theirs]) for row in rows]
                              for ours, theirs in EPISODES.items()}  # fmt: skip
        env = make_environment(unit.environment)
        tested = load_actor(job.run_dir, env)[1]["episode"]  # counted from 1
        own = {
            "period_s": env.control_period_s,
            "updates": int(rows[-1]["updates"]),
            "tested_actor_at_step": int(rows[tested - 1]["total_steps"]),
            "training_s": round(sum(float(row[key] or 0.0) for row in rows for key in TIMES)),
        }
        # Not the job's: the unit may have been trained before.
        device = read_json(job.run_dir / CONFIG_FILE, "settings")["device"]
        policy = str(job.run_dir)
    elif unit.algorithm == plan.CONSTANT:
        own = best_constant(unit.scenario, study)
        policy = f"{drivers.CONSTANT}{own['action']}"
    elif unit.algorithm == plan.HUMAN_MODEL:
        policy = str(job.human_model.parent)
    began_s = time.monotonic()
    drives = drive_tests(unit, policy, study.of(unit.scenario))
    own["tests_s"] = round(time.monotonic() - began_s)
    tests = [records.summarise_tests(unit.scenario, *each) for each in drives.items()]
    record["tests"] = {name: [row[name] for row in tests] for name in tests[0]}
    if Line(unit.algorithm, unit.setting) in plan.BOXED:
        record["drives"] = arrivals(drives, plan.BOXES[unit.scenario])
    record["units"] = {name: [value] for name, value in {
        "digest": study.digest(unit),
        "config": json.dumps(study.config(unit), separators=(",", ":")),
        "human_model": _human_model_id(job),
        **own,
        **_computed_on(device),
    }.items()}  # fmt: skip
    return record


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
            run.quit()

    run.train(after)
    return run.over


def _value(text: str) -> Any:
    """Return a number of a row of metrics with five digits, None for nan, or an outcome."""
    if text in ("", "nan"):
        return None
    try:
        return int(text) if text.lstrip("-").isdigit() else rounded(float(text))
    except ValueError:
        return text


def drive_tests(unit: Unit, policy: str, study: Study) -> dict[str, Columns]:
    """Return the test drives of a policy: condition -> column -> a value a drive."""
    tests, seeds = dict[str, Columns](), range(study.test_runs)
    for condition in unit.conditions:
        env = make_environment(unit.environment, condition)
        driver: Any = load_driver(policy, env)[0]
        if drivers.is_expert(policy):  # it has a memory, and drives its own environment only
            drives = drive_episodes(env, driver, seeds, condition)
        else:
            more = range(min(study.together, study.test_runs) - 1)
            envs = [env, *(make_environment(unit.environment, condition) for _ in more)]
            drives = drive_together(envs, driver.act_together, seeds, condition)
        tests[condition] = {name: [rounded(getattr(drive, name)) for drive in drives]
                            for name in DRIVES}  # fmt: skip
    return tests


def arrivals(tests: Mapping[str, Columns], quantities: Iterable[str]) -> Columns:
    """Return the columns of the table of drives: those that reach the goal."""
    reached = [
        (condition, drive)
        for condition, drives in tests.items()
        for drive, outcome in enumerate(drives["outcome"])
        if outcome == GOAL
    ]
    return {
        "condition": [condition for condition, _ in reached],
        "drive": [drive for _, drive in reached],
        **{name: [tests[condition][name][drive] for condition, drive in reached]
           for name in quantities},
    }  # fmt: skip


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
                results = drive_together(envs, drivers.constant_driver(action).act_together, seeds)
                success = np.mean([result.outcome == GOAL for result in results])
                worth[action] = float(success), float(np.mean([r.distance_m for r in results]))
        return max(worth, key=lambda action: (*worth[action], -abs(action)))

    coarse, reach = search(-1.0, 1.0), 2.0 / (study.search_points - 1)
    best = search(max(coarse - reach, -1.0), min(coarse + reach, 1.0))
    return {"action": best, "searched": len(worth), "search_success": worth[best][0]}


def _human_model_id(job: Job) -> str | None:
    """Return the first letters of the hash of the human model that guided; None: none did."""
    if not job.unit.needs_human:
        return None
    model = read_bytes(job.human_model, "human model")
    return sha256(model).hexdigest()[: plan.ID_LENGTH]


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
