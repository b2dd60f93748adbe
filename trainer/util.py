"""Helpers of the trainer: seeds, ranges of settings, torch files, locked directories, processes.

torch takes two seconds to load and is imported only in the functions that need it: ``--help`` and
the configs do not.
"""

import io
import math
import multiprocessing
import os
import platform
import resource
import signal
import subprocess
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import fields
from enum import IntEnum
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from edge_runtime.files import check_writable, make_directory, try_to_lock_file, write_atomic
from edge_runtime.util import UserError, open_regular

Job = TypeVar("Job")
Result = TypeVar("Result")
PERIOD_S = 0.1  # Control period of an environment that names none
DEVICES = ("cpu", "cuda")
Range = tuple[float, float]
ANY: Range = (-math.inf, math.inf)
FROM_ONE: Range = (1, math.inf)
FROM_ZERO: Range = (0, math.inf)
ABOVE_ZERO: Range = (2.0**-126, math.inf)
"""From float32's smallest normal number on: smaller numbers may become zero."""
SHARE: Range = (0, 1)


class Purpose(IntEnum):
    """A use of random numbers in a run; each has a stream of its own."""

    TRAINING = 0
    VALIDATION = 1
    EXPLORATION = 2
    REPLAY = 3
    HUMAN_EPISODES = 4
    HUMAN_BATCHES = 5
    GUIDANCE = 6
    SITTINGS = 7  # Episodes that a person drives without learning
    DEMONSTRATIONS = 8


def episode_seed(run_seed: int, purpose: Purpose, episode: int) -> int:
    """Return the environment's seed for an episode, above 2**31: tests use small numbers."""
    (word,) = np.random.SeedSequence([run_seed, purpose, episode]).generate_state(1)
    return (1 << 31) + int(word) // 2


def random_stream(run_seed: int, purpose: Purpose) -> np.random.Generator:
    return np.random.default_rng([run_seed, purpose])


def check_ranges(config: Any, ranges: Mapping[Range, Sequence[str]]) -> None:
    """Raise UserError unless every number of a dataclass is finite and within its range.

    Fields that ``ranges`` does not name are at least 0. A default may be outside its range.
    """
    named = {name: limits for limits, names in ranges.items() for name in names}
    for field in fields(config):
        if isinstance(field.default, bool) or not isinstance(field.default, int | float):
            continue
        name, value = field.name, getattr(config, field.name)
        low, high = named.get(name, FROM_ZERO)
        if value != field.default and not (math.isfinite(value) and low <= value <= high):
            raise UserError(f"{name} = {value} is out of range: {low} to {high}")


def save_torch(path: Path, state: Any) -> None:
    import torch

    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomic(path, buffer.getbuffer())


def load_torch(path: Path, data: bytes | None = None) -> dict[str, Any]:
    """Read a file of ``save_torch``: tensors and plain values only; UserError for any other file.

    ``data`` replaces the file's bytes.
    """
    import torch

    try:
        with open_regular(path) if data is None else io.BytesIO(data) as stream:
            archive = zipfile.ZipFile(stream)
            if any(part.compress_type for part in archive.infolist()):
                raise ValueError("torch compresses nothing")  # Others may unpack to any size
            # torch writes a checksum of each part, but never checks it.
            if damaged := archive.testzip():
                raise ValueError(f"{damaged} is damaged")
            stream.seek(0)
            state = torch.load(stream, map_location="cpu", weights_only=True)  # noqa: TID251
        if not isinstance(state, dict):
            raise TypeError(type(state))
        return state
    except Exception as error:  # torch raises errors of its own for foreign files.
        raise UserError(f"{path} is not a checkpoint of this project: {error}") from error


@contextmanager
def fitting(words: str) -> Iterator[None]:
    """Turn any error that a crafted or foreign file causes into a UserError with this text."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(words) from error


@contextmanager
def limited_memory(most_mib: int) -> Iterator[None]:
    """Limit the memory that this process may take in addition; a larger allocation fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    most = pages * resource.getpagesize() + (most_mib << 20)
    limits = [limit for limit in (soft, hard, most) if limit != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_DATA, (min(limits), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


@contextmanager
def claimed(directory: Path) -> Iterator[None]:
    """Lock a directory for this process alone; UserError if another process uses it.

    A missing directory is made, and removed again if it stays empty.
    """
    made = [path for path in (directory, *directory.parents) if not os.path.lexists(path)]
    with held(directory) as mine:
        if not mine:
            raise UserError(f"{directory} is in use by another process")
        for draft in directory.glob(f".{16 * '[0-9a-f]'}.tmp"):  # Left by a killed writer
            draft.unlink(missing_ok=True)
        try:
            yield
        finally:
            with suppress(OSError):  # Not empty
                for path in made:
                    path.rmdir()


@contextmanager
def held(directory: Path, patience_s: float = 0.0) -> Iterator[bool]:
    """Lock a directory against other processes; yield whether that succeeded in ``patience_s``.

    A missing directory is made, else UserError. The kernel ends the lock with its process.
    """
    make_directory(directory)
    check_writable(directory / ".held")
    end_s, descriptor = time.monotonic() + patience_s, os.open(directory, os.O_RDONLY)
    try:
        while not (mine := try_to_lock_file(descriptor)) and time.monotonic() < end_s:
            time.sleep(0.01)
        yield mine
    finally:
        os.close(descriptor)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def side_by_side(
    function: Callable[[Job], Result], jobs: Sequence[Job], processes: int, niceness: int
) -> Iterator[dict[Future[Result], Job]]:
    """Call ``function`` with each job, in a process of its own; yield the futures with their jobs.

    At most ``processes`` run at once (0: one for each core). A process that dies fails its own job
    alone, with UserError. An error in the block cancels all jobs.
    """

    def call(job: Job) -> Result:
        with ProcessPoolExecutor(1, get_context("spawn"), begin_process, (niceness,)) as process:
            try:
                return process.submit(function, job).result()
            except BrokenProcessPool:
                raise UserError("its process died; the same command goes on") from None

    with ThreadPoolExecutor(processes or cores()) as threads:
        work = {threads.submit(call, job): job for job in jobs}
        try:
            yield work
        except BaseException:
            for each in work:
                each.cancel()
            while wait(work, 0.1).not_done:
                for running in multiprocessing.active_children():
                    running.kill()
            raise


def begin_process(niceness: int) -> None:
    """Set up a worker: leave ^C to the parent, end with the parent, lower the priority.

    A SIGINT waits for `edge_runtime.cli.handled`: the parent's may come before the work begins.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    threading.Thread(target=die_with_parent, daemon=True).start()
    os.nice(niceness)


def die_with_parent() -> None:
    """End this process when its parent has ended; run it in a thread."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def kept(path: str) -> str:
    """Return a repository file's path, valid in any folder; unchanged in the root."""
    root = Path(__file__).parents[1]
    return path if Path.cwd() == root else str(root / path)


@cache
def source_revision(directory: Path = Path(__file__).parent) -> str:
    """Return a repository's commit, ``-dirty`` where files differ from it, or ``unknown``."""
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        git = subprocess.run(describe, cwd=directory, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return git.stdout.strip()


def cpu_info() -> list[str]:
    """Return Linux' lines about each core; none elsewhere."""
    try:
        return Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        return []


def processor_model() -> str:
    """Return the processor's name; on Linux ``platform`` only knows its instruction set."""
    for line in cpu_info():
        if line.startswith("model name") and (name := line.partition(":")[2].strip()):
            return name
    return platform.processor() or platform.machine()


def deadline_s(minutes: float | None, clock: Callable[[], float] = time.monotonic) -> float:
    """Return the time in so many minutes, by ``clock``; infinity for None."""
    return math.inf if minutes is None else clock() + 60.0 * minutes


def check_device(device: str) -> None:
    """Raise UserError unless the learner can compute on the device."""
    import torch

    if device not in DEVICES:
        raise UserError(f"device must be one of {', '.join(DEVICES)}: {device}")
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("no CUDA device is available; use --device cpu")


def set_threads(count: int) -> None:
    """Limit PyTorch's threads; 0 leaves them alone."""
    if count:
        import torch

        torch.set_num_threads(count)


@contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Limit PyTorch's threads within a block."""
    import torch

    before = torch.get_num_threads()
    set_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
