"""One unit from its first step to its record, and many of them in processes or on a Ray cluster.

The record of a unit, one JSON object, is a line of ``<scenario>.jsonl`` in ``results/paper``
(``guidance``: of that table). Its checkpoint and its actor lie in a directory of its own under
``runs``, which is not committed. Whatever is killed goes on from its last checkpoint, to the same
bits.
"""

import json
import math
import multiprocessing
import os
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bridge.outcomes import GOAL
from bridge.progress import ProgressBar
from edge_runtime.files import make_directory, write_atomic
from edge_runtime.util import UserError, read_bytes, read_json
from trainer import drivers, util
from trainer.drivers import BEST_FILE, CHECKPOINT_FILE, load_actor, load_driver
from trainer.environments import make_environment
from trainer.evaluation import drive_episodes, drive_together
from trainer.experiments import plan
from trainer.experiments.plan import Plan, Unit
from trainer.human.config import MODEL_FILE
from trainer.learner.kernel import load as load_kernel
from trainer.learner.networks import bfloat16_is_faster
from trainer.training.config import CONFIG_FILE
from trainer.training.metrics import (
    METRICS_FILE,
    EpisodeMetrics,
    read_metrics,
    totals,
    was_validated,
)
from trainer.training.run import TrainingRun

FINISHED, STOPPED, BUSY, FAILED = "finished", "stopped", "busy", "failed"
"""How work on a unit ends: with its record; with a checkpoint, for lack of time; at once, since
another process has it; with an error."""
WRITING_PATIENCE_S = 60.0
"""Longest wait for another process to finish writing the records."""
TRAINING_COLUMNS = {
    "end_step": "total_steps",
    "return": "episode_return",
    "distance_m": "distance_m",
    "outcome": "outcome",
    "human_steps": "human_steps",
    "takeovers": "interventions",
}
"""Column of a record -> column of a run's metrics, a value an episode."""
VALIDATION_COLUMNS = {
    "at_step": "total_steps",
    "success": "validation_success",
    "distance_m": "validation_distance_m",
    "reward": "validation_reward",
}
"""The same, a value a validation."""
TEST_COLUMNS = (
    "outcome",
    "distance_m",
    "time_s",
    "reward",
    "lateral_acceleration_mps2",
    "longitudinal_acceleration_mps2",
)
"""What is kept of each test drive; the seeds are 0, 1, ..."""
TIMES = ("environment_s", "acting_s", "storing_s", "waiting_s")
"""Columns of the metrics that add up to the time that a training took."""
DIGITS = 5
PATIENCE_S = 1.0  # How long a unit may be held before it counts as another process's work
EXITS = dict(enumerate((FINISHED, FAILED, STOPPED, BUSY)))
"""Exit status of a unit's process -> how the unit ended."""


@dataclass(frozen=True)
class Store:
    """Where the units of a plan are."""

    plan: Plan  # What they have in common
    results: Path  # Directory of the records, to be committed
    runs: Path  # Directory of checkpoints and actors, which is not
    humans: Path  # Directory with a human model for each scenario

    def id(self, unit: Unit) -> str:
        """The id of the unit's record: a short hash of all that decides it."""
        decides = plan.deciding(unit, self.plan, self.humans)
        return plan.digest({**decides, "testing": plan.testing(unit, self.plan)})

    def records_file(self, scenario: str) -> Path:
        """The records of a scenario, a line each."""
        return self.results / f"{scenario}.jsonl"

    def run_dir(self, unit: Unit) -> Path:
        """Where the unit is trained, and its actor stays; tests that change do not touch it."""
        name = plan.digest(plan.deciding(unit, self.plan, self.humans))
        return self.runs / f"{'-'.join(map(str, unit))}-{name}"

    def records(self, scenario: str) -> dict[Unit, dict[str, Any]]:
        """All records of a scenario, current or not; none where there is no file.

        Raises UserError: a line is not what ``put`` writes.
        """
        path, found = self.records_file(scenario), {}
        text = read_bytes(path, "records").decode(errors="replace") if path.exists() else ""
        for number, line in enumerate(text.splitlines(), start=1):
            try:
                record = json.loads(line)
                if not isinstance(record["id"], str) or not isinstance(record["tests"], dict):
                    raise TypeError("no record")
                found[Unit(**record["unit"])] = record
            except (ValueError, KeyError, TypeError) as error:
                raise UserError(f"{path}, line {number}, is no record of a unit: {error}") from None
        return found

    def find(self, units: Iterable[Unit]) -> tuple[dict[Unit, dict[str, Any]], list[Unit]]:
        """The records of these units, and those units whose record is of other settings."""
        units = list(units)
        records = {where: self.records(where) for where in {unit.scenario for unit in units}}
        found, stale = {}, []
        for unit in units:
            record = records[unit.scenario].get(unit)
            if record is None:
                continue
            if not plan.is_possible(unit, self.humans) or record["id"] != self.id(unit):
                stale.append(unit)
            else:
                found[unit] = record
        return found, stale

    def put(self, unit: Unit, record: dict[str, Any]) -> None:
        """Add a record, in place of an older one of the unit: whole or not at all."""
        path = self.records_file(unit.scenario)
        with util.held(self.results, WRITING_PATIENCE_S) as mine:
            if not mine:
                raise UserError(f"{self.results} is held by another process")
            records = {**self.records(unit.scenario), unit: record}
            lines = [
                json.dumps(records[each], separators=(",", ":"), allow_nan=False) + "\n"
                for each in sorted(records)
            ]
            write_atomic(path, "".join(lines).encode())

    def keep(self, unit: Unit, record: dict[str, Any] | None) -> str:
        """Put what work on a unit came to, and tidy up; how it ended."""
        if record is None:
            return STOPPED
        self.put(unit, record)
        # The actor stays, for export and for tests to come; what learning needs is large.
        (self.run_dir(unit) / CHECKPOINT_FILE).unlink(missing_ok=True)
        return FINISHED

    def status_lines(self, name: str, seeds: int, scenario: str | None) -> Iterator[str]:
        """A line for each algorithm and setting of an experiment: how many units are done."""
        units = plan.units_of([name], seeds, scenario)
        found, stale = self.find(units)
        done = Counter(unit[:3] for unit in found)
        for line, count in Counter(unit[:3] for unit in units).items():
            scenario, algorithm, setting = line
            yield f"{setting:10} {algorithm:24} {scenario:11} {done[line]} of {count} done"
        yield f"{len(found)} of {len(units)} units done; {len(stale)} records of other settings"


@dataclass(frozen=True)
class Task:
    """A unit to be computed."""

    unit: Unit
    store: Store
    stop_at_s: float = math.inf
    """Seconds of the epoch after which work stops with the next episode."""
    device: str = "cpu"  # Where its learner computes


def compute(task: Task) -> str:
    """Compute a unit from where it stands into its record; how that ended."""
    unit, store = task.unit, task.store
    with util.held(store.run_dir(unit), PATIENCE_S) as free:
        if not free:
            say(f"left to another process: {unit}")
            return BUSY
        if unit in store.find([unit])[0]:
            return FINISHED
        return store.keep(unit, make_record(task, store.run_dir(unit)))


def make_record(task: Task, run_dir: Path) -> dict[str, Any] | None:
    """Train and test a unit; its record, or None where time ran out.

    torch works on one thread: the last bits must not depend on the machine's cores.
    """
    unit, store = task.unit, task.store
    if time.time() > task.stop_at_s:
        return None
    torch.set_num_threads(1)
    began_s = time.monotonic()
    record: dict[str, Any] = {
        "id": store.id(unit),
        **plan.deciding(unit, store.plan, store.humans),
        "testing": plan.testing(unit, store.plan),
    }
    seconds, device = {}, "cpu"
    if unit.trained:
        if not _train(task, run_dir):
            return None
        rows = read_metrics(run_dir)
        validated = [row for row in rows if was_validated(row)]
        env = make_environment(unit.environment)
        tested = load_actor(run_dir, env)[1]["episode"]  # counted from 1: after so many episodes
        record["training"] = _columns(rows, TRAINING_COLUMNS)
        record["validation"] = _columns(validated, VALIDATION_COLUMNS)
        record["period_s"] = env.control_period_s
        record["totals"] = totals(rows, record["period_s"], tested)
        record["tested_actor_at_step"] = int(rows[tested - 1]["total_steps"])
        seconds["training_s"] = round(sum(float(row[key] or 0.0) for row in rows for key in TIMES))
        # Not the task's: it may have been trained before.
        device = read_json(run_dir / CONFIG_FILE, "settings")["device"]
        policy = str(run_dir)
    elif unit.algorithm == plan.CONSTANT:
        record["action"], record["success_of"] = best_constant(unit.scenario, store.plan)
        policy = f"{drivers.CONSTANT}{record['action']}"
    elif unit.algorithm == plan.EXPERT:
        policy = unit.scripted_human
    else:
        policy = str(store.humans / unit.scenario)
    tested_s = time.monotonic()
    record["tests"] = drive_tests(unit, policy, store.plan.of(unit.scenario))
    if not unit.trained:
        seconds["search_s"] = round(tested_s - began_s)
    seconds["tests_s"] = round(time.monotonic() - tested_s)
    record["computed"] = {
        "processor": util.processor_model(),
        "gpu": _gpu() if device == "cuda" else None,
        "bfloat16": bfloat16_is_faster(device),
        "compiled_kernel": load_kernel() is not None,
        "torch": torch.__version__,
        "source_revision": util.source_revision(),
        **seconds,
    }
    return record


def _gpu() -> str:
    """The GPU's name."""
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "of another machine"


def _train(task: Task, run_dir: Path) -> bool:
    """Train to the budget's end; whether it was reached.

    It quits when time is out, and has no deadline in ``TrainingRun.train``: that one validates once
    more when it stops, as no unbroken run does.
    """
    config = replace(
        plan.run_config(task.unit, task.store.plan, task.store.humans), device=task.device
    )
    rows = read_metrics(run_dir)
    over = rows and int(rows[-1]["total_steps"]) >= config.steps
    validated = over and was_validated(rows[-1])
    if validated and (run_dir / BEST_FILE).is_file():
        return True  # trained before; the checkpoint may be gone already
    run = TrainingRun(config, run_dir, resume=(run_dir / CHECKPOINT_FILE).is_file())

    def after(metrics: EpisodeMetrics) -> None:
        if time.time() > task.stop_at_s:
            run.quit()

    run.train(after)
    return run.over


def _columns(rows: Sequence[dict[str, str]], names: dict[str, str]) -> dict[str, list[Any]]:
    def value(text: str) -> Any:
        try:
            return int(text) if text.lstrip("-").isdigit() else rounded(float(text))
        except ValueError:
            return text  # an outcome

    return {ours: [value(row[theirs]) for row in rows] for ours, theirs in names.items()}


def rounded(value: Any) -> Any:
    """A number with five digits; anything else as it is."""
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def drive_tests(unit: Unit, policy: str, plan: Plan) -> dict[str, dict[str, list[Any]]]:
    """The test drives of a policy: condition -> column -> a value a drive."""
    tests, seeds = {}, range(plan.test_runs)
    for condition in unit.conditions:
        env = make_environment(unit.environment, condition)
        driver: Any = load_driver(policy, env)[0]
        if drivers.is_expert(policy):  # it has a memory, and drives its own environment only
            drives = drive_episodes(env, driver, seeds, condition)
        else:
            more = range(min(plan.together, plan.test_runs) - 1)
            envs = [env, *(make_environment(unit.environment, condition) for _ in more)]
            drives = drive_together(envs, driver.act_together, seeds, condition)
        tests[condition] = {
            name: [rounded(getattr(drive, name)) for drive in drives] for name in TEST_COLUMNS
        }
    return tests


def best_constant(scenario: str, plan: Plan) -> tuple[float, dict[str, float]]:
    """The constant action that is best on validation drives, and each action's success.

    Searched on two grids: from -1 to 1, then a step to either side of the best one.
    """
    envs = [make_environment(scenario) for _ in range(plan.together)]
    drives = [util.episode_seed(0, util.Purpose.VALIDATION, run) for run in range(plan.search_runs)]
    worth: dict[float, tuple[float, float]] = {}

    def search(grid: Iterable[float]) -> float:
        for action in (round(float(value), 3) for value in grid):
            if action not in worth:
                results = drive_together(envs, drivers.constant_driver(action).act_together, drives)
                success = np.mean([result.outcome == GOAL for result in results])
                worth[action] = float(success), float(np.mean([r.distance_m for r in results]))
        return max(worth, key=lambda action: (*worth[action], -abs(action)))

    coarse = search(np.linspace(-1.0, 1.0, plan.search_points))
    reach = 2.0 / (plan.search_points - 1)
    low, high = max(coarse - reach, -1.0), min(coarse + reach, 1.0)
    best = search(np.linspace(low, high, plan.search_points))
    return best, {f"{action:g}": worth[action][0] for action in sorted(worth)}


def run_units(tasks: Sequence[Task], jobs: int) -> Counter[str]:
    """Compute units in so many processes at a time; how many ended in which way.

    Each failure is one line; none takes another unit with it, as one in an executor's pool would.
    """
    context = multiprocessing.get_context("spawn")
    ends: Counter[str] = Counter()
    waiting, working = deque(tasks), dict[Any, tuple[Any, Task]]()
    with ProgressBar("units", len(tasks)) as bar:
        try:
            while waiting or working:
                while waiting and len(working) < jobs:
                    task = waiting.popleft()
                    if time.time() > task.stop_at_s:  # a process takes seconds to find that out
                        ends[STOPPED] += 1
                        continue
                    process = context.Process(target=_work, args=(task,), daemon=True)
                    with util.interrupts_blocked():
                        process.start()
                    working[process.sentinel] = process, task
                for sentinel in wait([*working]) if working else ():
                    process, task = working.pop(sentinel)
                    process.join()
                    end = EXITS.get(process.exitcode, FAILED)
                    if process.exitcode not in EXITS:
                        say(f"failed: {task.unit}: its process died ({process.exitcode})")
                    ends[end] += 1
                    bar.advance({"last": str(task.unit)})
        finally:
            for process, _ in working.values():
                process.kill()
    return ends


def say(line: str) -> None:
    """One line on stderr, beside the progress bar."""
    print(" ".join(line.split()), file=sys.stderr, flush=True)


def _work(task: Task) -> None:
    """A process's life: its exit status tells how the unit ended."""
    os.nice(5)  # a machine on which somebody works stays usable
    threading.Thread(target=util.die_with_parent, daemon=True).start()
    end, why = FAILED, ""
    try:
        end = compute(task)
    except UserError as error:
        why = str(error)
    except BaseException as error:
        path = task.store.run_dir(task.unit) / "error.txt"
        write_atomic(path, traceback.format_exc().encode())
        why = f"{type(error).__name__}: {error} ({path})"
    if end == FAILED:
        say(f"failed: {task.unit}: {why}")
    sys.exit(list(EXITS.values()).index(end))


WORKING_FILES = (CHECKPOINT_FILE, BEST_FILE, METRICS_FILE, CONFIG_FILE)  # What a unit goes on from
Files = dict[str, bytes]
Parcel = tuple[Task, Files, Files]
"""A task on its way to a node: with its human model, and with what it goes on from."""


def pack(task: Task) -> Parcel:
    """A task with all that a node needs for it."""
    human = task.store.humans / task.unit.scenario
    return task, read(human, [MODEL_FILE]), read(task.store.run_dir(task.unit), WORKING_FILES)


def compute_parcel(parcel: Parcel) -> tuple[dict[str, Any] | None, Files]:
    """Compute a unit on a node: its record, None where time ran out, and its working files."""
    task, human, working = parcel
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        store = replace(task.store, results=root, runs=root, humans=root / "humans")
        write(store.humans / task.unit.scenario, human)
        run_dir = store.run_dir(task.unit)
        write(run_dir, working)
        record = make_record(replace(task, store=store), run_dir)
        return record, read(run_dir, WORKING_FILES)


def keep(task: Task, record: dict[str, Any] | None, working: Files) -> str:
    """Keep what a node made; how the unit ended."""
    write(task.store.run_dir(task.unit), working)
    return task.store.keep(task.unit, record)


def run_on_ray(tasks: Sequence[Task], address: str) -> Counter[str]:
    """Compute units as Ray tasks of one processor each; how many ended in which way.

    ``address`` is the cluster's, as ``ray.init`` takes it; ``local`` starts one on this machine.

    Raises UserError: Ray is not installed, or nothing answers at the address.
    """
    ray = _connected(address)
    remote = ray.remote(num_cpus=1, max_retries=3)(compute_parcel)  # for nodes that die
    ends: Counter[str] = Counter()
    with ExitStack() as locks:
        waiting = {}
        for task in tasks:
            if not locks.enter_context(util.held(task.store.run_dir(task.unit), PATIENCE_S)):
                ends[BUSY] += 1
            elif task.unit in task.store.find([task.unit])[0]:  # made elsewhere in the meantime
                ends[FINISHED] += 1
            else:
                waiting[remote.remote(pack(task))] = task
        while waiting:
            (ready, *_), _ = ray.wait(list(waiting))
            task = waiting.pop(ready)
            try:
                end = keep(task, *ray.get(ready))
            except ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None) or error
                last = str(cause).strip().splitlines()[-1:]  # a MemoryError says nothing
                end = FAILED
                say(": ".join((end, str(task.unit), type(cause).__name__, *last)))
            ends[end] += 1
            say(f"{task.unit}: {end}, {ends.total()} of {len(tasks)}")
    return ends


def _connected(address: str) -> Any:
    """The library, with a cluster behind it."""
    try:
        import ray
    except ImportError:
        raise UserError("--ray needs Ray: python -m pip install '.[ray]'") from None
    if not ray.is_initialized():
        import bridge
        import edge_runtime
        import trainer

        # Nodes need the libraries; our own code is sent to them.
        modules = {"py_modules": [edge_runtime, bridge, trainer]}
        try:
            ray.init(address=address, runtime_env=modules, log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UserError(f"--ray {address}: no cluster answers: {error}") from error
    return ray


def read(directory: Path, names: Sequence[str]) -> Files:
    """Those of the files that are there."""
    paths = [directory / name for name in names]
    return {path.name: path.read_bytes() for path in paths if path.is_file()}


def write(directory: Path, files: Files) -> None:
    """Write the files, each whole or not at all."""
    make_directory(directory)
    for name, data in files.items():
        write_atomic(directory / name, data)
