"""The same units on a Ray cluster: no node needs a disk that it shares with another.

A task takes along what there is of a unit, its checkpoint and its human, and brings back what it
made; the caller keeps it.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

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
