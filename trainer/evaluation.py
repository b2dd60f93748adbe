"""Drive test episodes with a policy and report how well it does."""

import argparse
import json
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np

from bridge.environments import finite
from bridge.network import LatencySpec, parse_spec
from bridge.outcomes import GOAL
from bridge.report import EpisodeResult, ProgressBar, accelerations, of_known, summarise
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.policy import load_policy
from edge_runtime.util import UserError, counted, name_in_file, read_json
from trainer.drivers import ActTogether, load_driver, located
from trainer.environments import CONDITIONS, make_environment, scenario_of
from trainer.human.guide import Driver
from trainer.learner.replay import Action
from trainer.options import limited_threads
from trainer.training.config import period_of
from trainer.training.delayed import DelayedVehicle

NO_NETWORK = LatencySpec()


def run(arguments: argparse.Namespace) -> int:
    """Evaluate and print the report; return the exit status."""
    check_writable(arguments.out)
    names = ("policy", "scenario", "runs", "seed", "condition", "latency", "public_key")
    found = evaluate(**{name: getattr(arguments, name) for name in names})
    if not arguments.out:
        print(json.dumps(found.report, indent=2))
        return 0
    detail = [asdict(result) for result in found.episodes]
    write_json_out(arguments.out, {**found.report, "per_episode": detail})
    success = "" if found.success_rate is None else f"success {found.success_rate:.1%}, "
    said = f"{success}return {found.mean_return:.2f}"
    print(f"{counted(arguments.runs, 'episode')}: {said}: {arguments.out}")
    return 0


@dataclass(frozen=True)
class Evaluation:
    """The results of test episodes."""

    report: dict[str, Any]  # As ``trainer evaluate`` prints it
    episodes: list[EpisodeResult]

    @property
    def success_rate(self) -> float | None:
        """Share of episodes that reached the goal; None: the environment knows no goal."""
        return self.report["success_rate"]

    @property
    def mean_return(self) -> float:
        """Mean of the episodes' sums of rewards."""
        return float(self.report["episode_reward"]["mean"])


def evaluate(
    policy: str | PathLike[str],
    scenario: str | None = None,
    *,
    runs: int = 50,
    seed: int = 0,
    condition: str = "nominal",
    latency: str = "none",
    public_key: str | None = None,
) -> Evaluation:
    """Drive test episodes with a policy alone, as ``python -m trainer evaluate`` does.

    ``policy`` may also be what ``train`` gave; ``scenario`` is by default what it was trained in,
    else the left turn. Episode i is reset with ``seed + i``.

    Raises UserError: no such policy, condition or number of runs; a policy of another environment;
    an environment that reports what is no number.
    """
    if condition not in CONDITIONS:
        raise UserError(f"condition must be one of {', '.join(CONDITIONS)}: {condition}")
    if runs < 1 or seed < 0:
        raise UserError(f"runs must be at least 1, and seed at least 0: {runs}, {seed}")
    scenario = scenario or getattr(policy, "scenario", None)
    policy, spec = located(fspath(policy)), parse_spec(latency)
    named, period_s = trained_in(policy, public_key)
    named = scenario or name_in_file(named, f"{policy} was trained in", "--scenario")
    scenario = scenario_of(named)
    goals = 0
    with ExitStack() as stack:
        env = stack.enter_context(closing(make_environment(scenario, condition, period_s=period_s)))
        driver, policy_id = load_driver(policy, env, public_key)
        stack.enter_context(limited_threads(1))  # The last bits must not depend on the cores.
        bar = stack.enter_context(ProgressBar("evaluating", runs))

        def on_episode(result: EpisodeResult) -> None:
            nonlocal goals
            goals += result.outcome == GOAL
            bar.advance({"success": f"{goals / (bar.done + 1):.2f}"})

        seeds = range(seed, seed + runs)
        results = drive_episodes(env, driver, seeds, condition, on_episode, spec)
    report = summarise(results, scenario, condition, policy_id, seed)
    return Evaluation({**report, "latency_spec": str(spec)}, results)


def trained_in(policy: str, public_key: str | None) -> tuple[str, float | None]:
    """Return the scenario of a run, a human model or a policy file, and its control period, s.

    The period is None where the environment said it. Anything else drives the left turn.
    """
    for name in ("config.json", "human.json"):
        if (Path(policy) / name).is_file():
            known = read_json(Path(policy) / name, "config")
            return scenario_of(str(known.get("scenario"))), period_of(known)
    if not policy.endswith(".onnx"):
        return "left_turn", None
    manifest = load_policy(policy, public_key, allow_unsigned=True).manifest
    config = manifest.training.get("config")
    named = config.get("scenario") if isinstance(config, dict) else None
    # One of `deploy policy` names its environment itself.
    name = str(named or manifest.training.get("environment") or manifest.task)
    return scenario_of(name), manifest.control_period_s


class Drive:
    """A test episode under way; its driver sees ``observation`` next.

    Gaussian noise of standard deviation ``noise_std`` is added to commands, with the same seed.
    """

    def __init__(self, env: Any, seed: int, noise_std: float = 0.0) -> None:
        self.env, self.noise_std = env, noise_std
        self.over = False
        self.result = EpisodeResult(seed, "", 0.0, 0.0, 0.0, None, None, 0)
        """Complete once the episode is over."""
        self.observation, _ = env.reset(seed=seed)
        self._noise = np.random.default_rng([seed, 1])
        self._felt: list[list[float | None]] = []

    def step(self, action: Action) -> None:
        """Drive one control period."""
        if self.noise_std:
            disturbed = action + self._noise.normal(0.0, self.noise_std, action.shape)
            action = np.clip(disturbed, -1.0, 1.0).astype(np.float32)
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        result, self.over = self.result, terminated or truncated
        result.actions.append([float(a) for a in action])
        result.reward += finite("reward", reward)
        self._felt.append(accelerations(info))
        if self.over:
            result.outcome = info["outcome"]
            result.distance_m = finite("distance_m", info["distance_m"])
            result.steps = len(result.actions)
            result.time_s = result.steps * self.env.control_period_s
            result.lateral_acceleration_mps2, result.longitudinal_acceleration_mps2 = map(
                of_known, zip(*self._felt, strict=True)
            )


def drive_together(
    envs: Sequence[Any], act: ActTogether, seeds: Sequence[int], condition: str = "nominal"
) -> list[EpisodeResult]:
    """Drive an episode for each seed, as many at once as there are environments.

    ``act`` has no memory: it returns actions [n, action size] for observations [n, ...].
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
            results[drive.result.seed] = drive.result
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

    The condition's noise is added here; its scene is the environment's (``make_environment``).
    ``latency`` is the network between driver and vehicle, in virtual time.
    """
    results, act = [], driver.act
    if latency != NO_NETWORK:
        env = DelayedVehicle(env, latency)
        act = env.behind(driver.act)
    for seed in seeds:
        drive = Drive(env, seed, CONDITIONS[condition].noise_std)
        driver.reset()
        while not drive.over:
            drive.step(act(drive.observation))
        results.append(drive.result)
        on_episode(drive.result)
    return results
