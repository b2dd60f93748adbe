"""The same units on a Ray cluster: no node needs a disk that it shares with another.

A task carries what is there of a unit (its checkpoint, its human model) and brings back what it
made; all of it is stored by the process that asked.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from edge_runtime.errors import UserError
from edge_runtime.files import make_directory, read_bytes, write_atomic
from trainer.drivers import BEST_FILE, CHECKPOINT_FILE
from trainer.experiments.runner import FAILED, Tally, episodes_of, say
from trainer.experiments.store import Store
from trainer.experiments.units import Unit, human_file
from trainer.experiments.work import BUSY, FINISHED, PATIENCE_S, STOPPED, Task, advance
from trainer.progress import ProgressBar
from trainer.training.metrics import METRICS_FILE

WORKING_FILES = (CHECKPOINT_FILE, BEST_FILE, METRICS_FILE)
"""What a unit goes on from."""
GPU_SHARE = 0.25
"""Of a GPU, for each unit on ``cuda``: these networks are small."""
RETRIES = 3
"""How often a unit is begun again when the node under it dies."""


@dataclass(frozen=True)
class Parcel:
    """A task on its way to a node."""

    task: Task
    human: bytes | None
    working: dict[str, bytes]


@dataclass(frozen=True)
class Answer:
    """What comes back."""

    result: dict[str, bytes] | None
    """The result's files; None where time ran out."""
    working: dict[str, bytes]


def run_on_ray(tasks: Sequence[Task], address: str) -> Tally:
    """Compute units as Ray tasks of one processor each.

    Args:
        tasks: what to compute.
        address: of the cluster, as ``ray.init`` takes it; ``local`` starts one on this machine.

    Raises:
        UserError: Ray is not installed, or nothing answers at the address.
    """
    ray = import_ray()
    own_cluster = not ray.is_initialized()
    if own_cluster:
        _connect(ray, address)
    tally = Tally(len(tasks))
    bar = ProgressBar("experiments on Ray", sum(map(episodes_of, tasks)) or 1)
    try:
        with ExitStack() as locks, bar:
            waiting = {}
            for task in tasks:
                if not locks.enter_context(task.store.lock(task.unit, PATIENCE_S)):
                    say(f"left to {task.store.holder(task.unit)}: {task.unit}")
                    tally.add(BUSY)
                    continue
                if task.store.done(task.unit):  # elsewhere, since it was asked for
                    tally.add(FINISHED)
                    continue
                waiting[_submit(ray, task)] = task
            while waiting:
                (ready, *_), _ = ray.wait(list(waiting))
                task = waiting.pop(ready)
                tally.add(_receive(ray, task, ready))
                count = tally.count(FINISHED)
                bar.advance({"units": f"{count}/{tally.total}"}, episodes_of(task))
    finally:
        if own_cluster:
            ray.shutdown()
    return tally


def pack(task: Task) -> Parcel:
    """A task with all that a node needs for it."""
    run_dir, human = (
        task.store.run_dir(task.unit),
        human_file(task.unit.scenario, task.store.humans),
    )
    return Parcel(
        task,
        read_bytes(human, "human model") if task.unit.needs_human else None,
        _files(run_dir),
    )


def compute_parcel(parcel: Parcel) -> Answer:
    """Unpack, compute and pack again; runs on a node."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as directory:
        root = Path(directory)
        unit = parcel.task.unit
        store = replace(parcel.task.store, results=root, runs=root, humans=root / "humans")
        if parcel.human is not None:
            make_directory(human_file(unit.scenario, store.humans).parent)
            write_atomic(human_file(unit.scenario, store.humans), parcel.human)
        run_dir = store.run_dir(unit)
        _write(run_dir, parcel.working)
        result = advance(replace(parcel.task, store=store), run_dir, lambda episodes: None)
        return Answer(result, _files(run_dir))


def keep(store: Store, unit: Unit, answer: Answer) -> str:
    """Store what a node made; how the unit ended."""
    run_dir = store.run_dir(unit)
    _write(run_dir, answer.working)
    if answer.result is None:
        return STOPPED
    store.put(unit, answer.result)
    (run_dir / CHECKPOINT_FILE).unlink(missing_ok=True)
    return FINISHED


def import_ray() -> Any:
    """The library; UserError where it is not installed."""
    try:
        import ray
    except ImportError:
        raise UserError("--ray needs Ray: python -m pip install '.[ray]'") from None
    return ray


def _connect(ray: Any, address: str) -> None:
    import edge_runtime
    import trainer

    # Nodes need the libraries; our own code is sent to them.
    modules = {"py_modules": [edge_runtime, trainer]}
    try:
        ray.init(address=address, runtime_env=modules, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise UserError(f"--ray {address}: no cluster answers: {error}") from error


def _submit(ray: Any, task: Task) -> Any:
    resources: dict[str, float] = {"num_cpus": 1, "max_retries": RETRIES}
    if task.device == "cuda":
        resources["num_gpus"] = GPU_SHARE
    return ray.remote(**resources)(compute_parcel).remote(pack(task))


def _receive(ray: Any, task: Task, reference: Any) -> str:
    try:
        return keep(task.store, task.unit, ray.get(reference))
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None) or error
        last = str(cause).strip().splitlines()[-1:]  # a MemoryError says nothing
        say(": ".join(("failed", str(task.unit), type(cause).__name__, *last)))
        return FAILED


def _files(run_dir: Path) -> dict[str, bytes]:
    return {
        name: (run_dir / name).read_bytes() for name in WORKING_FILES if (run_dir / name).is_file()
    }


def _write(run_dir: Path, files: dict[str, bytes]) -> None:
    make_directory(run_dir)
    for name, data in files.items():
        write_atomic(run_dir / name, data)
