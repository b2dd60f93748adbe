"""Load a driver by name (policy file, run, human model, expert), and drive test episodes."""

import argparse
import json
import os
import re
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from bridge.environments import arrays_of, finite
from bridge.network import LatencySpec, parse_spec
from bridge.outcomes import success_estimate
from bridge.report import EpisodeResult, ProgressBar, accelerations, of_known, summarise
from bridge.rerun import check_sink
from edge_runtime.controller import limit_action, neutral_action, shared_limits
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.policy import Policy, load_policy
from edge_runtime.util import UserError, counted, name_in_file, read_json
from trainer.environments import (
    CONDITIONS,
    DelayedVehicle,
    check_trained_in,
    entries_of,
    expert_of,
    inner,
    make_environment,
    scenario_of,
    task_of,
)
from trainer.human import MODEL_FILE
from trainer.human.guide import Driver, Record
from trainer.human.model import load_human_model
from trainer.learner.networks import Actor
from trainer.learner.replay import Action, Observation, Transition
from trainer.training.config import period_of
from trainer.util import fitting, limited_threads, load_torch

NO_NETWORK = LatencySpec()
CONSTANT = "constant:"  # Prefix of an action that is held throughout: a floor for any policy
CHECKPOINT_FILE = "checkpoint.pt"
BEST_FILE = "best_actor.pt"
ActTogether = Callable[[Observation], Action]  # Actions for a batch of observations


def run(arguments: argparse.Namespace) -> int:
    check_writable(arguments.out)
    names = ("policy", "scenario", "runs", "seed", "condition", "latency", "success", "public_key",
             "video", "rerun")  # fmt: skip
    evaluation = evaluate(**{name: getattr(arguments, name) for name in names})
    if not arguments.out:
        print(json.dumps(evaluation.report, indent=2))
        return 0
    detail = [asdict(result) for result in evaluation.episodes]
    write_json_out(arguments.out, {**evaluation.report, "per_episode": detail})
    print(f"{evaluation}: {arguments.out}")
    return 0


@dataclass(frozen=True)
class Evaluation:
    report: dict[str, Any]  # As ``trainer evaluate`` prints it
    episodes: list[EpisodeResult]

    def __repr__(self) -> str:
        parts = [counted(len(self.episodes), "episode"), f"return {self.mean_return:.2f}"]
        if (share := self.success_rate) is not None:
            count = len(self.episodes)
            parts.insert(1, f"success {success_estimate(round(share * count), count).as_share()} %")
        return ", ".join(parts)

    @property
    def success_rate(self) -> float | None:
        """Share of episodes that reached the goal; None: the environment knows no goal."""
        return self.report["success_rate"]

    @property
    def mean_return(self) -> float:
        return float(self.report["episode_reward"]["mean"])


def evaluate(
    policy: str | PathLike[str],
    scenario: str | None = None,
    *,
    runs: int = 50,
    seed: int = 0,
    condition: str = "nominal",
    latency: str = "none",
    success: str = "",
    public_key: str | None = None,
    video: str | PathLike[str] | None = None,
    rerun: str | None = None,
    on_step: Record | None = None,
) -> Evaluation:
    """Drive test episodes with a policy alone, as ``python -m trainer evaluate`` does.

    ``policy`` may also be the result of ``train``; ``scenario`` defaults to the one it was trained
    in, else the left turn. Episode i is reset with ``seed + i``. ``on_step(transition, None,
    info)`` is called after each control period; ``info`` also holds ``episode`` and ``step``.

    Raises UserError: no such policy, condition or number of runs; a policy of another environment;
    an environment whose reward or distance is no finite number.
    """
    if condition not in CONDITIONS:
        raise UserError(f"condition must be one of {', '.join(CONDITIONS)}: {condition}")
    if runs < 1 or seed < 0:
        raise UserError(f"runs must be at least 1, and seed at least 0: {runs}, {seed}")
    scenario = scenario or getattr(policy, "scenario", None)
    policy, spec = located(fspath(policy)), parse_spec(latency)
    sink = None if rerun is None else check_sink(rerun)
    film = check_writable(video)
    if film and Path(film).suffix != ".mp4":
        raise UserError(f"--video {video}: the file's name must end in .mp4")
    recorders: list[Record] = [] if on_step is None else [on_step]
    of_training, period_s = trained_in(policy, public_key)
    scenario = scenario or name_in_file(of_training, f"{policy} was trained in", "--scenario")
    scenario, seeds = scenario_of(scenario), range(seed, seed + runs)
    with (
        closing(make_environment(scenario, condition, False, period_s, success)) as env,
        limited_threads(1),  # The last bits must not depend on the number of cores.
        ProgressBar("evaluating", runs) as bar,
        ExitStack() as stack,
    ):
        driver, policy_id = load_driver(policy, env, public_key)
        if film or sink:
            from trainer import view  # rerun takes a second to load

            shown = [view.filmed(env, Path(film))] if film else []
            shown += [view.drives_watched(env, sink)] if sink else []
            recorders += map(stack.enter_context, shown)
        results = drive_episodes(
            env, driver, seeds, condition, lambda _: bar.advance({}), spec, recorders
        )
    report = summarise(results, scenario, condition, policy_id, seed)
    return Evaluation({**report, "latency_spec": str(spec)}, results)


def trained_in(policy: str, public_key: str | None) -> tuple[str, float | None]:
    """Return the scenario of a run, a human model or a policy file, and its control period, s.

    The period is None for the environment's own. Any other policy drives the left turn.
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
    # A file of `deploy policy` holds no training config, but names its environment.
    name = str(named or manifest.training.get("environment") or manifest.task)
    return scenario_of(name), manifest.control_period_s


class Loaded(NamedTuple):
    """A loaded policy file."""

    policy: Policy  # The edge runtime's

    def __repr__(self) -> str:
        return f"{self.policy.policy_id[:12]}: {self.policy.manifest.text}"

    def act(self, observation: Any) -> NDArray[np.float32]:
        """Return the action [n], clipped to its range, for an environment's own observation."""
        manifest = self.policy.manifest
        ends = np.array([(row.low, row.high) for row in manifest.action], np.float32).T
        return np.clip(self.policy.act(arrays_of(manifest, observation)), *ends)


def load(path: str | PathLike[str], public_key: str | PathLike[str] | None = None) -> Loaded:
    """Load a policy file, signed or not; ``public_key``, if given, must verify its signature."""
    return Loaded(load_policy(path, public_key, allow_unsigned=True))


class TogetherDriver(Driver):
    """Drives without memory, one observation at a time or a batch at once.

    ``act_together`` gives actions float32 [n, action size] for observations [n, ...].
    """

    def __init__(self, act_together: ActTogether) -> None:
        self.act_together = act_together

    def act(self, observation: Observation) -> Action:
        return self.act_together(observation[None])[0]


def constant_driver(action: float, size: int = 1) -> TogetherDriver:
    """Return a driver that holds one action; ValueError unless it is from -1 to 1."""
    if not -1.0 <= action <= 1.0:
        raise ValueError(action)
    return TogetherDriver(lambda batch: np.full((len(batch), size), action, np.float32))


class OnnxDriver(Driver):
    """Drives with an exported policy file, loaded as the edge runtime loads it."""

    def __init__(self, path: Path, public_key: str | None = None) -> None:
        self.policy = load_policy(str(path), public_key, allow_unsigned=True)
        manifest = self.policy.manifest
        self._plain, rows = next(iter(manifest.observation)), manifest.action
        self._range = np.array([row.low for row in rows]), np.array([row.high for row in rows])
        self._limits, self._period_s = shared_limits(rows, {}), manifest.control_period_s
        self.reset()

    def reset(self) -> None:
        self._last = neutral_action(self._limits)

    def act(self, observation: Observation) -> Action:
        """Return the policy's action, float32 [action size], scaled to [-1, 1].

        It is limited to the manifest's range and rate of change, as on the edge: onnxruntime's tanh
        sometimes exceeds 1 by the last bit. Calls count as one control period apart; the edge
        measures the time, so under jitter it may allow less.
        """
        wanted = self.policy.act(entries_of(observation, self._plain)).tolist()
        self._last = limit_action(wanted, self._last, self._limits, self._period_s)
        return inner(self._range, self._last)


def is_expert(word: str) -> bool:
    """Return whether this is the word expert, or ``module:Class`` of an expert."""
    a_class = re.fullmatch(r"[\w.]+:\w+", word) and not word.startswith(CONSTANT)
    return word == "expert" or bool(a_class)


def located(driver: str) -> str:
    """Make a driver's path absolute, other names as they are: a simulator may change directory."""
    return driver if is_expert(driver) or not Path(driver).exists() else os.path.abspath(driver)


def load_driver(policy: str, env: Any, public_key: str | None = None) -> tuple[Driver, str]:
    """Return the driver that the word or path ``policy`` names, and its policy id.

    ``public_key`` is a PEM file to verify an .onnx file with; see `edge_runtime.policy`. Raises
    UserError: no such driver, or one for another environment.
    """
    if is_expert(policy):
        return expert_of(env, policy), policy
    if policy.startswith(CONSTANT):
        with fitting(f"{policy}: expected an action from -1 to 1"):
            action = float(policy.removeprefix(CONSTANT))
            return constant_driver(action, env.action_space.shape[0]), policy
    path = Path(policy)
    if path.suffix == ".onnx":
        driver, wanted = OnnxDriver(path, public_key), task_of(env).text
        if (task := driver.policy.manifest.text) != wanted:
            raise UserError(f"{policy} is for {task}, but {env.scenario} asks for {wanted}")
        return driver, driver.policy.policy_id
    if (path / MODEL_FILE).is_file():
        return TogetherDriver(load_human_model(path, env).eval().act), f"human:{path.name}"
    if path.is_dir():
        actor, about = load_actor(path, env)
        return TogetherDriver(actor.eval().act), f"run:{path.name}:{about['episode']}"
    raise UserError(
        f"{policy} is no policy: expected an .onnx file, a training run, "
        "a human model's directory, the word expert, module:Class of one, or constant:ACTION"
    )


def load_actor(run_dir: Path, env: Any) -> tuple[Actor, dict[str, Any]]:
    """Return a run's best validated actor, or its last one if none was validated, and its label.

    The label holds ``scenario``, ``algorithm``, ``seed`` and ``episode``. Raises UserError for no
    run, or a run in another environment than ``env``.
    """
    paths = [run_dir / name for name in (BEST_FILE, CHECKPOINT_FILE)]
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        raise UserError(f"{run_dir} holds no training run ({BEST_FILE} or {CHECKPOINT_FILE})")
    state = load_torch(path)
    with fitting(f"{path} is not a checkpoint of this project"):
        networks = state if path.name == BEST_FILE else state["learning"]["learner"]
        weights = networks[state.get("kept_actor", "actor")]
        fields = {key: state[key] for key in ("scenario", "algorithm", "seed", "episode")}
        label: dict[str, Any] = msgspec.convert(fields, dict[str, str | int])
        check_trained_in(env, run_dir, label["scenario"])
        conv1 = next((w for name, w in weights.items() if name.endswith("conv1.weight")), None)
        frames = 2 if conv1 is None else conv1.shape[1]
        actor = Actor(len(weights["head.output.bias"]), frames, env.observation_space)
        actor.load_state_dict(weights)
    return actor, label


class Drive:
    """A test episode: ``step`` with the action for ``observation`` until it is ``over``.

    Gaussian noise of standard deviation ``noise_std``, drawn by the same seed, disturbs the action.
    """

    def __init__(self, env: Any, seed: int, noise_std: float = 0.0) -> None:
        self.env, self.noise_std = env, noise_std
        self.over = False
        self.result = EpisodeResult(seed)
        """Complete once the episode is over."""
        self.observation, _ = env.reset(seed=seed)
        self._noise = np.random.default_rng([seed, 1])
        self._accelerations: list[list[float | None]] = []

    def step(self, action: Action) -> None:
        """Drive one control period; set ``transition`` and ``info``."""
        wanted = action
        if self.noise_std:
            disturbed = action + self._noise.normal(0.0, self.noise_std, action.shape)
            action = np.clip(disturbed, -1.0, 1.0).astype(np.float32)
        before = self.observation
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        after, ends = self.observation, (terminated, truncated)
        self.transition = Transition(before, action, reward, after, *ends, overruled=wanted)
        self.info = info
        result, self.over = self.result, terminated or truncated
        result.actions.append([float(a) for a in action])
        result.reward += finite("reward", reward)
        self._accelerations.append(accelerations(info))
        if self.over:
            result.outcome = info["outcome"]
            result.distance_m = finite("distance_m", info["distance_m"])
            result.steps = len(result.actions)
            result.time_s = result.steps * self.env.control_period_s
            result.lateral_acceleration_mps2, result.longitudinal_acceleration_mps2 = map(
                of_known, zip(*self._accelerations, strict=True)
            )


def drive_together(
    envs: Sequence[Any], act: ActTogether, seeds: Sequence[int], condition: str = "nominal"
) -> list[EpisodeResult]:
    """Drive an episode for each seed, as many at once as there are environments.

    ``act`` has no memory: it returns actions [n, action size] for observations [n, ...].
    """
    noise_std = CONDITIONS[condition].noise_std
    waiting, free, drives = deque(seeds), deque(envs), list[Drive]()
    while waiting or not all(drive.over for drive in drives):
        while waiting and free:
            drives.append(Drive(free.popleft(), waiting.popleft(), noise_std))
        under_way = [drive for drive in drives if not drive.over]
        actions = act(np.stack([drive.observation for drive in under_way]))
        for drive, action in zip(under_way, actions, strict=True):
            drive.step(action)
            if drive.over:
                free.append(drive.env)
    return [drive.result for drive in drives]


def drive_episodes(
    env: Any,
    driver: Driver,
    seeds: Iterable[int],
    condition: str = "nominal",
    on_episode: Callable[[EpisodeResult], object] = lambda result: None,
    latency: LatencySpec = NO_NETWORK,
    recorders: Sequence[Record] = (),
) -> list[EpisodeResult]:
    """Drive one episode for each seed under a condition.

    The condition's noise is added here; ``make_environment`` has chosen its scene.
    ``latency`` is the network between driver and vehicle, in virtual time.
    """
    results, act = [], driver.act
    if latency != NO_NETWORK:
        env = DelayedVehicle(env, latency)
        act = env.behind(driver.act)
    for episode, seed in enumerate(seeds):
        drive = Drive(env, seed, CONDITIONS[condition].noise_std)
        driver.reset()
        while not drive.over:
            drive.step(act(drive.observation))
            for record in recorders:
                place = {"episode": episode, "step": len(drive.result.actions)}
                record(drive.transition, None, {**drive.info, **place})
        results.append(drive.result)
        on_episode(drive.result)
    return results
