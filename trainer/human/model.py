"""The DAgger human model of section V, which imitates the human's actions so far."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from numpy.typing import NDArray

from trainer import util
from trainer.environments import check_trained_in
from trainer.human.config import MODEL_FILE, HumanModelConfig
from trainer.human.guide import Driver
from trainer.learner.networks import FRAMES_SPACE, Actor, tensors
from trainer.util import Purpose, load_torch, random_stream, save_torch

REFINING_PARTS = 20  # Steps in which the learning rate falls while a model is refined


class HumanModel(Driver):
    """A regression of the human's action on the picture (eq. 24 to 27).

    Until the first intervention it is an untrained policy network (eq. 25, with table A4's one
    frame), and ``learn`` does nothing. Then it learns a little after each episode (eq. 27) from all
    of the human's steps so far: data aggregation.
    """

    def __init__(
        self,
        config: HumanModelConfig,
        seed: int,
        action_size: int = 1,
        space: Space[Any] = FRAMES_SPACE,
    ) -> None:
        self.config, self._pictures = config, space.shape == FRAMES_SPACE.shape
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.actor = Actor(action_size, config.frames, space)
        self.optimiser = torch.optim.Adam(self.actor.parameters(), config.learning_rate)
        self.random = random_stream(seed, Purpose.HUMAN_BATCHES)
        self._observations: list[NDArray[Any]] = []
        self._actions: list[NDArray[np.float32]] = []

    @property
    def demonstrations(self) -> int:
        """Number of the human's steps that it has seen."""
        return len(self._actions)

    def act(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        """Predict the human's action, float32 [action size]."""
        return self.actor.act(observation[None])[0]

    def add(self, observation: NDArray[Any], action: NDArray[np.float32]) -> None:
        """Add one step of the human's to the data."""
        seen = observation[-self.config.frames :] if self._pictures else observation
        self._observations.append(seen.copy())
        self._actions.append(np.asarray(action, dtype=np.float32))

    def learn(self, updates: int) -> float:
        """Take gradient steps on eq. 26; return the last loss (nan without demonstrations)."""
        if not self._actions:
            return float("nan")
        observations, actions = np.stack(self._observations), np.stack(self._actions)
        loss = torch.tensor(float("nan"))
        for _ in range(updates):
            rows = self.random.integers(len(actions), size=self.config.batch_size)
            predicted = self.actor(*tensors(observations[rows]))
            loss = (torch.from_numpy(actions[rows]) - predicted).square().sum(dim=1).mean()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
        return loss.item()

    def refine(self, updates: int) -> Iterator[float]:
        """Learn on after the last episode, part by part; yield each part's loss.

        The learning rate falls linearly from part to part, so that the model settles.
        """
        parts = min(updates, REFINING_PARTS)
        for part in range(parts):
            for group in self.optimiser.param_groups:
                group["lr"] = self.config.learning_rate * (1.0 - part / parts)
            each, rest = divmod(updates, parts)
            yield self.learn(each + (part < rest))

    def save(self, directory: Path, about: dict[str, Any]) -> None:
        """Write the model to ``directory``, with ``about``, which says on what it was trained."""
        state = {
            "actor": self.actor.state_dict(),
            "frames": self.config.frames,
            "action_size": self.actor.head.output.out_features,
            "demonstrations": self.demonstrations,
            **about,
        }
        save_torch(directory / MODEL_FILE, state)


def load_human_model(directory: Path, env: Any) -> tuple[Actor, dict[str, Any]]:
    """Load a HUMAN_DIR: its network and all else that it holds.

    Raises UserError: it holds no human model of ``env``.
    """
    path = directory / MODEL_FILE
    state = load_torch(path)
    with util.fitting(f"{path} is not a human model of this project"):
        actor = Actor(state["action_size"], state["frames"], env.observation_space)
        check_trained_in(env, directory, state["scenario"])
        actor.load_state_dict(state.pop("actor"))
    return actor, state
