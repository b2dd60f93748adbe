"""Many units side by side: a process each, of one thread, on this machine."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

import torch

from edge_runtime.errors import UserError
from edge_runtime.files import make_directory, write_atomic
from trainer.experiments.work import BUSY, FINISHED, STOPPED, OnEpisode, Task, compute
from trainer.parallel import die_with_parent, interrupts_blocked
from trainer.progress import ProgressBar

NICENESS = 5
"""So that a machine on which somebody works stays usable."""
FAILED = "failed"
ERROR_FILE = "error.txt"

Function = Callable[[Task, OnEpisode], str]


@dataclass
class Tally:
    """How the units ended."""

    total: int
    ends: dict[str, int] = field(default_factory=dict)

    def count(self, end: str) -> int:
        """How many ended so."""
        return self.ends.get(end, 0)

    def add(self, end: str) -> None:
        """One more ended so."""
        self.ends[end] = self.count(end) + 1


@dataclass
class _Job:
    task: Task
    process: SpawnProcess
    episodes: int = 0
    end: str | None = None
    why: str = ""


def episodes_of(task: Task) -> int:
    """What a unit counts in the progress bar."""
    return task.store.plan.episodes[task.unit.scenario] if task.unit.trained else 1


def run_units(tasks: Sequence[Task], jobs: int, function: Function = compute) -> Tally:
    """Compute units in ``jobs`` processes at a time; each is reported, none takes others with it.

    Args:
        tasks: in the order in which they are begun; none is begun after its ``stop_at_s``.
        jobs: processes side by side.
        function: what each process does with its task.
    """
    tally = Tally(len(tasks))
    waiting = deque(tasks)
    running: dict[Connection, _Job] = {}
    with ProgressBar("experiments", sum(map(episodes_of, tasks)) or 1) as bar:
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    task = waiting.popleft()
                    if time.time() > task.stop_at_s:
                        tally.add(STOPPED)
                        continue
                    receiver, job = _start(task, function)
                    running[receiver] = job
                if not running:
                    break  # all that waited came too late
                for ready in wait(list(running)):
                    assert isinstance(ready, Connection)
                    job = running[ready]
                    moved = _listen(ready, job)
                    if not moved:
                        del running[ready]
                        _finish(job, tally)
                    bar.advance(_figures(tally, running.values()), moved or _rest(job))
        finally:
            for job in running.values():
                job.process.kill()
            for job in running.values():
                job.process.join()
    return tally


def _start(task: Task, function: Function) -> tuple[Connection, _Job]:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(task, function, sender), daemon=False)
    with interrupts_blocked():
        process.start()
    sender.close()  # so that the end of the process is the end of the pipe
    return receiver, _Job(task, process)


def _listen(receiver: Connection, job: _Job) -> int:
    """Take one message; how many episodes it adds, 0 where the process is at its end."""
    while True:
        try:
            kind, value = receiver.recv()
        except (EOFError, OSError):
            job.process.join()
            receiver.close()
            return 0
        if kind == "episodes":
            added = value - job.episodes
            job.episodes = value
            if added > 0:
                return added
            continue
        job.end, job.why = kind, value


def _finish(job: _Job, tally: Tally) -> None:
    """Count how a process ended, and say in one line what went wrong."""
    end = job.end or FAILED
    tally.add(end)
    if end == FAILED:
        code = job.process.exitcode
        say(f"failed: {job.task.unit}: {job.why or f'its process died (exit status {code})'}")
    if end == BUSY:
        say(f"left to {job.task.store.holder(job.task.unit)}: {job.task.unit}")


def _rest(job: _Job) -> int:
    """Episodes of a finished unit that were done before, and never reported."""
    return episodes_of(job.task) - job.episodes if job.end == FINISHED else 0


def _figures(tally: Tally, running: Iterable[_Job]) -> dict[str, str]:
    units = [str(job.task.unit) for job in running]
    figures = {"units": f"{tally.count(FINISHED)}/{tally.total}", "now": ", ".join(units[:2])}
    failed = tally.count(FAILED)
    return {**figures, "failed": str(failed)} if failed else figures


def say(line: str) -> None:
    """One line on stderr, beside the progress bar."""
    print(" ".join(line.split()), file=sys.stderr, flush=True)


def _work(task: Task, function: Function, sender: Connection) -> None:
    """A process's life."""
    os.nice(NICENESS)
    torch.set_num_threads(1)
    threading.Thread(target=die_with_parent, daemon=True).start()
    try:
        end = function(task, lambda episodes: sender.send(("episodes", episodes)))
        sender.send((end, ""))
    except UserError as error:
        sender.send((FAILED, str(error)))
    except BaseException as error:
        sender.send((FAILED, _keep(task, error)))


def _keep(task: Task, error: BaseException) -> str:
    """Write the traceback down, and say where."""
    text = f"{type(error).__name__}: {error}"
    try:
        run_dir = task.store.run_dir(task.unit)
        make_directory(run_dir)
        write_atomic(run_dir / ERROR_FILE, traceback.format_exc().encode())
    except UserError:
        return text
    return f"{text} ({run_dir / ERROR_FILE})"
