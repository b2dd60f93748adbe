"""The same units on a Ray cluster: no node needs a disk that it shares with another.

A task takes along what there is of a unit, its checkpoint and its human, and brings back what it
made; whoever asked keeps it.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from edge_runtime.files import make_directory, write_atomic
from edge_runtime.util import UserError
from trainer.drivers import BEST_FILE, CHECKPOINT_FILE
from trainer.experiments.run import PATIENCE_S, Task, make_record, say
from trainer.experiments.store import BUSY, FAILED, FINISHED
from trainer.human.model import MODEL_FILE
from trainer.training.metrics import METRICS_FILE

WORKING_FILES = (CHECKPOINT_FILE, BEST_FILE, METRICS_FILE)
"""What a unit goes on from."""
RETRIES = 3
"""How often a unit is begun again when the node under it dies."""


class Parcel(NamedTuple):
    """A task on its way to a node, or back from it with its record."""

    task: Task
    human: bytes | None
    working: dict[str, bytes]
    record: dict[str, Any] | None = None


def pack(task: Task) -> Parcel:
    """A task with all that a node needs for it."""
    model = task.store.humans / task.unit.scenario / MODEL_FILE
    human = model.read_bytes() if task.unit.needs_human else None
    return Parcel(task, human, _read(task.store.run_dir(task.unit)))


def compute_parcel(parcel: Parcel) -> Parcel:
    """Unpack, compute and pack again; runs on a node."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as directory:
        root, unit = Path(directory), parcel.task.unit
        store = replace(parcel.task.store, results=root, runs=root, humans=root / "humans")
        if parcel.human is not None:
            _write(store.humans / unit.scenario, {MODEL_FILE: parcel.human})
        run_dir = store.run_dir(unit)
        _write(run_dir, parcel.working)
        record = make_record(replace(parcel.task, store=store), run_dir, lambda steps: None)
        return parcel._replace(working=_read(run_dir), record=record)


def keep(parcel: Parcel) -> str:
    """Keep what a node made; how the unit ended."""
    store, unit = parcel.task.store, parcel.task.unit
    _write(store.run_dir(unit), parcel.working)
    return store.keep(unit, parcel.record)


def run_on_ray(tasks: Sequence[Task], address: str) -> Counter[str]:
    """Compute units as Ray tasks of one processor each; how many ended in which way.

    Args:
        tasks: what to compute.
        address: of the cluster, as ``ray.init`` takes it; ``local`` starts one on this machine.

    Raises:
        UserError: Ray is not installed, or nothing answers at the address.
    """
    ray = _connected(address)
    remote = ray.remote(num_cpus=1, max_retries=RETRIES)(compute_parcel)
    ends: Counter[str] = Counter()
    with ExitStack() as locks:
        waiting = {}
        for task in tasks:
            if not locks.enter_context(task.store.lock(task.unit, PATIENCE_S)):
                ends[BUSY] += 1
            elif task.store.record(task.unit):  # made elsewhere since it was asked for
                ends[FINISHED] += 1
            else:
                waiting[remote.remote(pack(task))] = task
        while waiting:
            (ready, *_), _ = ray.wait(list(waiting))
            task = waiting.pop(ready)
            try:
                end = keep(ray.get(ready)._replace(task=task))
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
        import edge_runtime
        import trainer

        # Nodes need the libraries; our own code is sent to them.
        modules = {"py_modules": [edge_runtime, trainer]}
        try:
            ray.init(address=address, runtime_env=modules, log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UserError(f"--ray {address}: no cluster answers: {error}") from error
    return ray


def _read(run_dir: Path) -> dict[str, bytes]:
    paths = [run_dir / name for name in WORKING_FILES]
    return {path.name: path.read_bytes() for path in paths if path.is_file()}


def _write(directory: Path, files: dict[str, bytes]) -> None:
    make_directory(directory)
    for name, data in files.items():
        write_atomic(directory / name, data)
