"""``python -m trainer experiment``: compute what is missing of a study, then write its page.

A unit is one training with its test drives; the results of both become its record. Units are
computed in processes of this machine or on a Ray cluster. A killed unit resumes from its last
checkpoint, and ends with the same bits.
"""

import argparse
import json
import math
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, as_completed
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from bridge.report import ProgressBar
from edge_runtime.files import make_directory, write_json
from edge_runtime.util import UserError, read_bytes, read_json
from trainer import evaluation, util
from trainer import experiments as plan
from trainer.environments import make_environment
from trainer.experiments import STUDIES, TASKS, Study, Unit, records, report
from trainer.experiments.records import RECORD_FILE, Record, Store
from trainer.human import MODEL_FILE
from trainer.learner.kernel import load as load_kernel
from trainer.learner.networks import bfloat16_is_faster
from trainer.training.config import CONFIG_FILE, PRESETS, UNLIMITED_EPISODES, RunConfig
from trainer.training.metrics import METRICS_FILE, read_metrics
from trainer.training.run import TrainingRun
from trainer.util import check_device, deadline_s

FINISHED, STOPPED, FAILED = "finished", "stopped", "failed"
"""How a unit ends: with its record; with a checkpoint, for lack of time; with an error."""
RENAMED = {"total_steps": "end_step", "episode_return": "return", "interventions": "takeovers"}
"""Column of a run's metrics -> column of the table of episodes."""
TIMES = ["environment_s", "acting_s", "storing_s", "waiting_s"]
"""Columns of the metrics that add up to the time that a training took."""
TOGETHER = 50  # Test drives side by side
NICENESS = 5  # Keeps the machine usable for others


@dataclass(frozen=True)
class Job:
    unit: Unit
    store: Store
    stop_at_s: float = math.inf
    """Time (seconds since 1970) after which a training stops at its episode's end."""
    device: str = "cpu"  # Where its learner computes

    @property
    def run_dir(self) -> Path:
        return self.store.run_dir(self.unit)

    @property
    def human_model(self) -> Path:
        return self.store.humans / self.unit.scenario / MODEL_FILE


def run(arguments: argparse.Namespace) -> int:
    names, seeds = {*arguments.names}, arguments.seeds
    study = next((study for name, study in STUDIES.items() if name in names), plan.PAPER)
    alone = names - plan.EXPERIMENTS.keys()
    if alone and len(names) > 1 and names != {"status", study.name}:
        raise UserError(f"{', '.join(sorted(alone))}: no other name goes with it")
    store = _store(arguments, study)
    row, settings = arguments.algorithm, arguments.setting or plan.SETTINGS
    units = [unit for unit in store.study.units(seeds, arguments.scenario, names)
             if row in (None, unit.algorithm) and unit.setting in settings]  # fmt: skip
    if "status" in names:
        loaded = store.load(units, seeds)
        done = Counter(unit[:3] for unit in loaded.found)
        for line, count in Counter(unit[:3] for unit in units).items():
            print("{2:10} {1:24} {0:11}".format(*line), f"{done[line]} of {count} done")
        stale = f"{len(loaded.stale)} records of other settings"
        print(f"{len(loaded.found)} of {len(units)} units done; {stale}")
        return 0
    failed = 0 if "report" in names else compute_missing(arguments, store, units)
    loaded = store.load(store.study.units(seeds), seeds)
    if "report" in names or {*units} & {*loaded.found}:
        print(f"wrote {report.write_page(store, loaded)}")
    return 1 if failed else 0


def _store(arguments: argparse.Namespace, study: Study) -> Store:
    results = Path(arguments.results or util.kept(f"results/{study.name}"))
    runs = Path(arguments.runs or util.kept(f"runs/{study.name}"))
    if arguments.quick:
        study, results, runs = study.quick(), runs / "quick/results", runs / "quick"
    # Absolute: a node of a cluster works in another directory.
    return Store(study, results, runs.absolute(), Path(arguments.humans).absolute())


def compute_missing(arguments: argparse.Namespace, store: Store, wanted: Sequence[Unit]) -> int:
    """Compute the units that have no current record; return how many failed."""
    if not wanted:
        raise UserError(f"{', '.join(arguments.names)}: nothing to compute")
    check_device(arguments.device)
    stop_at_s = deadline_s(arguments.max_minutes, time.time)  # The clock of all processes
    done = {*store.load(wanted, arguments.seeds).found}
    jobs = [Job(unit, store, stop_at_s, arguments.device) for unit in wanted if unit not in done]
    ends: Counter[str] = Counter()
    with util.claimed(store.runs), ProgressBar("units", len(jobs)) as bar:
        start = run_on_ray(jobs, arguments.ray) if arguments.ray else run_here(jobs, arguments.jobs)
        for job, end in start:
            ends[end] += 1
            bar.advance({"last": str(job.unit)})
    counts = "".join(f", {count} {end}" for end, count in ends.items())
    print(f"{len(done)} of {len(wanted)} units were there already{counts}")
    if ends[FINISHED] < len(jobs):
        print("the same command goes on")
    return ends[FAILED]


def run_here(jobs: Sequence[Job], processes: int = 0) -> Iterator[tuple[Job, str]]:
    """Compute units in ``processes`` processes (0: one per core); yield how each unit ends."""
    with util.side_by_side(compute, jobs, processes, NICENESS) as work:
        for future in as_completed(work):
            if time.time() > work[future].stop_at_s:
                for each in work:  # A process would take seconds to start, only to stop.
                    each.cancel()
            yield work[future], _end(work[future], future.result)


def _end(job: Job, result: Callable[[], str]) -> str:
    """Return how a unit ended; print an error in one line, after a traceback unless UserError."""
    try:
        return result()
    except CancelledError:
        return STOPPED
    except Exception as error:
        cause = getattr(error, "cause", error)  # Ray wraps it.
        if not isinstance(cause, UserError):
            traceback.print_exception(error)
        text = f"failed: {job.unit}: {type(cause).__name__}: {cause}"
        print(" ".join(text.split()), file=sys.stderr, flush=True)
    return FAILED


def run_on_ray(jobs: Sequence[Job], address: str) -> Iterator[tuple[Job, str]]:
    """Compute units as Ray tasks of one processor each; yield how each ends.

    ``address`` is the cluster's, as ``ray.init`` takes it; ``local`` starts one on this machine.
    All nodes see the directories of the runs and of the human models under the same paths.

    Raises UserError: Ray is not installed, or nothing answers at the address.
    """
    try:
        import ray
    except ImportError:
        raise UserError("--ray needs Ray: python -m pip install '.[ray]'") from None
    import bridge
    import edge_runtime
    import trainer

    # The nodes need the libraries; our own code is sent to them.
    modules = {"py_modules": [edge_runtime, bridge, trainer]}
    try:
        ray.init(address=address, runtime_env=modules, log_to_driver=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise UserError(f"--ray {address}: no cluster answers: {error}") from error
    remote = ray.remote(num_cpus=1, max_retries=3)(compute)  # For nodes that die
    work = {remote.remote(job).future(): job for job in jobs}
    for future in as_completed(work):
        yield work[future], _end(work[future], future.result)


def compute(job: Job) -> str:
    """Compute a unit, resuming it if it was begun, and write its record; return how it ended.

    torch uses one thread: the last bits must not depend on the number of cores.
    """
    torch.set_num_threads(1)
    if time.time() > job.stop_at_s or (job.unit.trained and not _train(job)):
        return STOPPED
    make_directory(job.run_dir)
    write_json(job.run_dir / RECORD_FILE, make_record(job))
    # The actor is kept for export and later tests; the checkpoint is large.
    (job.run_dir / evaluation.CHECKPOINT_FILE).unlink(missing_ok=True)
    return FINISHED


def run_config(job: Job) -> RunConfig:
    values = job.store.study.config(job.unit)
    start, learner = PRESETS[values.pop("preset")], values.pop("learner")
    if job.unit.needs_human:
        values["human"] = str(job.human_model.parent)
    return replace(
        start,
        **{"confirmation_factor": 0, **values},
        episodes=UNLIMITED_EPISODES,
        checkpoint_every=job.store.study.checkpoint_every,
        threads=1,
        device=job.device,
        learner=replace(start.learner, **learner),
    )


def _train(job: Job) -> bool:
    """Train until the budget of steps is used or time is over; return whether it was used."""
    config, run_dir = run_config(job), job.run_dir
    rows = read_metrics(run_dir)
    over = rows and int(rows[-1]["total_steps"]) >= config.steps
    if over and (run_dir / evaluation.BEST_FILE).is_file():
        return True  # Trained before; the checkpoint may already be deleted.
    run = TrainingRun(config, run_dir, resume=(run_dir / evaluation.CHECKPOINT_FILE).is_file())
    run.train(deadline_s=time.monotonic() + job.stop_at_s - time.time())
    return run.over


def make_record(job: Job) -> Record:
    """Drive a unit's tests; return its record, the rows of each table."""
    unit, study = job.unit, job.store.study
    tables: dict[str, pd.DataFrame] = {}
    own: dict[str, Any] = {
        "digest": study.digest(unit),
        "config": json.dumps(study.config(unit), separators=(",", ":")),
    }
    device, policy = "cpu", unit.scripted_human
    if unit.trained:
        rows = pd.read_csv(job.run_dir / METRICS_FILE)
        tables["episodes"] = rows.rename(columns=RENAMED)[records.TABLES["episodes"]].map(_rounded)
        env = make_environment(TASKS[unit.scenario]["environment"])
        tested = evaluation.load_actor(job.run_dir, env)[1]["episode"]  # counted from 1
        own |= {
            "period_s": env.control_period_s,
            "updates": int(rows.updates.iloc[-1]),
            "tested_actor_at_step": int(rows.total_steps[tested - 1]),
            "training_s": round(rows[TIMES].sum(axis=None)),
        }
        # The run's device, not the job's: the unit may have been trained before.
        device = read_json(job.run_dir / CONFIG_FILE, "settings")["device"]
        policy = str(job.run_dir)
    elif unit.algorithm == plan.CONSTANT:
        own |= plan.BEST_CONSTANT[unit.scenario]
        policy = f"{evaluation.CONSTANT}{own['action']}"
    elif unit.algorithm == plan.HUMAN_MODEL:
        policy = str(job.human_model.parent)
    drives = drive_tests(unit, policy, study.of(unit.scenario).test_runs)
    tables["tests"] = records.summarise_tests(unit.scenario, drives)
    if unit.needs_human:
        own["human_model"] = sha256(read_bytes(job.human_model, "human model")).hexdigest()[:12]
    tables["units"] = pd.DataFrame([own | _computed_on(device)])
    return {name: records.columns_of(table) for name, table in tables.items()}


def _rounded(value: Any) -> Any:
    return float(f"{value:.5g}") if isinstance(value, float) else value


def drive_tests(unit: Unit, policy: str, count: int) -> pd.DataFrame:
    """Return the test drives of a policy, a row each, condition by condition."""
    environment, seeds = TASKS[unit.scenario]["environment"], range(count)
    tests = []
    for condition in unit.conditions:
        env = make_environment(environment, condition)
        driver: Any = evaluation.load_driver(policy, env)[0]
        if evaluation.is_expert(policy):  # An expert has a memory and drives one environment.
            drives = evaluation.drive_episodes(env, driver, seeds, condition)
        else:
            more = range(min(TOGETHER, count) - 1)
            envs = [env, *(make_environment(environment, condition) for _ in more)]
            drives = evaluation.drive_together(envs, driver.act_together, seeds, condition)
        tests += [(condition, *(_rounded(getattr(drive, name)) for name in records.DRIVEN))
                  for drive in drives]  # fmt: skip
    return pd.DataFrame(tests, columns=["condition", *records.DRIVEN])


def _computed_on(device: str) -> dict[str, Any]:
    """Return processor and versions: the same settings give other bits elsewhere."""
    return {
        "processor": util.processor_model(),
        "gpu": None if device == "cpu" else torch.cuda.get_device_name(),
        "bfloat16": bfloat16_is_faster(device),
        "compiled_kernel": load_kernel() is not None,
        "torch": torch.__version__,
        "source_revision": util.source_revision(),
    }
