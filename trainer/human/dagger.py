"""Train the human model (section V): it drives, the person intervenes, and it learns (DAgger).

The person is the scripted expert, or a real one in recorded sittings.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from bridge.progress import ProgressBar
from edge_runtime.files import write_json
from edge_runtime.util import UserError
from trainer import options
from trainer.environments import expert_of, make_environment
from trainer.human.config import FIELDS, MODEL_FILE, HumanModelConfig
from trainer.human.guide import HumanGuide, steps_held
from trainer.human.model import REFINING_PARTS, HumanModel
from trainer.person.recording import demonstrate, find_recordings
from trainer.util import Purpose, claimed, episode_seed


def run(arguments: argparse.Namespace) -> int:
    """Train the model, showing progress; return the exit status."""
    options.set_threads(arguments.threads)
    if arguments.recordings is not None and arguments.label_every_step:
        raise UserError("--label-every-step asks the scripted expert; a recording holds no more")
    config = HumanModelConfig(**{name: getattr(arguments, name) for name in FIELDS})
    directory = Path(arguments.out)
    with claimed(directory):
        if (directory / MODEL_FILE).exists():
            raise UserError(f"{directory} holds a human model; choose another --out")
        _train(arguments, config, directory)
    return 0


def _train(arguments: argparse.Namespace, config: HumanModelConfig, directory: Path) -> None:
    end_s = options.deadline_s(arguments.max_minutes)
    env = make_environment(arguments.scenario)
    about: dict[str, Any] = {"scenario": env.scenario, "seed": arguments.seed}
    size, space = env.action_space.shape[0], env.observation_space
    model = HumanModel(config, arguments.seed, size, space)
    if arguments.recordings is None:
        episodes = imitate(model, env, arguments.seed)
    else:
        recordings = find_recordings([Path(place) for place in arguments.recordings])
        taken_over = demonstrate(model, recordings, env.scenario)
        about |= {"recordings": [str(path) for path in recordings], "interventions": taken_over}
        # As many gradient steps as with the expert, without the episodes between them.
        episodes = (
            HumanEpisode(model.learn(config.updates_per_episode), model.demonstrations)
            for _ in range(config.episodes)
        )
    with ProgressBar("human model", config.episodes) as bar:
        for episode in episodes:
            shown = {"demonstrations": str(episode.demonstrations), "loss": f"{episode.loss:.3f}"}
            if episode.outcome:
                shown |= {"interventions": str(episode.interventions), "outcome": episode.outcome}
            bar.advance(shown)
            if time.monotonic() > end_s:
                break
    if bar.done < config.episodes:
        print(f"the time is over after {bar.done} of {config.episodes} episodes", file=sys.stderr)
    # In proportion: part of the episodes have shown part of the examples, in part of the time.
    updates = config.refining_updates * bar.done // config.episodes
    if updates:
        with ProgressBar("refining", min(updates, REFINING_PARTS)) as refining:
            for loss in model.refine(updates):
                refining.advance({"loss": f"{loss:.3f}"})
    about["config"] = asdict(config)
    model.save(directory, about)
    amount = {"episodes": bar.done, "demonstrations": model.demonstrations}
    write_json(directory / "human.json", about | amount)
    print(f"human model from {model.demonstrations} demonstrated steps: {directory}")


class HumanEpisode(NamedTuple):
    """One episode of the human model's training."""

    loss: float
    demonstrations: int  # The human's steps so far
    interventions: int = 0
    outcome: str = ""  # Empty where nobody drove: the model learned from recordings


def imitate(model: HumanModel, env: Any, seed: int) -> Iterator[HumanEpisode]:
    """Imitate the scripted expert, which takes over while the model drives; yield each episode."""
    config = model.config
    # Three, as each has a memory: a person who takes over looks at the scene afresh.
    expert, adviser = expert_of(env), expert_of(env)
    guide = HumanGuide(expert, expert_of(env), steps_held(env.control_period_s))
    for episode in range(config.episodes):
        every = config.demonstrate_every
        demonstrated = every and episode % every == every - 1
        observation, info = env.reset(seed=episode_seed(seed, Purpose.HUMAN_EPISODES, episode))
        guide.reset()
        adviser.reset()
        interventions, ended = 0, False
        while not ended:
            action = model.act(observation)
            intervention = None if demonstrated else guide.watch(observation, action)
            if demonstrated or intervention is not None:
                action = expert.act(observation) if intervention is None else intervention.action
                model.add(observation, action)
            elif config.label_every_step:
                model.add(observation, adviser.act(observation))
            interventions += intervention is not None and intervention.first
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        loss = model.learn(config.updates_per_episode)
        yield HumanEpisode(loss, model.demonstrations, interventions, info["outcome"])
