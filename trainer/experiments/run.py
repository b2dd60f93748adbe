"""One unit from its first step to its record, and many of them in a pool of processes.

A unit is trained in a directory of its own under ``runs``, which is not committed and keeps the
actor. Its record, one JSON object, is a line of ``results/paper/<scenario>.jsonl``. Whatever is
killed goes on from its last checkpoint, to the same bits.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bridge.report import GOAL, EpisodeResult
from edge_runtime.files import make_directory, write_atomic
from edge_runtime.util import UserError, read_bytes
from trainer import seeds
from trainer.drivers import (
    BEST_FILE,
    CHECKPOINT_FILE,
    CONDITIONS,
    NetworkDriver,
    load_actor,
    load_driver,
    make_environment,
)
from trainer.evaluate import ActTogether, die_with_parent, drive_together, interrupts_blocked
from trainer.experiments.plan import (
    CONSTANT,
    DEFAULT_SEEDS,
    SCENARIOS,
    Plan,
    Unit,
    deciding,
    obstacle,
    run_config,
    testing,
    training_id,
    unit_id,
    units_of,
)
from trainer.learner.kernel import load as load_kernel
from trainer.learner.networks import multiplies_bfloat16
from trainer.training.metrics import METRICS_FILE, EpisodeMetrics, read_metrics, totals
from trainer.training.run import TrainingRun
from trainer.util import ProgressBar, held, holder, processor_model, source_revision

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
DIGITS = 5
FINISHED, STOPPED, BUSY, FAILED = "finished", "stopped", "busy", "failed"
"""How work on a unit ends: with its record; at a checkpoint, for lack of time; at once, since
another process has it; with an error."""
DONE, STALE, RUNNING, BEGUN, MISSING, IMPOSSIBLE = (
    "done",
    "of other settings",
    "running",
    "begun",
    "missing",
    "without its human",
)
"""What a unit can be."""
PATIENCE_S = 1.0
"""How long a unit may be held before it counts as another process's work."""
WRITING_PATIENCE_S = 60.0
"""How long one waits for a file of records: whoever holds it writes a megabyte."""
NICENESS = 5
"""So that a machine on which somebody works stays usable."""
OnSteps = Callable[[int], None]
"""Told how many environment steps of the unit are done."""


@dataclass(frozen=True)
class Store:
    """Where the units of a plan are.

    Args:
        plan: what they have in common.
        results: directory of the records, to be committed.
        runs: directory of checkpoints and actors, which is not.
        humans: directory with a human model for each scenario.
    """

    plan: Plan
    results: Path
    runs: Path
    humans: Path

    def id(self, unit: Unit) -> str:
        """Of the unit's record."""
        return unit_id(unit, self.plan, self.humans)

    def records_file(self, scenario: str) -> Path:
        """The records of a scenario, a line each."""
        return self.results / f"{scenario}.jsonl"

    def run_dir(self, unit: Unit) -> Path:
        """Where the unit is trained; its actor stays there."""
        return self.runs / f"{'-'.join(map(str, unit))}-{training_id(unit, self.plan, self.humans)}"

    @contextmanager
    def lock(self, unit: Unit, patience_s: float = 0.0) -> Iterator[bool]:
        """Hold a unit against other processes; gives whether that was possible."""
        path = self.lock_file(unit)
        make_directory(path.parent)
        with held(path, patience_s) as mine:
            yield mine

    def lock_file(self, unit: Unit) -> Path:
        """Beside the unit's directory."""
        run_dir = self.run_dir(unit)
        return run_dir.with_name(f"{run_dir.name}.lock")

    def records(self, scenario: str) -> dict[Unit, dict[str, Any]]:
        """All records of a scenario, current or not."""
        return read_records(self.records_file(scenario))

    def record(self, unit: Unit) -> dict[str, Any] | None:
        """A unit's record, where there is one and it is of the same settings."""
        record = self.records(unit.scenario).get(unit)
        return record if record and record["id"] == self.id(unit) else None

    def put(self, unit: Unit, record: dict[str, Any]) -> None:
        """Add a record, in place of an older one of the unit: whole or not at all."""
        path = self.records_file(unit.scenario)
        make_directory(path.parent)
        with held(path.with_name(f".{path.name}.lock"), WRITING_PATIENCE_S) as mine:
            if not mine:
                raise UserError(f"{path} is held by another process")
            records = {**read_records(path), unit: record}
            lines = [_line(records[u]) for u in sorted(records)]
            write_atomic(path, "".join(f"{line}\n" for line in lines).encode())

    def states(self, units: Sequence[Unit]) -> dict[Unit, str]:
        """Of each unit one of done, of other settings, running, begun, missing, ..."""
        records = {scenario: self.records(scenario) for scenario in SCENARIOS}
        return {unit: self._state(unit, records[unit.scenario].get(unit)) for unit in units}

    def _state(self, unit: Unit, record: dict[str, Any] | None) -> str:
        if obstacle(unit, self.humans):
            return IMPOSSIBLE
        if record and record["id"] == self.id(unit):
            return DONE
        if self.lock_file(unit).exists():
            with self.lock(unit) as free:
                if not free:
                    return RUNNING
        if (self.run_dir(unit) / METRICS_FILE).exists():
            return BEGUN
        return STALE if record else MISSING


def _line(record: dict[str, Any]) -> str:
    return json.dumps(record, separators=(",", ":"), allow_nan=False)


def read_records(path: Path) -> dict[Unit, dict[str, Any]]:
    """The records in a file; none where there is no file.

    Raises:
        UserError: a line is not what ``Store.put`` writes.
    """
    if not path.exists():
        return {}
    lines = read_bytes(path, "records").decode(errors="replace").splitlines()
    return dict(_parsed(path, number, line) for number, line in enumerate(lines, start=1))


def _parsed(path: Path, number: int, line: str) -> tuple[Unit, dict[str, Any]]:
    try:
        record = json.loads(line)
        if not isinstance(record["id"], str) or not isinstance(record["tests"], dict):
            raise TypeError("no record")
        return Unit(**record["unit"]), record
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}, line {number}, is no record of a unit: {error}") from None


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
        run_dir = store.run_dir(unit)
        record = make_record(task, run_dir, on_steps)
        if record is None:
            return STOPPED
        store.put(unit, record)
        # The actor stays, for export and for tests to come; what learning needs is large.
        (run_dir / CHECKPOINT_FILE).unlink(missing_ok=True)
        return FINISHED


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
        seconds["training_s"] = round(sum(map(_seconds, rows)))
        actor, _ = load_actor(run_dir)
        act: ActTogether = NetworkDriver(actor).act_together
    elif unit.algorithm == CONSTANT:
        record["action"], record["success_of"] = best_constant(unit.scenario, store.plan)
        act = constantly(record["action"])
    else:
        env = make_environment(unit.scenario)
        driver, _ = load_driver(str(store.humans / unit.scenario), env)
        assert isinstance(driver, NetworkDriver)
        act = driver.act_together
    tested_s = time.monotonic()
    record["tests"] = drive_tests(unit.scenario, act, store.plan)
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


def _seconds(row: dict[str, str]) -> float:
    parts = ("environment_s", "acting_s", "storing_s", "waiting_s")
    return sum(float(row.get(name) or 0.0) for name in parts)


def drive_tests(scenario: str, act: ActTogether, plan: Plan) -> dict[str, dict[str, list[Any]]]:
    """The test drives of a policy: condition -> column -> a value a drive."""
    with one_thread():
        return {name: _test_columns(_drive(scenario, act, plan, name)) for name in CONDITIONS}


def _drive(scenario: str, act: ActTogether, plan: Plan, condition: str) -> list[EpisodeResult]:
    envs = [make_environment(scenario, condition) for _ in range(plan.together)]
    return drive_together(envs, act, range(plan.test_runs), condition)


def _test_columns(results: Sequence[EpisodeResult]) -> dict[str, list[Any]]:
    return {name: [rounded(getattr(result, name)) for result in results] for name in TEST_COLUMNS}


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: the last bits must not depend on the machine's cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def constantly(action: float) -> ActTogether:
    """A driver that always does the same."""
    return lambda observations: np.full((len(observations), 1), action, np.float32)


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
                results = drive_together(envs, constantly(action), drives)
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
    stopping = threading.Event()
    with ProgressBar("steps", sum(map(_steps, tasks)) or 1) as bar:

        def advance(task: Task, steps: int) -> None:
            bar.advance({"units": f"{ends[FINISHED]}/{len(tasks)}", "at": str(task.unit)}, steps)

        with ThreadPoolExecutor(jobs) as pool:
            waiting = {pool.submit(_in_process, task, advance, stopping) for task in tasks}
            try:
                while waiting:
                    done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    ends.update(future.result() for future in done)
            finally:
                stopping.set()
                pool.shutdown(wait=False, cancel_futures=True)
                for process in multiprocessing.active_children():
                    process.kill()
    return ends


def _steps(task: Task) -> int:
    """What a unit counts in the progress bar."""
    return task.store.plan.steps[task.unit.scenario] if task.unit.trained else 0


def _in_process(task: Task, advance: Callable[[Task, int], None], stopping: threading.Event) -> str:
    """A unit in a process of its own, watched from a thread; how it ended."""
    if time.time() > task.stop_at_s or stopping.is_set():
        return STOPPED
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(task, sender), daemon=True)
    with _STARTING, interrupts_blocked():
        process.start()
    sender.close()  # so that the end of the process is the end of the pipe
    steps, end, why = 0, FAILED, ""
    while True:
        try:
            kind, value, why = receiver.recv()
        except (EOFError, OSError):
            break
        if kind == STEPS:
            value = min(value, _steps(task))
            advance(task, value - steps)
            steps = value
        else:
            end = value
    process.join()
    if stopping.is_set():
        return STOPPED
    if end == FAILED:
        say(f"failed: {task.unit}: {why or f'its process died ({process.exitcode})'}")
    elif end == BUSY:
        say(f"left to {holder(task.store.lock_file(task.unit))}: {task.unit}")
    elif end == FINISHED:
        advance(task, _steps(task) - steps)
    return end


STEPS, END = "steps", "end"
"""What a process tells: how far it is; how it ended, and why it failed."""
_STARTING = threading.Lock()
"""``multiprocessing`` keeps its books for one thread that starts processes."""


def say(line: str) -> None:
    """One line on stderr, beside the progress bar."""
    print(" ".join(line.split()), file=sys.stderr, flush=True)


def _work(task: Task, sender: Connection) -> None:
    """A process's life."""
    os.nice(NICENESS)
    torch.set_num_threads(1)
    threading.Thread(target=die_with_parent, daemon=True).start()
    try:
        end = compute(task, lambda steps: sender.send((STEPS, steps, "")))
        sender.send((END, end, ""))
    except UserError as error:
        sender.send((END, FAILED, str(error)))
    except BaseException as error:
        path = task.store.run_dir(task.unit) / "error.txt"
        make_directory(path.parent)
        path.write_text(traceback.format_exc())
        sender.send((END, FAILED, f"{type(error).__name__}: {error} ({path})"))


def status_lines(store: Store, seeds_wanted: int = DEFAULT_SEEDS) -> list[str]:
    """A line for each algorithm and setting: how many of its units are in which state."""
    units = units_of(["all"], seeds_wanted)
    states = store.states(units)
    groups: dict[tuple[str, str, str], Counter[str]] = {}
    for unit in units:
        groups.setdefault((unit.setting, unit.algorithm, unit.scenario), Counter())[
            states[unit]
        ] += 1
    lines = []
    for (setting, algorithm, scenario), counts in groups.items():
        said = ", ".join(f"{count} {state}" for state, count in counts.items())
        lines.append(f"{setting:10} {algorithm:24} {scenario:11} {said}")
    total = Counter(states.values())
    lines.append(f"{total[DONE]} of {len(units)} units done")
    return lines
