"""``python -m deploy policy``, which also takes the model.zip of Stable-Baselines3.

The file holds pickles, and a pickle is a program. This reader lets it call only what `KNOWN` lists;
any other name becomes an object that does nothing. Arrays hold plain numbers only. Memory is
limited, since a few bytes can demand all of it.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict

from bridge import policy_file
from bridge.environments import Environment
from bridge.policy_file import Model
from edge_runtime.cli import Subcommand, examples
from edge_runtime.manifest import Task
from edge_runtime.util import UserError, read_bytes
from trainer.util import fitting, limited_memory, load_torch

LIBRARY = "stable_baselines3"
KNOWN = {
    f"{LIBRARY}.sac.policies": "SACPolicy CnnPolicy MultiInputPolicy",
    f"{LIBRARY}.td3.policies": "TD3Policy CnnPolicy MultiInputPolicy",
    f"{LIBRARY}.common.policies":
        "ActorCriticPolicy ActorCriticCnnPolicy MultiInputActorCriticPolicy",
    f"{LIBRARY}.common.torch_layers": "FlattenExtractor NatureCNN CombinedExtractor",
    f"{LIBRARY}.common.vec_env.vec_normalize": "VecNormalize",
    f"{LIBRARY}.common.running_mean_std": "RunningMeanStd",
    "torch.nn.modules.activation": "ELU GELU LeakyReLU Mish ReLU SELU SiLU Sigmoid Softplus Tanh",
    "gymnasium.spaces.box": "Box",
    "gymnasium.spaces.dict": "Dict",
    "numpy._core.multiarray": "_reconstruct",
    "numpy._core.numeric": "_frombuffer",
    "collections": "OrderedDict",
}  # fmt: skip
"""Names that a pickle may call, by module."""
MOST_MIB, MOST_MEMORY_MIB = 512, 4096
OTHERWISE = "export a complete ONNX file yourself, as docs/own_policy.md says"


class _Unknown:
    def __init__(self, *_: Any) -> None: ...
    def __setstate__(self, _: Any) -> None: ...


class _Array(np.ndarray):
    """Stands for ndarray; a pickle may not call it: a buffer could pose as Python objects."""

    def __new__(cls, *_: Any) -> Any:
        raise TypeError("an array is made by _reconstruct")


def _plain(dtype: Any, *_: Any) -> np.dtype[Any]:
    """Return numpy's own type of plain numbers, which a pickle's `__setstate__` cannot change."""
    plain = np.dtype(np.dtype(dtype).type)
    if plain.kind not in "biuf":
        raise TypeError(plain)
    return plain


def _scalar(dtype: np.dtype[Any], data: bytes) -> Any:
    return np.frombuffer(data, dtype)[0]


OURS = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _plain,
    ("numpy._core.multiarray", "scalar"): _scalar,
}
"""Replace numpy's own, which a pickle can make treat any number as an object's address."""


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core", "numpy._core")  # As numpy 1 writes
        if (module, name) in OURS:
            return OURS[module, name]
        if name in KNOWN.get(module, "").split():
            return super().find_class(module, name)
        return type(name, (_Unknown,), {"__module__": module})


def _read(pickled: bytes) -> Any:
    return _Reader(io.BytesIO(pickled)).load()


def _space(read: Any) -> Any:
    """Rebuild a Box, or a Dict of them, from one that was read; return another's class name."""
    if isinstance(read, Dict):
        return Dict([(name, _box(each)) for name, each in read.spaces.items()])
    return _box(read)


def _box(read: Any) -> Any:
    is_box = isinstance(read, Box)
    return Box(read.low, read.high, dtype=read.dtype) if is_box else type(read).__name__


@limited_memory(MOST_MEMORY_MIB)
def read_model(arguments: argparse.Namespace, environment: Environment, task: Task) -> Model:
    """Convert a model.zip's deterministic policy, with its squash, scaling and normalisation.

    Raises UserError for another file, for parts that are not the library's, and for a model of
    other observations or actions than the environment's.
    """
    path, normaliser, action_space = Path(arguments.model), None, environment.action_space
    what = f"model.zip of {LIBRARY} (SAC, TD3, DDPG, PPO, A2C), or that library is not installed"
    with fitting(f"{path} is no {what}"):
        archive = zipfile.ZipFile(io.BytesIO(read_bytes(path, "model", MOST_MIB)))
        weights = load_torch(path, archive.read("policy.pth"))
        data = json.loads(archive.read("data"))
        for name in ("policy_class", "policy_kwargs", "observation_space", "action_space"):
            if packed := data[name].get(":serialized:"):
                data[name] = _read(base64.b64decode(packed))
        observed, acted = (_space(data[f"{each}_space"]) for each in ("observation", "action"))
        kind, options, on_policy = data["policy_class"], data["policy_kwargs"], "gae_lambda" in data
        options = {n: value for n, value in options.items() if not n.startswith("optimizer")}
        for name, each in {"policy_class": kind, **options}.items():
            if _Unknown in (type(each).__base__, getattr(each, "__base__", None)):
                raise UserError(f"the {name} of {path} is not one of {LIBRARY}: {OTHERWISE}")
    if acted != action_space:
        raise UserError(f"{path} acts in {acted}, {task.task} in {action_space}")
    if arguments.normalise:
        normaliser = read_normaliser(arguments.normalise)
    elif on_policy and data.get("_last_original_obs"):  # Off-policy models always have one.
        raise UserError(f"{path} was trained behind a VecNormalize: add --normalise")

    from trainer.policy_file import LibraryPolicy, to_onnx  # It loads torch

    unfit = f"{path} does not fit {task.task}: it observes {observed}"
    with fitting(unfit):
        options = {"use_sde": data["use_sde"], **options} if on_policy else options
        policy = kind(observed, action_space, lambda _: 0.0, **options)
        policy.load_state_dict(weights)
        network = LibraryPolicy(policy.eval(), normaliser, [*task.observation])
        algorithm = kind.__module__.split(".")[1]
        if on_policy:
            algorithm = "ppo" if "clip_range" in data else "a2c"
        elif data.get("target_noise_clip") == 0.0:  # TD3 without target smoothing
            algorithm = "ddpg"
        return Model(to_onnx(network, task), algorithm, fitting(unfit)(network.act))


def read_normaliser(file: str) -> Any:
    """Read the library's VecNormalize; UserError for anything else."""
    with fitting(f"{file} is no VecNormalize saved by {LIBRARY}: {OTHERWISE}"):
        normaliser = _read(read_bytes(file, "normalisation"))
        if not hasattr(normaliser, "normalize_obs"):
            raise TypeError(type(normaliser))
        return normaliser


def _run(arguments: argparse.Namespace) -> int:
    if arguments.model.endswith(".zip"):
        return policy_file.run(arguments, read_model)
    if arguments.normalise:
        raise UserError("--normalise is for a model.zip; an ONNX file holds its own normalisation")
    return policy_file.run(arguments)


POLICY = Subcommand(
    examples(
        "python -m deploy policy a.onnx --env Pendulum-v1 --set action.0.stop=0 --out b.onnx",
        "python -m deploy policy td3.zip --env Pendulum-v1 --set action.0.stop=0 --out b.onnx",
    ),
    policy_file.add_arguments,
    _run,
)
