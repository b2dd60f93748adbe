"""Write a trained actor as a policy file (contract section 4)."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bridge.policy_file import Arrays, make_policy, try_policy, write_policy
from edge_runtime.files import check_writable
from edge_runtime.manifest import Task
from edge_runtime.policy import UNSIGNED, open_policy
from edge_runtime.util import UserError, name_in_file, read_json
from trainer.environments import make_environment, own_environment, task_of
from trainer.evaluation import load_actor
from trainer.learner.networks import Actor
from trainer.training.config import CONFIG_FILE, period_of

OPSET = 17  # Readable by the oldest onnxruntime that a board may have


def run(arguments: argparse.Namespace) -> int:
    out, scenario, key = arguments.out, arguments.scenario, arguments.key
    made = export(arguments.run_dir, out, scenario=scenario, key=key)
    signed = "signed" if arguments.key else "not signed"
    print(f"{arguments.out}: {signed}, policy_id {made.policy_id}")
    print(f"torch and onnxruntime differ by at most {made.max_difference:.1e}")
    return 0


@dataclass(frozen=True)
class Export:
    """A policy file's bytes, and the largest difference of onnxruntime from torch."""

    model: bytes = field(repr=False)
    policy_id: str
    max_difference: float


def export(
    run: str | PathLike[str],
    out: str | PathLike[str],
    *,
    scenario: str | None = None,
    key: str | PathLike[str] | None = None,
) -> Export:
    """Write a run's actor as a policy file, as ``python -m trainer export`` does.

    ``run`` is the result of ``train``, or its directory. ``scenario``, that of the training, is
    needed only where it is ``module:ID``. ``key`` is the private key (PEM) that signs the file.

    Raises UserError: no run there, a wrong name or key, or onnxruntime differs from the actor.
    """
    scenario = scenario or getattr(run, "scenario", None)
    # Absolute: a simulator may change the working directory.
    file, run = Path(out).absolute(), Path(run).absolute()
    key = None if key is None else Path(key).absolute()
    if file.suffix != ".onnx":
        raise UserError(f"--out {file}: the file's name must end in .onnx")
    check_writable(file)
    config = read_json(run / CONFIG_FILE, "run config")
    named = str(config.get("scenario"))
    scenario = scenario or name_in_file(named, f"{run} was trained in", "--scenario")
    with closing(make_environment(scenario, period_s=period_of(config))) as env:
        actor, label = load_actor(run, env)
        made = export_policy(actor, label, config, env)
    write_policy(made.model, file, key)
    return made


def export_policy(
    actor: Actor, label: dict[str, Any], training: dict[str, Any], env: Any
) -> Export:
    """Convert an actor, describe it in a manifest, and compare torch with onnxruntime.

    ``label`` has ``algorithm``, ``seed`` and ``episode`` of the run; ``training``, its config, goes
    into the manifest. Raises UserError if the two differ.
    """
    network, task = _InOwnUnits(actor, env.action_range).eval(), task_of(env)
    about = {"seed": label["seed"], "episodes": label["episode"], "config": training}
    about["source_revision"] = training.get("source_revision", "unknown")
    model = make_policy(to_onnx(network, task), task, label["algorithm"], about)

    def act(entries: Arrays) -> NDArray[Any]:
        with torch.no_grad():
            batch = [torch.from_numpy(array[None].copy()) for array in entries.values()]
            return np.asarray(network(*batch)[0])

    policy = open_policy(model, UNSIGNED)
    return Export(model, policy.policy_id, try_policy(policy, own_environment(env), model, act))


class _InOwnUnits(torch.nn.Module):
    """The actor with its actions in the environment's range, as ``environments.outer`` scales."""

    reach: torch.Tensor

    def __init__(self, actor: Actor, action_range: tuple[Any, Any]) -> None:
        super().__init__()
        low, high = (torch.from_numpy(np.asarray(ends, np.float32)) for ends in action_range)
        self.actor, self.low = actor, low
        self.register_buffer("reach", 0.5 * (high - low))
        self.scaled = not bool((low == -1).all() and (high == 1).all())

    def forward(self, *entries: torch.Tensor) -> torch.Tensor:
        action = self.actor(*entries)
        return self.low + (action + 1.0) * self.reach if self.scaled else action


class LibraryPolicy(torch.nn.Module):
    """A policy of Stable-Baselines3 that acts as its ``predict`` does.

    ``normaliser`` is a VecNormalize or None, ``names`` are those of the observation's entries.
    """

    def __init__(self, policy: Any, normaliser: Any, names: Sequence[str]) -> None:
        super().__init__()
        self.policy, self.names, self._normaliser = policy, names, normaliser
        self._spaces = getattr(policy.observation_space, "spaces", None)
        ends = policy.action_space.low, policy.action_space.high
        self._low, self._high = (torch.from_numpy(np.ravel(each)) for each in ends)

    def act(self, entries: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
        """Return the library's own action for one observation, in the environment's units."""
        batch: Any = {name: np.array(array[None]) for name, array in entries.items()}
        batch = batch if self._spaces else batch[self.names[0]]
        batch = self._normaliser.normalize_obs(batch) if self._normaliser else batch
        return np.ravel(self.policy.predict(batch, deterministic=True)[0])

    def forward(self, *entries: torch.Tensor) -> torch.Tensor:
        batch: Any = dict(map(self._prepared, self.names, entries))
        batch = batch if self._spaces else batch[self.names[0]]
        action = self.policy._predict(batch, deterministic=True).reshape(-1, len(self._low))
        if self.policy.squash_output:
            return self._low + 0.5 * (action + 1.0) * (self._high - self._low)
        return torch.clamp(action, self._low, self._high)

    def _prepared(self, name: str, entry: torch.Tensor) -> tuple[str, torch.Tensor]:
        space = (self._spaces or {}).get(name, self.policy.observation_space)
        norm = self._normaliser
        rms = norm.obs_rms if norm and norm.norm_obs else {}
        if rms := rms.get(name) if isinstance(rms, dict) else rms:
            std = torch.from_numpy(np.sqrt(rms.var + norm.epsilon))
            entry = (entry.double() - torch.from_numpy(rms.mean)) / std
            entry = entry.clamp(-norm.clip_obs, norm.clip_obs).float()
        channels_last = tuple(entry.shape[1:]) != space.shape  # The policy's space has them first.
        return name, entry.permute(0, 3, 1, 2) if channels_last else entry


def to_onnx(network: torch.nn.Module, task: Task) -> bytes:
    """Convert a network to ONNX; inputs are the task's entries, each with a batch dimension."""
    entries = task.observation.items()
    examples = [torch.zeros((1, *e.shape), dtype=getattr(torch, e.dtype)) for _, e in entries]
    names, buffer = list(task.observation), BytesIO()
    with warnings.catch_warnings():
        # The newer exporter writes opset 18 and IR 10, which old boards refuse.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            tuple(examples),
            buffer,  # type: ignore[arg-type]  # torch's own stubs forget file objects
            dynamo=False,
            opset_version=OPSET,
            input_names=names,
            output_names=["action"],
            dynamic_axes={name: {0: "batch"} for name in (*names, "action")},
        )
    return buffer.getvalue()
