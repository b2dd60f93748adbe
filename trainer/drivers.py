"""Drivers by name: the word expert, ``module:Class`` of an expert, ``constant:ACTION``, an exported
policy, a training run or a human model.
"""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from edge_runtime.controller import limit_action, neutral_action, shared_limits
from edge_runtime.util import UserError, name_in_file
from trainer.environments import (
    check_trained_in,
    entries_of,
    expert_of,
    inner,
    make_environment,
    task_of,
)
from trainer.human import MODEL_FILE
from trainer.human.guide import Action, Driver, Observation
from trainer.human.model import load_human_model
from trainer.learner.networks import Actor
from trainer.util import fitting, load_torch

CONSTANT = "constant:"  # Before an action that is kept throughout: a floor for any policy
CHECKPOINT_FILE = "checkpoint.pt"
BEST_FILE = "best_actor.pt"
ActTogether = Callable[[Observation], Action]  # Many actions for many observations


class TogetherDriver(Driver):
    """Drives without a memory, one observation at a time or many at once.

    ``act_together`` gives actions float32 [n, action size] for observations [n, ...].
    """

    def __init__(self, act_together: ActTogether) -> None:
        self.act_together = act_together

    def act(self, observation: Observation) -> Action:
        return self.act_together(observation[None])[0]


def constant_driver(action: float, size: int = 1) -> TogetherDriver:
    """Return a driver with one action throughout; ValueError unless it is from -1 to 1."""
    if not -1.0 <= action <= 1.0:
        raise ValueError(action)
    return TogetherDriver(lambda seen: np.full((len(seen), size), action, np.float32))


class OnnxDriver(Driver):
    """Drives with an exported policy file, in the edge runtime's own loader."""

    def __init__(self, path: Path, public_key: str | None = None) -> None:
        from edge_runtime.policy import load_policy

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

        It keeps to the manifest's range and rate of change, as the edge does: onnxruntime's tanh
        exceeds 1 by a last bit now and then. Answers count as a control period apart; the edge
        measures the time, so behind jitter it may allow less.
        """
        wanted = self.policy.act(entries_of(observation, self._plain)).tolist()
        self._last = limit_action(wanted, self._last, self._limits, self._period_s)
        return inner(self._range, self._last)


def is_expert(word: str) -> bool:
    """Return whether this is the word expert, or ``module:Class`` of an expert."""
    a_class = re.fullmatch(r"[\w.]+:\w+", word) and not word.startswith(CONSTANT)
    return word == "expert" or bool(a_class)


def located(driver: str) -> str:
    """Return a driver's name with any path absolute: a simulator may change the directory."""
    return driver if is_expert(driver) or not Path(driver).exists() else os.path.abspath(driver)


def load_driver(policy: str, env: Any, public_key: str | None = None) -> tuple[Driver, str]:
    """Return the driver that the word or path ``policy`` names, and its policy id.

    ``public_key`` is a PEM file to verify an .onnx file with; see `edge_runtime.policy`. Raises
    UserError where nothing drives.
    """
    if is_expert(policy):
        return expert_of(env, policy), policy
    if policy.startswith(CONSTANT):
        try:
            action = float(policy.removeprefix(CONSTANT))
            return constant_driver(action, env.action_space.shape[0]), policy
        except ValueError:
            expected = f"expected an action from -1 to 1, as in {CONSTANT}0.5"
            raise UserError(f"{policy}: {expected}") from None
    path = Path(policy)
    if path.suffix == ".onnx":
        driver, wanted = OnnxDriver(path, public_key), task_of(env).text
        if (found := driver.policy.manifest.text) != wanted:
            raise UserError(f"{policy} is for {found}, and {env.scenario} asks for {wanted}")
        return driver, driver.policy.policy_id
    if (path / MODEL_FILE).is_file():
        return TogetherDriver(load_human_model(path, env)[0].eval().act), f"human:{path.name}"
    if path.is_dir():
        actor, about = load_actor(path, env)
        return TogetherDriver(actor.eval().act), f"run:{path.name}:{about['episode']}"
    raise UserError(
        f"{policy} is no policy: expected an .onnx file, a training run, "
        "a human model's directory, the word expert, module:Class of one, or constant:ACTION"
    )


def load_actor(run_dir: Path, env: Any = None) -> tuple[Actor, dict[str, Any]]:
    """Return a run's best actor on the validation seeds, or the last where none was validated.

    The dict beside the network has ``scenario``, ``algorithm``, ``seed``, ``episode``. Without
    ``env`` the environment is made by the name in the file.

    Raises UserError for no run, a run in another environment than ``env``, or, without ``env``, in
    an environment of a module.
    """
    there = [run_dir / name for name in (BEST_FILE, CHECKPOINT_FILE)]
    path = next((path for path in there if path.is_file()), None)
    if path is None:
        raise UserError(f"{run_dir} holds no training run ({BEST_FILE} or {CHECKPOINT_FILE})")
    state = load_torch(path)
    with fitting(f"{path} is not a checkpoint of this project"):
        networks = state if path.name == BEST_FILE else state["learning"]["learner"]
        weights = networks[state.get("kept_actor", "actor")]
        told = {key: state[key] for key in ("scenario", "algorithm", "seed", "episode")}
        label: dict[str, Any] = msgspec.convert(told, dict[str, str | int])
        if env is None:
            said = f"{run_dir} was trained in"
            env = make_environment(name_in_file(label["scenario"], said, "--scenario"))
        check_trained_in(env, run_dir, label["scenario"])
        first = next((w for name, w in weights.items() if name.endswith("conv1.weight")), None)
        frames = 2 if first is None else first.shape[1]
        actor = Actor(len(weights["head.output.bias"]), frames, env.observation_space)
        actor.load_state_dict(weights)
    return actor, label
