"""Stable-Baselines3's TD3 as a peer. Run by a Python of its own; it imports nothing of ours.

    PYTHON -I sb3_td3.py THREADS BATCH_SIZE EXPERIENCE.npz

Plain TD3 with uniform replay, no human, no priorities, and the networks of tables A2 and A3. It
does less than the paper asks for: Stable-Baselines3 gives both critics one features extractor, so
two convolutional networks work in each pass where the paper's critics have two of their own beside
the actor's; and there is no Q advantage and no behaviour cloning. Protocol: ``peer_process.py``.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any, TextIO

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

FEATURES = 1792


class Trunk(BaseFeaturesExtractor):
    """The paper's two convolutions; the library normalises the pictures before."""

    def __init__(self, space: gymnasium.Space[Any]) -> None:
        super().__init__(space, FEATURES)
        self.layers = nn.Sequential(
            nn.Conv2d(2, 6, 6),
            nn.ReLU(),
            nn.MaxPool2d(2),
            nn.Conv2d(6, 16, 6),
            nn.ReLU(),
            nn.MaxPool2d(2),
            nn.Flatten(),
        )

    def forward(self, images: Tensor) -> Tensor:
        """Features [batch, 1792] of float images [batch, 2, 45, 80] in [0, 1]."""
        return self.layers(images)


class Shapes(gymnasium.Env[Any, Any]):
    """Tells the library the sizes; nobody drives in it."""

    observation_space = gymnasium.spaces.Box(0, 255, (2, 45, 80), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)


def make_model(experience: Any) -> TD3:
    """The model with its replay filled from an ``.npz`` of frames, actions and rewards."""
    count = len(experience["actions"])
    model = TD3(
        "CnnPolicy",
        Shapes(),
        learning_rate=2e-4,
        gamma=0.95,
        tau=1e-3,
        buffer_size=count,
        policy_delay=1,
        policy_kwargs={"features_extractor_class": Trunk, "net_arch": [256, 128, 64]},
        device="cpu",
        seed=0,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    frames, actions, rewards = (experience[name] for name in ("frames", "actions", "rewards"))
    assert model.replay_buffer is not None
    for i in range(count):
        model.replay_buffer.add(
            frames[i : i + 1],
            frames[i + 1 : i + 2],
            actions[i : i + 1],
            rewards[i : i + 1],
            np.zeros(1),
            [{}],
        )
    return model


def serve(model: TD3, batch_size: int, requests: TextIO, answers: TextIO) -> None:
    """Answer each line, a number of updates, with the milliseconds of each."""
    for line in requests:
        times_ms = []
        for _ in range(int(line)):
            began_s = time.perf_counter()
            model.train(gradient_steps=1, batch_size=batch_size)
            times_ms.append(1e3 * (time.perf_counter() - began_s))
        print(json.dumps(times_ms), file=answers, flush=True)


def main() -> None:
    """Greet and serve."""
    # The library may print; only answers may go to the bench.
    answers, sys.stdout = sys.stdout, sys.stderr
    torch.set_num_threads(int(sys.argv[1]))
    with np.load(sys.argv[3]) as experience:
        model = make_model({name: experience[name] for name in experience.files})
    greeting = {
        "stable_baselines3": stable_baselines3.__version__,
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "actor_parameters": sum(p.numel() for p in model.actor.parameters()),
        "critic_parameters": sum(p.numel() for p in model.critic.parameters()),
    }
    print(json.dumps(greeting), file=answers, flush=True)
    serve(model, int(sys.argv[2]), sys.stdin, answers)


if __name__ == "__main__":
    main()
