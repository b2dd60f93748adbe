"""Train the DAgger human model from interventions."""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge_runtime.cli import examples
from edge_runtime.files import write_json_out
from edge_runtime.util import UserError
from trainer.drivers import make_environment
from trainer.human.dagger import HumanTraining
from trainer.human.model import MODEL_FILE, HumanModel, HumanModelConfig, refining_parts
from trainer.options import (
    add_fields,
    add_scenario,
    add_seed,
    add_threads,
    add_time_limit,
    deadline_s,
    set_threads,
    until,
)
from trainer.person.recording import demonstrate, find_recordings
from trainer.util import ProgressBar, claimed

EXAMPLE = examples(
    "python -m trainer human --scenario left_turn --out runs/human",
    "python -m trainer human --scenario congestion --frames 2 --out runs/human_congestion",
    "python -m trainer human --from runs/drives --out runs/me",
)
DEFAULTS = HumanModelConfig()
FIELDS = (
    "episodes",
    "frames",
    "updates_per_episode",
    "demonstrated_share",
    "label_every_step",
    "unaided_share",
    "refining_updates",
)
"""Settings that are options."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_scenario(parser)
    parser.add_argument(
        "--out", required=True, metavar="HUMAN_DIR", help="the directory of the model"
    )
    add_seed(parser, "everything that is drawn at random")
    add_fields(parser, DEFAULTS, *FIELDS)
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
        metavar="SITTING[:EPISODE]",
        help="what is not to be imitated of --from: 3 is sitting-0003.mcap, 3:7 its episode 7, as "
        "the window shows it; an episode that was discarded at the wheel is left out anyway",
    )
    add_time_limit(
        parser,
        "begin no episode after this time; the refining steps shrink in proportion to the episodes",
    )
    add_threads(parser)


def _place(word: str) -> str:
    """A sitting's number, or that and an episode's."""
    if not re.fullmatch(r"[0-9]+(:[0-9]+)?", word):
        raise argparse.ArgumentTypeError(f"{word!r} is no SITTING or SITTING:EPISODE, as 3 or 3:7")
    return ":".join(str(int(number)) for number in word.split(":"))


def run(arguments: argparse.Namespace) -> int:
    """Train the model, showing progress; returns the exit status."""
    set_threads(arguments.threads)
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
    from_whom = _from_expert if arguments.recordings is None else _from_person
    model, about, episodes = from_whom(arguments, config, deadline_s(arguments))
    if episodes < config.episodes:
        print(f"the time is over after {episodes} of {config.episodes} episodes", file=sys.stderr)
    # In proportion: a part of the episodes has shown a part of the examples, in a part of the time.
    updates = config.refining_updates * episodes // config.episodes
    if updates:
        with ProgressBar("refining", refining_parts(updates)) as bar:
            for loss in model.refine(updates):
                bar.advance({"loss": f"{loss:.3f}"})
    about = {"scenario": arguments.scenario, "seed": arguments.seed, **about}
    model.save(directory, {**about, "config": asdict(config)})
    report = {
        **about,
        "config": asdict(config),
        "episodes": episodes,
        "demonstrations": model.demonstrations,
    }
    write_json_out(str(directory / "human.json"), report)
    print(f"human model from {model.demonstrations} demonstrated steps: {directory}")


def _from_expert(
    arguments: argparse.Namespace, config: HumanModelConfig, end_s: float
) -> tuple[HumanModel, dict[str, Any], int]:
    """A model of the scripted expert, who takes over while it drives; and in how many episodes."""
    training = HumanTraining(make_environment(arguments.scenario), config, arguments.seed)
    with ProgressBar("human model", config.episodes) as bar:
        for episode in until(end_s, training.episodes()):
            bar.advance(
                {
                    "demonstrations": str(episode.demonstrations),
                    "interventions": str(episode.interventions),
                    "loss": f"{episode.loss:.3f}",
                    "outcome": episode.outcome,
                }
            )
    return training.model, {}, bar.done


def _from_person(
    arguments: argparse.Namespace, config: HumanModelConfig, end_s: float
) -> tuple[HumanModel, dict[str, Any], int]:
    """A model of a person, from recordings: as many gradient steps as with the expert.

    An episode is as many of them as follow one of the expert's.
    """
    recordings = find_recordings([Path(place) for place in arguments.recordings])
    model = HumanModel(config, arguments.seed)
    interventions = demonstrate(model, recordings, arguments.scenario, arguments.leave_out or ())
    with ProgressBar("human model", config.episodes) as bar:
        for _ in until(end_s, range(config.episodes)):
            loss = model.learn(config.updates_per_episode)
            bar.advance({"demonstrations": str(model.demonstrations), "loss": f"{loss:.3f}"})
    about = {"recordings": [str(path) for path in recordings], "interventions": interventions}
    return model, about, bar.done
