"""Train the DAgger human model of section V, which imitates a human's actions."""

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from numpy.typing import NDArray

from bridge.report import ProgressBar
from edge_runtime.cli import INTERRUPTED, sigterm_as_interrupt
from edge_runtime.files import write_json
from edge_runtime.util import UserError
from trainer import util
from trainer.environments import check_trained_in, expert_of, make_environment
from trainer.human import FIELDS, MODEL_FILE, HumanModelConfig
from trainer.human.guide import Driver, HumanGuide, steps_held
from trainer.learner.networks import FRAMES_SPACE, Actor, tensors
from trainer.person import vector
from trainer.person.recording import find_recordings, read_episodes_of
from trainer.util import Purpose, claimed, episode_seed, load_torch, random_stream, save_torch

REFINING_PARTS = 20  # Steps in which the learning rate falls while a model is refined


class HumanModel(Driver):
    """A regression of the human's action on the picture (eq. 24 to 27).

    Until the first intervention it is an untrained policy network (eq. 25). Then it learns a little
    after each episode (eq. 27) from all of the human's steps so far: data aggregation.
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
        return len(self._actions)

    def act(self, observation: NDArray[Any]) -> NDArray[np.float32]:
        return self.actor.act(observation[None])[0]

    def add(self, observation: NDArray[Any], action: NDArray[np.float32]) -> None:
        frames = observation[-self.config.frames :] if self._pictures else observation
        self._observations.append(frames.copy())
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

    def refine(self, updates: int) -> None:
        """Learn on after the last episode; the learning rate falls, so that the model settles."""
        parts = min(updates, REFINING_PARTS)
        for part in range(parts):
            for group in self.optimiser.param_groups:
                group["lr"] = self.config.learning_rate * (1.0 - part / parts)
            each, rest = divmod(updates, parts)
            self.learn(each + (part < rest))

    def save(self, directory: Path, about: dict[str, Any]) -> None:
        """Write the model to ``directory``, with ``about``, a description of its training."""
        state = {
            "actor": self.actor.state_dict(),
            "frames": self.config.frames,
            "action_size": self.actor.head.output.out_features,
            "demonstrations": self.demonstrations,
            **about,
        }
        save_torch(directory / MODEL_FILE, state)


def load_human_model(directory: Path, env: Any) -> Actor:
    """Load the network of a HUMAN_DIR; UserError: it holds no human model of ``env``."""
    path = directory / MODEL_FILE
    state = load_torch(path)
    with util.fitting(f"{path} is not a human model of this project"):
        actor = Actor(state["action_size"], state["frames"], env.observation_space)
        check_trained_in(env, directory, state["scenario"])
        actor.load_state_dict(state["actor"])
    return actor


def run(arguments: argparse.Namespace) -> int:
    util.set_threads(arguments.threads)
    if arguments.recordings is not None and arguments.label_every_step:
        raise UserError("--label-every-step needs the scripted expert; recordings lack labels")
    config = HumanModelConfig(**{name: getattr(arguments, name) for name in FIELDS})
    directory = Path(arguments.out)
    with claimed(directory):
        if (directory / MODEL_FILE).exists():
            raise UserError(f"{directory} holds a human model; choose another --out")
        return _train(arguments, config, directory)


@sigterm_as_interrupt()
def _train(arguments: argparse.Namespace, config: HumanModelConfig, directory: Path) -> int:
    end_s = util.deadline_s(arguments.max_minutes)
    env = make_environment(arguments.scenario)
    about: dict[str, Any] = {"scenario": env.scenario, "seed": arguments.seed}
    model = HumanModel(config, arguments.seed, env.action_space.shape[0], env.observation_space)
    if arguments.recordings is None:
        losses = imitate(model, env, arguments.seed)
    else:
        recordings = find_recordings([Path(place) for place in arguments.recordings])
        taken_over = demonstrate(model, recordings, env)
        about |= {"recordings": [str(path) for path in recordings], "interventions": taken_over}
        # As many gradient steps as with the expert, but without episodes in between
        losses = (model.learn(config.updates_per_episode) for _ in range(config.episodes))
    status = 0
    try:
        with ProgressBar("human model", config.episodes) as bar:
            for loss in losses:
                bar.advance({"demonstrations": str(model.demonstrations), "loss": f"{loss:.3f}"})
                if time.monotonic() > end_s:
                    break
        # In proportion to the episodes: fewer have shown fewer examples.
        model.refine(config.refining_updates * bar.done // config.episodes)
    except KeyboardInterrupt:
        if not bar.done:
            raise
        status = INTERRUPTED
        print(f"interrupted after {bar.done} of {config.episodes} episodes", file=sys.stderr)
    about |= {"config": asdict(config), "episodes": bar.done}
    model.save(directory, about)
    write_json(directory / "human.json", about | {"demonstrations": model.demonstrations})
    print(f"human model from {model.demonstrations} demonstrated steps: {directory}")
    return status


def imitate(model: HumanModel, env: Any, seed: int) -> Iterator[float]:
    """Imitate the scripted expert, which takes over while the model drives.

    Yields the loss after each episode.
    """
    config = model.config
    # Three experts (driver, adviser, trigger), since each has a memory of its own.
    expert, adviser = expert_of(env), expert_of(env)
    guide = HumanGuide(expert, expert_of(env), steps_held(env.control_period_s))
    for episode in range(config.episodes):
        every = config.demonstrate_every
        demonstrated = every and episode % every == every - 1
        observation, _ = env.reset(seed=episode_seed(seed, Purpose.HUMAN_EPISODES, episode))
        guide.reset()
        adviser.reset()
        ended = False
        while not ended:
            action = model.act(observation)
            intervention = None if demonstrated else guide.watch(observation, action)
            if demonstrated or intervention is not None:
                action = expert.act(observation) if intervention is None else intervention.action
                model.add(observation, action)
            elif config.label_every_step:
                model.add(observation, adviser.act(observation))
            observation, _, terminated, truncated, _ = env.step(action)
            ended = terminated or truncated
        yield model.learn(config.updates_per_episode)


def demonstrate(model: HumanModel, recordings: Sequence[Path], env: Any) -> int:
    """Give the model every recorded step in which the person was in control; count take-overs.

    During a hand-over the model gets the hands' action, not the blend that was applied. An episode
    driven alone counts as a take-over. UserError: another scenario, or nobody drove.
    """
    interventions = 0
    for path in recordings:
        for episode in read_episodes_of(env, path):
            interventions += sum(step.first for step in episode)
            for step in episode:
                if step.control == "human":
                    model.add(step.observation, vector(step.human_action))
    if not model.demonstrations:
        raise UserError("nobody took over in these recordings: there is nothing to imitate")
    return interventions
