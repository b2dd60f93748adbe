"""Processes that drive test episodes behind a network, in virtual time: of sweep and envelope.

Each drive is the same to the bit as one over the wire in lock-step (`tests/test_loop.py`).
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

from bridge.network import LatencySpec
from bridge.outcomes import TIMEOUT, TRUNCATED, UNKNOWN
from bridge.report import EpisodeResult
from edge_runtime.util import UserError
from trainer.environments import make_environment
from trainer.evaluation import drive_episodes, load_driver, located, trained_in
from trainer.util import cores, die_with_parent, set_threads


class Drivers(ProcessPoolExecutor):
    """A pool of processes, each with an environment and the policy; 0 jobs: one a core.

    Raises UserError where the policy does not load or the environment cannot be made.
    """

    def __init__(self, policy: str, env: str, condition: str, public_key: str | None, jobs: int):
        policy = located(policy)
        task = (policy, env, condition, public_key, trained_in(policy, public_key)[1])
        environment, _, self.policy_id = _load(*task)
        self.control_period_s: float = environment.control_period_s
        self.jobs = jobs or cores()
        self.driven = 0
        self._ends = {TRUNCATED}  # How any drive has ended
        super().__init__(self.jobs, get_context("spawn"), partial(_begin, *task))

    def __exit__(self, *_: object) -> None:
        self.shutdown(cancel_futures=True)

    def drive(self, spec: LatencySpec, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Drive an episode for each seed; return the results without their actions.

        Raises UserError where the environment does not report of each drive how it ended.
        """
        results = list(self.map(partial(_drive, spec), seeds))
        self.driven += len(results)
        self._ends.update(result.outcome for result in results)
        # A step limit is a timeout as soon as the end of any other drive was reported.
        if UNKNOWN in self._ends or len(self._ends) == 1:
            raise UserError("no outcome or is_success in info tells whether it succeeded")
        return [
            replace(result, outcome=TIMEOUT) if result.outcome == TRUNCATED else result
            for result in results
        ]


_mine: list[Any] = []  # Of a process of the pool: environment, driver, condition


def _load(policy: str, env: str, condition: str, key: str | None, period_s: float | None) -> Any:
    """Return the environment, the policy as its driver, and the policy's id."""
    environment = make_environment(env, condition, period_s=period_s)
    return environment, *load_driver(policy, environment, key)


def _begin(*task: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its parent ends it
    threading.Thread(target=die_with_parent, daemon=True).start()
    set_threads(1)
    environment, driver, _ = _load(*task)
    _mine[:] = environment, driver, task[2]


def _drive(spec: LatencySpec, seed: int) -> EpisodeResult:
    env, driver, condition = _mine
    (result,) = drive_episodes(env, driver, [seed], condition, latency=spec)
    return replace(result, actions=[])
