"""Train a policy of Stable-Baselines3, and save what `deploy policy` takes.

    python examples/sb3_policy.py Pendulum-v1 --steps 6000 --out td3.zip

That is the library's own file. With `--out td3.onnx` it is an ONNX, as from any other library: its
graph (`Exported`) holds all preprocessing of an observation, and scales the network's -1 to 1 to
the environment's own range.
"""

import argparse
from typing import Any

import gymnasium
import highway_env  # noqa: F401  (it registers its environments)
import torch
from stable_baselines3 import SAC, TD3, HerReplayBuffer
from torch import Tensor

OPSET = 17  # Readable by the oldest onnxruntime that a board may have


class Exported(torch.nn.Module):
    """Arrays in, action out, in the environment's own types and ranges."""

    low: Tensor
    range: Tensor

    def __init__(self, actor: Any, environment: gymnasium.Env[Any, Any]) -> None:
        super().__init__()
        seen, done = environment.observation_space, environment.action_space
        assert isinstance(done, gymnasium.spaces.Box)
        self.actor, self.is_sac = actor, hasattr(actor, "log_std")
        self.names = sorted(seen) if isinstance(seen, gymnasium.spaces.Dict) else []
        self.is_image = is_image(seen)
        self.register_buffer("low", torch.tensor(done.low))
        self.register_buffer("range", torch.tensor(done.high - done.low))

    def forward(self, *arrays: Tensor) -> Tensor:
        """Return the action, float32 [batch, n]."""
        seen: Any = dict(zip(self.names, arrays, strict=True)) if self.names else arrays[0]
        if self.is_image:
            seen = seen.permute(0, 3, 1, 2)  # the library sees channels first
        features = self.actor.extract_features(seen, self.actor.features_extractor)
        if self.is_sac:
            action = torch.tanh(self.actor.mu(self.actor.latent_pi(features)))
        else:
            action = self.actor.mu(features)
        return self.low + 0.5 * (action.clamp(-1.0, 1.0) + 1.0) * self.range


def is_image(space: gymnasium.Space[Any]) -> bool:
    """Return whether a space holds pictures, height first and colours last."""
    return space.dtype == "uint8" and len(space.shape or ()) == 3


def train(name: str, algorithm: str, steps: int, seed: int) -> Any:
    """Train a model; with hindsight if the observation holds a goal."""
    environment = gymnasium.make(name)
    options: dict[str, Any] = {"policy": "MlpPolicy", "learning_rate": 1e-3, "seed": seed}
    if isinstance(environment.observation_space, gymnasium.spaces.Dict):
        options |= {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer}
        options |= {"gamma": 0.95, "tau": 0.05, "learning_starts": 1000}
    elif is_image(environment.observation_space):
        options |= {"policy": "CnnPolicy", "buffer_size": 10_000, "learning_rate": 3e-4}
    kind = {"td3": TD3, "sac": SAC}[algorithm]
    return kind(env=environment, device="cpu", **options).learn(steps)


def export(model: Any, out: str) -> None:
    """Write the actor as ONNX, with inputs named after the entries of a Dict."""
    environment = model.get_env().envs[0].unwrapped
    network, seen = Exported(model.actor.eval(), environment), environment.observation_space
    boxes = [seen[name] for name in network.names] or [seen]
    is_bytes = [box.dtype == "uint8" for box in boxes]
    types = [torch.uint8 if each else torch.float32 for each in is_bytes]
    examples = tuple(
        torch.zeros(1, *box.shape, dtype=kind) for box, kind in zip(boxes, types, strict=True)
    )
    names = [*(network.names or ["observation"]), "action"]
    torch.onnx.export(
        network, examples, out, dynamo=False, opset_version=OPSET, input_names=names[:-1],
        output_names=names[-1:], dynamic_axes={name: {0: "batch"} for name in names},
    )  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environment", help="a gymnasium id")
    parser.add_argument("--algorithm", choices=["td3", "sac"], default="td3")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", required=True)
    asked = parser.parse_args()
    made = train(asked.environment, asked.algorithm, asked.steps, asked.seed)
    if asked.out.endswith(".zip"):
        made.save(asked.out)
    else:
        export(made, asked.out)
