"""Train the human model (section V): it drives, the person intervenes, and it learns (DAgger).

The person is the scripted expert, or a real one in recorded sittings.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, NamedTuple

from bridge.progress import ProgressBar
from edge_runtime.cli import examples
from edge_runtime.files import write_json
from edge_runtime.util import UserError
from trainer import options
from trainer.drivers import EXPERTS, TRIGGERS, make_environment
from trainer.human.guide import HumanGuide
from trainer.human.model import MODEL_FILE, REFINING_PARTS, HumanModel, HumanModelConfig
from trainer.person.recording import demonstrate, find_recordings
from trainer.util import Purpose, claimed, episode_seed

EXAMPLE = examples(
    "python -m trainer human --scenario left_turn --out runs/human",
    "python -m trainer human --scenario congestion --frames 2 --out runs/human_congestion",
    "python -m trainer human --from runs/drives --out runs/me",
)
FIXED = ("learning_rate", "batch_size")
FIELDS = [field.name for field in fields(HumanModelConfig) if field.name not in FIXED]
"""Settings that are options."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    options.add_scenario(parser)
    parser.add_argument(
        "--out", required=True, metavar="HUMAN_DIR", help="the directory of the model"
    )
    options.add_seed(parser, "everything that is drawn at random")
    options.add_fields(parser, HumanModelConfig(), *FIELDS)
    parser.add_argument(
        "--from",
        dest="recordings",
        nargs="+",
        metavar="RECORDING",
        help="imitate a person: recordings of `trainer drive` or of `trainer train` with a person, "
        "their directories, or such a training run (default: the scripted expert)",
    )
    parser.add_argument(
        "--leave-out",
        nargs="+",
        type=_place,
        default=(),
        metavar="SITTING[:EPISODE]",
        help="what is not to be imitated of --from: 3 is sitting-0003.mcap, 3:7 its episode 7, as "
        "the window shows it; an episode that was discarded at the wheel is left out anyway "
        "(default: nothing)",
    )
    options.add_time_limit(
        parser,
        "begin no episode after this time; the refining steps shrink in proportion to the episodes",
    )
    options.add_threads(parser)


def _place(word: str) -> str:
    """A sitting's number, or that and an episode's."""
    if not re.fullmatch(r"[0-9]+(:[0-9]+)?", word):
        raise argparse.ArgumentTypeError(f"{word!r} is no SITTING or SITTING:EPISODE, as 3 or 3:7")
    return ":".join(str(int(number)) for number in word.split(":"))


def run(arguments: argparse.Namespace) -> int:
    """Train the model, showing progress; returns the exit status."""
    options.set_threads(arguments.threads)
    scripted = arguments.recordings is None
    if not scripted and (arguments.label_every_step or arguments.unaided_share):
        raise UserError(
            "--label-every-step and --unaided-share ask the scripted expert; "
            "a recording holds no more"
        )
    if scripted and arguments.leave_out:
        raise UserError("--leave-out names recorded episodes: it goes with --from")
    config = HumanModelConfig(**{name: getattr(arguments, name) for name in FIELDS})
    directory = Path(arguments.out)
    with claimed(directory):
        if (directory / MODEL_FILE).exists():
            raise UserError(f"{directory} holds a human model; choose another --out")
        _train(arguments, config, directory)
    return 0


def _train(arguments: argparse.Namespace, config: HumanModelConfig, directory: Path) -> None:
    end_s = options.deadline_s(arguments)
    about: dict[str, Any] = {"scenario": arguments.scenario, "seed": arguments.seed}
    if arguments.recordings is None:
        training = HumanTraining(make_environment(arguments.scenario), config, arguments.seed)
        model, episodes = training.model, training.episodes()
    else:
        recordings = find_recordings([Path(place) for place in arguments.recordings])
        model = HumanModel(config, arguments.seed)
        taken_over = demonstrate(model, recordings, arguments.scenario, arguments.leave_out)
        about |= {"recordings": [str(path) for path in recordings], "interventions": taken_over}
        # As many gradient steps as with the expert: in place of an episode, those that follow one.
        episodes = (
            HumanEpisode(model.learn(config.updates_per_episode), model.demonstrations)
            for _ in range(config.episodes)
        )
    with ProgressBar("human model", config.episodes) as bar:
        for episode in options.until(end_s, episodes):
            bar.advance(episode.figures())
    if bar.done < config.episodes:
        print(f"the time is over after {bar.done} of {config.episodes} episodes", file=sys.stderr)
    # In proportion: a part of the episodes has shown a part of the examples, in a part of the time.
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
    demonstrations: int
    """The human's steps so far."""
    interventions: int = 0
    outcome: str = ""
    """Empty where nobody drove: the model learned from recordings."""

    def figures(self) -> dict[str, str]:
        """What the progress bar shows."""
        shown = {"demonstrations": f"{self.demonstrations}", "loss": f"{self.loss:.3f}"}
        if self.outcome:
            shown |= {"interventions": f"{self.interventions}", "outcome": self.outcome}
        return shown


class HumanTraining:
    """Online, incremental imitation of the scripted expert, which takes over while it drives."""

    def __init__(self, env: Any, config: HumanModelConfig, seed: int) -> None:
        self.env, self.config, self.seed = env, config, seed
        self.expert = EXPERTS[env.scenario](env)
        # With a memory of its own: a person who takes over looks at the scene afresh.
        self.adviser = EXPERTS[env.scenario](env)
        self.guide = HumanGuide(self.expert, TRIGGERS[env.scenario](self.expert))
        self.model = HumanModel(config, seed, env.action_space.shape[0])

    def episodes(self) -> Iterator[HumanEpisode]:
        """Drive and learn, episode by episode."""
        for episode in range(self.config.episodes):
            interventions, outcome = self._drive(episode)
            loss = self.model.learn(self.config.updates_per_episode)
            yield HumanEpisode(loss, self.model.demonstrations, interventions, outcome)

    def _drive(self, episode: int) -> tuple[int, str]:
        """One episode; the number of take-overs, and the outcome."""
        c = self.config
        # One episode in so many; with a share of 0 none is.
        demonstrated = c.demonstrated_share and episode % c.demonstrated_share == (
            c.demonstrated_share - 1
        )
        unaided = c.unaided_share and episode % c.unaided_share == 0
        seed = episode_seed(self.seed, Purpose.HUMAN_EPISODES, episode)
        observation, info = self.env.reset(seed=seed)
        self.guide.reset()
        self.adviser.reset()
        interventions, ended = 0, False
        while not ended:
            action = self.model.act(observation)
            watched = not (demonstrated or unaided)
            intervention = self.guide.watch(observation, action) if watched else None
            if demonstrated or intervention is not None:
                action = (
                    self.expert.act(observation) if intervention is None else intervention.action
                )
                self.model.add(observation, action)
            elif c.label_every_step:
                self.model.add(observation, self.adviser.act(observation))
            interventions += intervention is not None and intervention.first
            observation, _, terminated, truncated, info = self.env.step(action)
            ended = terminated or truncated
        return interventions, info["outcome"]
