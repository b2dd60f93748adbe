"""Episodes over several processes: the results of one process, sooner."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch

from bridge.network import LatencySpec
from bridge.report import EpisodeResult
from edge_runtime.util import UserError
from trainer.drivers import load_driver, make_environment
from trainer.evaluation import NO_NETWORK, drive_episodes
from trainer.human.guide import Driver

WORTH_STARTING = 200
"""Episodes from which on processes pay: each spends 2 s on its imports first, and two cores save
half of the 25 ms that an episode with a network takes (10 ms with the expert)."""


def choose_jobs(runs: int) -> int:
    """How many processes drive ``runs`` episodes soonest: this one alone, or one a core."""
    return min(cores(), runs) if runs >= WORTH_STARTING else 1


def cores() -> int:
    """Processor cores that this process may use, where the system tells; else all."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def drive_episodes_in_parallel(
    policy: str,
    scenario: str,
    seeds: Sequence[int],
    jobs: int,
    condition: str = "nominal",
    on_episode: Callable[[EpisodeResult], None] = lambda result: None,
    latency: LatencySpec = NO_NETWORK,
    public_key: str | None = None,
) -> list[EpisodeResult]:
    """Drive one episode for each seed under a condition, in ``jobs`` worker processes.

    Args:
        policy: who drives, as in `trainer.drivers.load_driver`.
        scenario: what is driven.
        seeds: of the episodes.
        jobs: number of processes.
        condition: one of `trainer.conditions.CONDITIONS`.
        on_episode: called with each result, in the order of the seeds.
        latency: the network between driver and vehicle, in virtual time.
        public_key: what an .onnx file is verified with.

    Returns:
        The results in the order of the seeds; to the bit what `drive_episodes` gives on one torch
        thread, whatever ``jobs`` is.

    Raises:
        UserError: nothing there that drives, or a worker died.
    """
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, initializer=_start_worker)
    results = []
    try:
        with interrupts_blocked():
            futures: list[Future[EpisodeResult]] = [
                pool.submit(_drive, policy, scenario, seed, condition, latency, public_key)
                for seed in seeds
            ]
        for future in futures:
            results.append(future.result())
            on_episode(results[-1])
    except BrokenProcessPool as error:
        raise UserError(
            f"a worker process died after {len(results)} of {len(seeds)} episodes; "
            "where memory is short, fewer jobs need less"
        ) from error
    except KeyboardInterrupt:
        # Their episodes are of no use any more, and one that is just starting may take long.
        for worker in multiprocessing.active_children():
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
    return results


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Processes started here never see ^C, which a terminal sends to all: their parent ends them.

    Blocked, not ignored: a ^C of this moment reaches the parent afterwards.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker() -> None:
    torch.set_num_threads(1)
    threading.Thread(target=die_with_parent, daemon=True).start()


def die_with_parent() -> None:
    """A killed parent can end nobody, and a worker would wait for work for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@cache
def _cockpit(
    policy: str, scenario: str, condition: str, public_key: str | None
) -> tuple[Any, Driver]:
    """Environment and driver, made once in a worker; here, so that a UserError finds its way."""
    env = make_environment(scenario, condition)
    return env, load_driver(policy, env, public_key)[0]


def _drive(
    policy: str,
    scenario: str,
    seed: int,
    condition: str,
    latency: LatencySpec,
    public_key: str | None,
) -> EpisodeResult:
    env, driver = _cockpit(policy, scenario, condition, public_key)
    return drive_episodes(env, driver, [seed], condition, latency=latency)[0]
