"""Measure the learner, the environments and a training; on a GPU Stable-Baselines3's TD3, too."""

import argparse
import contextlib
import json
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from bridge.report import ProgressBar
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.util import UserError
from trainer.environments import make_environment
from trainer.learner import networks
from trainer.learner.config import LearnerConfig
from trainer.scenarios import SCENARIOS
from trainer.training.config import RunConfig
from trainer.training.learning import LearningThread
from trainer.training.run import TrainingRun
from trainer.util import check_device, processor_model, set_threads, source_revision

ROUNDS = 20
UPDATES, STEPS = 5, 200  # In a round; so many steps are about three episodes
PARTS = ("environment", "acting", "storing", "learning", "waiting")


def run(arguments: argparse.Namespace) -> int:
    check_writable(arguments.out)
    check_device(arguments.device)
    set_threads(arguments.threads)
    report = measure(arguments.device)
    write_json_out(arguments.out, report)
    print(json.dumps(report, indent=2))
    return 0


def measure(device: str = "cpu", batch_size: int = LearnerConfig.batch_size) -> dict[str, Any]:
    """Return the report: machine, versions, the contract's three figures, and those of a GPU."""
    learner = LearnerConfig(batch_size=batch_size, warmup_steps=batch_size)
    config = RunConfig(evaluate_every_steps=0, learner=learner, device=device)
    with (
        ProgressBar("bench", 2 + len(SCENARIOS)) as bar,
        tempfile.TemporaryDirectory() as directory,
    ):
        sb3 = stable_baselines3(config) if device == "cuda" else None
        run = TrainingRun(config, Path(directory))
        with contextlib.closing(run.learning):
            training = measure_training(run)
            bar.advance({})
            update_s = run.learning.in_thread(median_s, whole_update(run.learning), UPDATES)
            bar.advance({"update": f"{1e3 * update_s:.1f} ms"})
            on_gpu = on_a_gpu(run, sb3) if sb3 else {}
        step_s = {}
        for name in SCENARIOS:
            step_s[name] = median_s(steps_of(name), STEPS)
            bar.advance({name: f"{1 / step_s[name]:.0f} steps/s"})
    return {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "source_revision": source_revision(),
        "batch_size": batch_size,
        "on_gpu": on_gpu,
        "learner_ms_per_update": 1e3 * update_s,
        "environment_steps_per_s": {name: 1.0 / value for name, value in step_s.items()},
        "train_s_per_10k_steps": training,
    }


def in_turn(contenders: dict[str, Callable[[], int]]) -> dict[str, float]:
    """Call contenders by turns; return median seconds a piece. A call returns its piece count."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(1 + ROUNDS):
        for name, work in contenders.items():
            start_s = time.perf_counter()
            pieces = work()
            times[name].append((time.perf_counter() - start_s) / pieces)
    return {name: float(np.median(each[1:])) for name, each in times.items()}


def repeated(work: Callable[[], object], pieces: int) -> int:
    for _ in range(pieces):
        work()
    return pieces


def median_s(work: Callable[[], object], pieces: int) -> float:
    return in_turn({"": partial(repeated, work, pieces)})[""]


def whole_update(learning: LearningThread) -> Callable[[], None]:
    """Return a function that does one update: draw a minibatch, learn, store new priorities."""
    random, replay = np.random.default_rng(0), learning.replay

    def update() -> None:
        batch = replay.sample(learning.config.batch_size, random)
        losses = learning.learner.update(batch, 0.0)
        replay.update_priorities(batch.indices, losses.priorities)

    return update


def steps_of(scenario: str) -> Callable[[], None]:
    """Return a function that drives one step of a scenario with a random action."""
    env, random, seeds = make_environment(scenario), np.random.default_rng(0), count()
    env.reset(seed=next(seeds))

    def drive() -> None:
        _, _, terminated, truncated, _ = env.step(random.uniform(-1, 1, 1).astype(np.float32))
        if terminated or truncated:
            env.reset(seed=next(seeds))

    return drive


def measure_training(run: TrainingRun) -> dict[str, float]:
    """Train with one update per step, without validation or checkpoint.

    Returns seconds for 10,000 steps, extrapolated: the wall-clock total and its parts.
    """
    while run.learning.replay.added < run.config.learner.warmup_steps:
        run.advance()
    began_s = time.perf_counter()
    episodes = [run.advance() for _ in range(ROUNDS // 2)]
    seconds = {"total": time.perf_counter() - began_s}
    seconds |= {name: sum(getattr(each, f"{name}_s") for each in episodes) for name in PARTS}
    steps = sum(each.steps for each in episodes)
    return {name: 1e4 / steps * value for name, value in seconds.items()}


def on_a_gpu(run: TrainingRun, sb3: Any) -> dict[str, Any]:
    """Measure our and Stable-Baselines3's update and training step, and a graph replay alone, ms.

    Stable-Baselines3 gets the networks of tables A2 and A3 and does less: its critics share one
    trunk, its replay is uniform, and it has neither Q advantage nor cloning.
    """
    (recorded,) = run.learning.learner.recorded.values()

    def replay() -> None:
        recorded.replay()
        torch.cuda.synchronize()

    ours, steps = whole_update(run.learning), 10 * UPDATES
    theirs = partial(sb3.train, 1, run.config.learner.batch_size)
    each_s = in_turn({
        "replay": partial(repeated, replay, UPDATES),
        "update": partial(run.learning.in_thread, repeated, ours, UPDATES),
        "update_of_sb3": partial(repeated, theirs, UPDATES),
        "step": lambda: run.advance().steps,
        "step_of_sb3": lambda: sb3.learn(steps, reset_num_timesteps=False) and steps,
    })  # fmt: skip
    return {"gpu": torch.cuda.get_device_name(),
            **{f"ms_per_{name}": 1e3 * piece_s for name, piece_s in each_s.items()}}  # fmt: skip


def stable_baselines3(config: RunConfig) -> Any:
    """Make Stable-Baselines3's TD3, beyond its warm-up; UserError where it is not installed."""
    try:
        from stable_baselines3 import TD3
        from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
    except ImportError:
        raise UserError("--device cuda needs Stable-Baselines3: pip install '.[dev]'") from None

    class Trunk(BaseFeaturesExtractor):
        def __init__(self, space: gymnasium.Space[Any]) -> None:
            super().__init__(space, networks.FEATURES)
            self.trunk = networks.make_trunk(networks.FRAMES_SPACE, 2)

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return self.trunk(images)

    batch_size = config.learner.batch_size
    model = TD3(
        "CnnPolicy", gymnasium.make(SCENARIOS["left_turn"]), learning_starts=batch_size,
        batch_size=batch_size, buffer_size=10_000, policy_delay=1, device=config.device,
        policy_kwargs={"features_extractor_class": Trunk, "net_arch": [*networks.HIDDEN]},
    )  # fmt: skip
    return model.learn(2 * batch_size)
