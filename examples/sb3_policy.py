"""Train a policy of Stable-Baselines3, and save the library's own file for `deploy policy`.

Call ``python examples/sb3_policy.py Pendulum-v1 --steps 6000 --out td3.zip``.
"""

import argparse
from typing import Any

import gymnasium
import highway_env  # noqa: F401  (it registers its environments)
from stable_baselines3 import SAC, TD3, HerReplayBuffer


def train(name: str, algorithm: str, steps: int, seed: int) -> Any:
    """Train a model, with hindsight replay if the observation is a Dict with a goal."""
    environment = gymnasium.make(name)
    space = environment.observation_space
    options: dict[str, Any] = {"policy": "MlpPolicy", "learning_rate": 1e-3, "seed": seed}
    if isinstance(space, gymnasium.spaces.Dict):
        options |= {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer}
        options |= {"gamma": 0.95, "tau": 0.05, "learning_starts": 1000}
    elif space.dtype == "uint8" and len(space.shape or ()) == 3:  # Pictures
        options |= {"policy": "CnnPolicy", "buffer_size": 10_000, "learning_rate": 3e-4}
    kind = {"td3": TD3, "sac": SAC}[algorithm]
    return kind(env=environment, device="cpu", **options).learn(steps)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environment", help="a gymnasium id")
    parser.add_argument("--algorithm", choices=["td3", "sac"], default="td3")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", required=True, metavar="MODEL.zip")
    args = parser.parse_args()
    train(args.environment, args.algorithm, args.steps, args.seed).save(args.out)
