"""Memory of a fresh process that does one thing."""

from __future__ import annotations

import multiprocessing
import resource
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

from trainer.benches.effort import Effort
from trainer.learner.config import LearnerConfig
from trainer.training.config import RunConfig
from trainer.training.run import TrainingRun

STATUS = Path("/proc/self/status")


def apart(work: Callable[..., Any], *arguments: Any) -> Any:
    """What ``work(*arguments)`` returns in a process of its own, with as many threads as ours."""
    spawn = multiprocessing.get_context("spawn")
    threads = torch.get_num_threads()
    with ProcessPoolExecutor(1, spawn, torch.set_num_threads, (threads,)) as pool:
        return pool.submit(work, *arguments).result()


def resident_bytes(field: str = "VmRSS") -> int:
    """Memory of this process that is in use; ``VmHWM``: the most that ever was.

    Linux's ``ru_maxrss`` would be wrong: a process starts with its parent's figure.
    """
    if STATUS.is_file():
        lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
        return 1024 * int(lines[field].split()[0])
    # Elsewhere only the peak is known, on macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def measure_memory(effort: Effort) -> dict[str, Any]:
    """Peak of a short training; its buffer is nearly empty, a full one comes on top."""
    steps, peak = apart(_train, effort)
    return {"episodes": effort.memory_episodes, "steps": steps, "training_peak_mb": 1e-6 * peak}


def _train(effort: Effort) -> tuple[int, int]:
    learner = LearnerConfig(batch_size=effort.batch_size, warmup_steps=effort.batch_size)
    config = RunConfig(episodes=effort.memory_episodes, evaluate_every_steps=0, learner=learner)
    with tempfile.TemporaryDirectory() as directory:
        run = TrainingRun(config, Path(directory))
        run.train()
    return run.learning.added, resident_bytes("VmHWM")
