"""One unit from its first step to its record, and many of them in a pool of processes.

Whatever is killed goes on from its last checkpoint, to the same bits.
"""

from __future__ import annotations

import math
import multiprocessing.connection
import os
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bridge.report import GOAL
from edge_runtime.files import make_directory, write_atomic
from edge_runtime.util import UserError
from trainer import seeds
from trainer.drivers import (
    BEST_FILE,
    CHECKPOINT_FILE,
    CONDITIONS,
    ConstantDriver,
    load_actor,
    load_driver,
    make_environment,
)
from trainer.drivers import CONSTANT as CONSTANT_DRIVER
from trainer.evaluate import die_with_parent, drive_together, interrupts_blocked
from trainer.experiments.plan import CONSTANT, Plan, Unit, deciding, run_config, testing
from trainer.experiments.store import (
    BUSY,
    FAILED,
    FINISHED,
    STOPPED,
    TEST_COLUMNS,
    TRAINING_COLUMNS,
    VALIDATION_COLUMNS,
    Store,
)
from trainer.learner.kernel import load as load_kernel
from trainer.learner.networks import multiplies_bfloat16
from trainer.training.metrics import EpisodeMetrics, read_metrics, totals
from trainer.training.run import TrainingRun
from trainer.util import ProgressBar, holder, processor_model, source_revision

PARTS = ("environment_s", "acting_s", "storing_s", "waiting_s")
"""Columns of the metrics that add up to the time that a training took."""
DIGITS = 5
PATIENCE_S = 1.0
"""How long a unit may be held before it counts as another process's work."""
NICENESS = 5
"""So that a machine on which somebody works stays usable."""
OnSteps = Callable[[int], object]
"""Told how many environment steps of the unit are done."""


@dataclass(frozen=True)
class Task:
    """A unit to be computed."""

    unit: Unit
    store: Store
    stop_at_s: float = math.inf
    """Seconds of the epoch after which work stops at its next checkpoint."""


def compute(task: Task, on_steps: OnSteps = lambda steps: None) -> str:
    """Compute a unit from where it stands into its record; how that ended."""
    unit, store = task.unit, task.store
    with store.lock(unit, PATIENCE_S) as free:
        if not free:
            return BUSY
        if store.record(unit):
            return FINISHED
        return store.keep(unit, make_record(task, store.run_dir(unit), on_steps))


def make_record(task: Task, run_dir: Path, on_steps: OnSteps) -> dict[str, Any] | None:
    """Train and test a unit; its record, or None where time ran out."""
    unit, store = task.unit, task.store
    if time.time() > task.stop_at_s:
        return None
    began_s = time.monotonic()
    record: dict[str, Any] = {
        "id": store.id(unit),
        **deciding(unit, store.plan, store.humans),
        "testing": testing(unit, store.plan),
    }
    seconds = {}
    if unit.trained:
        make_directory(run_dir)
        if not _train(task, run_dir, on_steps):
            return None
        rows = read_metrics(run_dir)
        record.update(_training(rows, run_dir))
        seconds["training_s"] = round(
            sum(float(row[name] or 0.0) for row in rows for name in PARTS)
        )
        policy = str(run_dir)
    elif unit.algorithm == CONSTANT:
        record["action"], record["success_of"] = best_constant(unit.scenario, store.plan)
        policy = f"{CONSTANT_DRIVER}{record['action']}"
    else:
        policy = str(store.humans / unit.scenario)
    tested_s = time.monotonic()
    record["tests"] = drive_tests(unit.scenario, policy, store.plan)
    if not unit.trained:
        seconds["search_s"] = round(tested_s - began_s)
    seconds["tests_s"] = round(time.monotonic() - tested_s)
    record["computed"] = {
        "processor": processor_model(),
        "bfloat16": multiplies_bfloat16("cpu"),
        "compiled_kernel": load_kernel("trunk") is not None,
        "torch": torch.__version__,
        "source_revision": source_revision(),
        **seconds,
    }
    return record


class _OutOfTimeError(Exception):
    """Ends training at a checkpoint."""


def _train(task: Task, run_dir: Path, on_steps: OnSteps) -> bool:
    """Train to the budget's end; whether it was reached.

    Time is looked at only where a checkpoint was just written, and not through the deadline of
    ``TrainingRun.train``: that one validates once more when it stops, as no unbroken run does.
    """
    config = run_config(task.unit, task.store.plan, task.store.humans)
    if _trained(run_dir, config.steps):
        return True
    run = TrainingRun(config, run_dir, resume=(run_dir / CHECKPOINT_FILE).is_file())

    def after(metrics: EpisodeMetrics) -> None:
        on_steps(run.steps)
        at_checkpoint = run.episode % config.checkpoint_every == 0
        if at_checkpoint and not run.over and time.time() > task.stop_at_s:
            raise _OutOfTimeError

    try:
        run.train(after)
    except _OutOfTimeError:
        return False
    return True


def _trained(run_dir: Path, steps: int) -> bool:
    """Whether training ended before; its checkpoint may be gone already."""
    rows = read_metrics(run_dir)
    if not rows or int(rows[-1]["total_steps"]) < steps:
        return False
    return rows[-1]["validation_success"] not in ("", "nan") and (run_dir / BEST_FILE).is_file()


def _training(rows: Sequence[dict[str, str]], run_dir: Path) -> dict[str, Any]:
    """What a record keeps of a training."""
    validated = [row for row in rows if row["validation_success"] not in ("", "nan")]
    tested = load_actor(run_dir)[1]["episode"]  # counted from 1: after so many episodes
    return {
        "training": _columns(rows, TRAINING_COLUMNS),
        "validation": _columns(validated, VALIDATION_COLUMNS),
        "totals": totals(rows),
        "tested_actor_at_step": int(rows[tested - 1]["total_steps"]),
    }


def _columns(rows: Sequence[dict[str, str]], names: dict[str, str]) -> dict[str, list[Any]]:
    return {ours: [_value(row[theirs]) for row in rows] for ours, theirs in names.items()}


def _value(text: str) -> Any:
    """A cell of the metrics as JSON has it: whole numbers whole, others with five digits."""
    try:
        return int(text) if text.lstrip("-").isdigit() else rounded(float(text))
    except ValueError:
        return text  # an outcome


def rounded(value: Any) -> Any:
    """A number with five digits; anything else as it is."""
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def drive_tests(scenario: str, policy: str, plan: Plan) -> dict[str, dict[str, list[Any]]]:
    """The test drives of a policy: condition -> column -> a value a drive."""
    tests = {}
    driver: Any = load_driver(policy, make_environment(scenario))[0]
    with one_thread():
        for condition in CONDITIONS:
            envs = [make_environment(scenario, condition) for _ in range(plan.together)]
            drives = drive_together(envs, driver.act_together, range(plan.test_runs), condition)
            tests[condition] = {
                name: [rounded(getattr(drive, name)) for drive in drives] for name in TEST_COLUMNS
            }
    return tests


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: the last bits must not depend on the machine's cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def best_constant(scenario: str, plan: Plan) -> tuple[float, dict[str, float]]:
    """The constant action that is best on validation drives, and each action's success.

    Searched on two grids: from -1 to 1, then a step to either side of the best one.
    """
    envs = [make_environment(scenario) for _ in range(plan.together)]
    drives = [seeds.episode_seed(0, seeds.VALIDATION, run) for run in range(plan.search_runs)]
    worth: dict[float, tuple[float, float]] = {}

    def search(grid: Iterable[float]) -> float:
        for action in (round(float(value), 3) for value in grid):
            if action not in worth:
                results = drive_together(envs, ConstantDriver(action).act_together, drives)
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

    Each failure is one line; none takes another unit with it.
    """
    ends: Counter[str] = Counter()
    waiting, working = deque(tasks), dict[Any, Worker]()
    with ProgressBar("steps", sum(map(_steps, tasks)) or 1) as bar:
        try:
            while waiting or working:
                while waiting and len(working) < jobs:
                    task = waiting.popleft()
                    if time.time() > task.stop_at_s:
                        ends[STOPPED] += 1
                    else:
                        worker = Worker(task)
                        working[worker.receiver] = worker
                for receiver in multiprocessing.connection.wait([*working]):
                    worker = working[receiver]
                    before, over = worker.steps, worker.hear()
                    if over:
                        del working[receiver]
                        ends[worker.end] += 1
                    figures = {
                        "units": f"{ends[FINISHED]}/{len(tasks)}",
                        "at": str(worker.task.unit),
                    }
                    bar.advance(figures, worker.steps - before)
        finally:
            for worker in working.values():
                worker.process.kill()
    return ends


def _steps(task: Task) -> int:
    """What a unit counts in the progress bar."""
    return task.store.plan.steps[task.unit.scenario] if task.unit.trained else 0


class Worker:
    """A process that computes one unit, and what it has told."""

    def __init__(self, task: Task) -> None:
        self.task, self.steps, self.end, self.why = task, 0, FAILED, ""
        context = multiprocessing.get_context("spawn")
        self.receiver, sender = context.Pipe(duplex=False)
        self.process = context.Process(target=_work, args=(task, sender), daemon=True)
        with interrupts_blocked():
            self.process.start()
        sender.close()  # so that the end of the process is the end of the pipe

    def hear(self) -> bool:
        """Take what it tells next; whether it has ended, which is then said."""
        try:
            told = self.receiver.recv()
        except (EOFError, OSError):
            self.process.join()
            self._say_end()
            return True
        if isinstance(told, int):
            self.steps = min(told, _steps(self.task))
        else:
            self.end, self.why = told
        return False

    def _say_end(self) -> None:
        unit = self.task.unit
        if self.end == FAILED:
            say(f"failed: {unit}: {self.why or f'its process died ({self.process.exitcode})'}")
        elif self.end == BUSY:
            say(f"left to {holder(self.task.store.lock_file(unit))}: {unit}")
        elif self.end == FINISHED:
            self.steps = _steps(self.task)


def say(line: str) -> None:
    """One line on stderr, beside the progress bar."""
    print(" ".join(line.split()), file=sys.stderr, flush=True)


def _work(task: Task, sender: Connection) -> None:
    """A process's life: it sends how many steps are done, then how it ended and why it failed."""
    os.nice(NICENESS)
    torch.set_num_threads(1)
    threading.Thread(target=die_with_parent, daemon=True).start()
    try:
        sender.send((compute(task, sender.send), ""))
    except UserError as error:
        sender.send((FAILED, str(error)))
    except BaseException as error:
        path = task.store.run_dir(task.unit) / "error.txt"
        write_atomic(path, traceback.format_exc().encode())
        sender.send((FAILED, f"{type(error).__name__}: {error} ({path})"))
