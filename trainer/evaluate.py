"""Drive test episodes with a policy and report how well it does: in one process, or in several."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bridge.network import LatencySpec, parse_spec
from bridge.report import GOAL, EpisodeResult, summarise
from edge_runtime.cli import add_public_key, examples, not_negative, positive
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.util import UserError, counted
from trainer.drivers import CONDITIONS, load_driver, make_environment
from trainer.human.guide import Action, Driver
from trainer.options import add_latency, add_scenario, add_seed, set_threads
from trainer.training.delayed import VehicleEnd
from trainer.util import ProgressBar

EXAMPLE = examples(
    "python -m trainer evaluate expert --runs 20",
    "python -m trainer evaluate constant:0 --scenario congestion",
    "python -m trainer evaluate runs/phil_1 --runs 50 --out result.json",
    "python -m trainer evaluate runs/phil_1 --condition variant --latency 50ms+-10ms,loss=1%",
)
NO_NETWORK = LatencySpec()
ActTogether = Callable[[NDArray[np.uint8]], NDArray[np.float32]]
WORTH_STARTING = 200
"""Episodes from which on processes pay: each spends 2 s on its imports first, and two cores save
half of the 25 ms that an episode with a network takes (10 ms with the expert)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "policy",
        metavar="POLICY",
        help="an .onnx file, a RUN_DIR, a HUMAN_DIR, the word expert, or constant:ACTION for one "
        "action from -1 to 1 throughout",
    )
    add_public_key(parser)
    add_scenario(parser)
    parser.add_argument(
        "--condition",
        choices=CONDITIONS,
        default="nominal",
        help="; ".join(f"{name}: {what.meaning}" for name, what in CONDITIONS.items()).replace(
            "%", "%%"
        ),
    )
    add_latency(parser, "the network between policy and vehicle")
    parser.add_argument(
        "--runs", type=positive, default=50, metavar="N", help="how many episodes are driven"
    )
    add_seed(parser, "the first episode; each next one has one more")
    parser.add_argument(
        "--jobs",
        type=not_negative,
        default=0,
        metavar="N",
        help="how many processes drive; they change the time taken, never a result. "
        f"0: one a core from {WORTH_STARTING} episodes on, below that a single one",
    )
    parser.add_argument(
        "--out",
        metavar="R.json",
        help="write the report, with each episode, to this file instead of printing it",
    )


def run(arguments: argparse.Namespace) -> int:
    """Evaluate and print the report; returns the exit status."""
    if arguments.out:
        check_writable(arguments.out)
    latency = parse_spec(arguments.latency)
    env = make_environment(arguments.scenario, arguments.condition)
    driver, policy_id = load_driver(arguments.policy, env, arguments.public_key)
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    jobs = min(arguments.jobs or choose_jobs(arguments.runs), arguments.runs)
    goals = 0
    with ProgressBar("evaluating", arguments.runs) as bar:

        def on_episode(result: EpisodeResult) -> None:
            nonlocal goals
            goals += result.outcome == GOAL
            bar.advance({"success": f"{goals / (bar.done + 1):.2f}"})

        condition, more = arguments.condition, (on_episode, latency)
        if jobs == 1:
            set_threads(1)  # As each worker: the last bits must not depend on how many drive.
            results = drive_episodes(env, driver, seeds, condition, *more)
        else:
            named = arguments.policy, arguments.scenario, seeds, jobs
            results = drive_episodes_in_parallel(*named, condition, *more, arguments.public_key)
    report = summarise(results, arguments.scenario, arguments.condition, policy_id, arguments.seed)
    report["latency_spec"] = str(latency)
    if not arguments.out:
        print(json.dumps(report, indent=2))
        return 0
    detail = [asdict(result) for result in results]
    write_json_out(arguments.out, {**report, "per_episode": detail})
    distance_m = report["surviving_distance_m"]
    print(
        f"{counted(arguments.runs, 'episode')}: success {report['success_rate']:.0%}, "
        f"surviving distance {distance_m['mean']:.2f} ± {distance_m['std']:.2f} m: {arguments.out}"
    )
    return 0


class Drive:
    """One episode under way; ``observation`` is what its driver sees next.

    Args:
        env: a scenario.
        seed: of the episode, and of the noise.
        noise_std: standard deviation of Gaussian noise on the command.
    """

    def __init__(self, env: Any, seed: int, noise_std: float = 0.0) -> None:
        self.env, self.seed, self.noise_std = env, seed, noise_std
        self.over = False
        self.observation, self._info = env.reset(seed=seed)
        self._noise = np.random.default_rng([seed, 1])
        self._actions: list[list[float]] = []
        self._rewards: list[float] = []
        self._lateral: list[float] = []
        self._longitudinal: list[float] = []

    def step(self, action: Action) -> None:
        """One control period."""
        if self.noise_std:
            disturbed = action + self._noise.normal(0.0, self.noise_std, action.shape)
            action = np.clip(disturbed, -1.0, 1.0).astype(np.float32)
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        self._actions.append([float(a) for a in action])
        self._rewards.append(reward)
        self._lateral.append(abs(info["lateral_acceleration_mps2"]))
        self._longitudinal.append(abs(info["longitudinal_acceleration_mps2"]))
        self._info, self.over = info, terminated or truncated

    def result(self) -> EpisodeResult:
        """What it came to, once it is over."""
        return EpisodeResult(
            seed=self.seed,
            outcome=self._info["outcome"],
            distance_m=float(self._info["distance_m"]),
            reward=float(sum(self._rewards)),
            time_s=len(self._actions) * self.env.config.control_period_s,
            lateral_acceleration_mps2=float(np.mean(self._lateral)),
            longitudinal_acceleration_mps2=float(np.mean(self._longitudinal)),
            steps=len(self._actions),
            actions=self._actions,
        )


def drive_episode(
    env: Any,
    driver: Driver,
    seed: int,
    noise_std: float = 0.0,
    latency: LatencySpec = NO_NETWORK,
) -> EpisodeResult:
    """Drive one episode; ``latency`` is the network between driver and vehicle, in virtual time.

    The other arguments are as for ``Drive``.
    """
    drive = Drive(env, seed, noise_std)
    driver.reset()
    network = None if latency == NO_NETWORK else VehicleEnd(env, latency, seed)
    while not drive.over:
        seen = drive.observation
        drive.step(network.tick(seen, driver.act) if network else driver.act(seen))
    return drive.result()


def drive_together(
    envs: Sequence[Any], act: ActTogether, seeds: Sequence[int], condition: str = "nominal"
) -> list[EpisodeResult]:
    """Drive an episode for each seed, as many at once as there are environments.

    A network answers many pictures much sooner than each alone; its last bits may differ.

    Args:
        envs: of one scenario and condition.
        act: actions [n, action size] for observations [n, 2, 45, 80], of a driver without memory.
        seeds: of the episodes.
        condition: one of ``CONDITIONS``.
    """
    noise_std = CONDITIONS[condition].noise_std
    results: dict[int, EpisodeResult] = {}
    waiting, free = deque(seeds), deque(envs)
    under_way: list[Drive] = []
    while waiting or under_way:
        while waiting and free:
            under_way.append(Drive(free.popleft(), waiting.popleft(), noise_std))
        actions = act(np.stack([drive.observation for drive in under_way]))
        for drive, action in zip(under_way, actions, strict=True):
            drive.step(action)
        for drive in (drive for drive in under_way if drive.over):
            results[drive.seed] = drive.result()
            free.append(drive.env)
        under_way = [drive for drive in under_way if not drive.over]
    return [results[seed] for seed in seeds]


def drive_episodes(
    env: Any,
    driver: Driver,
    seeds: Iterable[int],
    condition: str = "nominal",
    on_episode: Callable[[EpisodeResult], None] = lambda result: None,
    latency: LatencySpec = NO_NETWORK,
) -> list[EpisodeResult]:
    """Drive one episode for each seed under a condition.

    Its noise is added here; its scene is the environment's own (``drivers.make_environment``).
    """
    noise_std = CONDITIONS[condition].noise_std
    results = []
    for seed in seeds:
        results.append(drive_episode(env, driver, seed, noise_std, latency))
        on_episode(results[-1])
    return results


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
        policy: what drives, as in `trainer.drivers.load_driver`.
        scenario: what is driven.
        seeds: of the episodes.
        jobs: number of processes.
        condition: one of `trainer.drivers.CONDITIONS`.
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
    drive = partial(_drive, policy, scenario, condition, public_key, latency)
    results: list[EpisodeResult] = []
    try:
        with interrupts_blocked():
            # Not `pool.map`: it cancels what is left where a worker has died, and the pool's own
            # thread breaks over that and leaves the other workers behind (Python 3.11).
            futures = [pool.submit(drive, seed) for seed in seeds]
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
    condition: str,
    public_key: str | None,
    latency: LatencySpec,
    seed: int,
) -> EpisodeResult:
    env, driver = _cockpit(policy, scenario, condition, public_key)
    return drive_episodes(env, driver, [seed], condition, latency=latency)[0]
