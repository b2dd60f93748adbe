"""Train a policy with human guidance."""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch

from edge_runtime.cli import examples
from edge_runtime.episode_report import GOAL
from edge_runtime.errors import UserError
from edge_runtime.latency.model import parse_spec
from trainer.commands.options import (
    add_latency,
    add_scenario,
    add_threads,
    not_negative,
    positive,
    positive_float,
    read_json,
    set_threads,
)
from trainer.drivers import CHECKPOINT_FILE
from trainer.files import make_directory
from trainer.learner.algorithms import ALGORITHMS
from trainer.learner.config import LearnerConfig
from trainer.person.options import PERSON, add_person, check_no_person
from trainer.person.registry import HUMANS
from trainer.plots import write_learning_curve
from trainer.progress import ProgressBar
from trainer.training.config import RunConfig
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import CONFIG_FILE, TrainingRun

EXAMPLE = examples(
    "python -m trainer train --scenario left_turn --episodes 120 --out runs/phil_1",
    "python -m trainer train --episodes 240 --out runs/phil_1 --resume",
    "python -m trainer train --human keyboard --rerun mine.rrd --out runs/mine",
    "python -m trainer train --scenario congestion --algorithm phil_td3 --seed 1 \\\n"
    "    --human runs/human_congestion --set batch_size=64 --max-minutes 30 --out runs/phil_2",
)
DEFAULTS = RunConfig()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_scenario(parser)
    parser.add_argument(
        "--algorithm", choices=list(ALGORITHMS), default=DEFAULTS.algorithm, help="which learner"
    )
    parser.add_argument("--seed", type=not_negative, default=DEFAULTS.seed, help="of everything")
    parser.add_argument(
        "--episodes", type=positive, default=DEFAULTS.episodes, help="episodes to train in all"
    )
    parser.add_argument(
        "--human",
        default=DEFAULTS.human,
        metavar=f"expert|HUMAN_DIR|{'|'.join(HUMANS)}",
        help="who guides: the scripted expert, a model trained by `trainer human`, or you",
    )
    add_person(parser)
    parser.add_argument("--out", required=True, metavar="RUN_DIR", help="directory of the run")
    parser.add_argument("--resume", action="store_true", help="go on from RUN_DIR's checkpoint")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="learner's device")
    add_latency(parser, "network between policy and vehicle, also in validation")
    parser.add_argument(
        "--max-minutes",
        type=positive_float,
        default=None,
        metavar="MIN",
        help="stop after the episode that passes this time (default: no limit)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"change a setting: {', '.join(_settings())}",
    )
    parser.add_argument(
        "--rerun",
        metavar="spawn|serve|F.rrd",
        help="show the run in rerun: in a window, on a page on this machine, or into a file",
    )
    add_threads(parser)


def run(arguments: argparse.Namespace) -> int:
    """Train, showing progress; returns the exit status."""
    if arguments.device == "cuda" and not torch.cuda.is_available():
        raise UserError("no CUDA device is available; use --device cpu")
    set_threads(arguments.threads)
    _check_human(arguments.human)
    config = _config(arguments)
    run_dir = Path(arguments.out)
    _check_directory(run_dir, config, arguments.resume)
    sink = _sink(arguments.rerun)
    with _training(arguments, config, run_dir) as training:
        deadline_s = (
            time.monotonic() + 60.0 * arguments.max_minutes if arguments.max_minutes else None
        )
        with (
            ProgressBar("training", config.episodes, training.episode) as bar,
            _watched(training, sink) as watch,
        ):
            training.train(_both(_Reporter(bar), watch), deadline_s)
    if training.episode:  # a person may quit before the first
        write_learning_curve(run_dir)
    print(f"{training.episode} episodes, {training.learning.added} steps: {run_dir}")
    return 0


def _check_human(human: str) -> None:
    if human != DEFAULTS.human and human not in HUMANS and not Path(human).exists():
        words = ", ".join([DEFAULTS.human, *HUMANS])
        raise UserError(f"--human {human} is none of {words}, nor a human model's directory")


@contextmanager
def _training(
    arguments: argparse.Namespace, config: RunConfig, run_dir: Path
) -> Iterator[TrainingRun]:
    """The run, and the person in it where one guides."""
    if arguments.human in HUMANS:
        from trainer.person.command import training_with_person

        with training_with_person(arguments, config, run_dir) as guided:
            yield guided
    else:
        check_no_person(arguments)
        training = TrainingRun(config, run_dir, arguments.resume)
        make_directory(run_dir)
        yield training


def _sink(word: str | None) -> Any:
    """Where ``--rerun`` shows the run; None, and nothing imported, where it is not asked for."""
    if word is None:
        return None
    from trainer.viewer.command import check_word

    return check_word(word)


@contextmanager
def _watched(training: TrainingRun, sink: Any) -> Iterator[Callable[[EpisodeMetrics], None] | None]:
    if sink is None:
        yield None
        return
    from trainer.viewer.command import watched

    with watched(training, sink) as on_episode:
        yield on_episode


def _both(
    first: Callable[[EpisodeMetrics], None], second: Callable[[EpisodeMetrics], None] | None
) -> Callable[[EpisodeMetrics], None]:
    def on_episode(metrics: EpisodeMetrics) -> None:
        first(metrics)
        if second is not None:
            second(metrics)

    return on_episode


class _Reporter:
    """Feeds the progress bar from the episodes' metrics: means over the last twenty."""

    def __init__(self, bar: ProgressBar) -> None:
        self.bar = bar
        self.recent: deque[EpisodeMetrics] = deque(maxlen=20)
        self.validation = "-"

    def __call__(self, metrics: EpisodeMetrics) -> None:
        self.recent.append(metrics)
        if metrics.validation_success == metrics.validation_success:
            self.validation = f"{metrics.validation_success:.2f}"
        count = len(self.recent)
        self.bar.advance(
            {
                "return": f"{sum(m.episode_return for m in self.recent) / count:.1f}",
                "distance": f"{sum(m.distance_m for m in self.recent) / count:.1f} m",
                "success": f"{sum(m.outcome == GOAL for m in self.recent) / count:.2f}",
                "validation": self.validation,
            }
        )


def _config(arguments: argparse.Namespace) -> RunConfig:
    config = RunConfig(
        scenario=arguments.scenario,
        algorithm=arguments.algorithm,
        seed=arguments.seed,
        episodes=arguments.episodes,
        human=PERSON if arguments.human in HUMANS else arguments.human,
        latency=str(parse_spec(arguments.latency)),
        device=arguments.device,
        threads=arguments.threads,
    )
    for assignment in arguments.set:
        config = _with_setting(config, assignment)
    return config


def _settings() -> dict[str, Any]:
    """Every setting that ``--set`` may change, with its default."""
    run = ("guided_share", "penalise_stuck", "poor_guidance_share", "evaluate_every")
    own = {name: getattr(DEFAULTS, name) for name in (*run, "evaluation_runs", "checkpoint_every")}
    return own | {f.name: getattr(DEFAULTS.learner, f.name) for f in fields(LearnerConfig)}


def _with_setting(config: RunConfig, assignment: str) -> RunConfig:
    name, _, text = assignment.partition("=")
    settings = _settings()
    if name not in settings:
        raise UserError(f"--set {assignment}: no setting {name!r}; there is {', '.join(settings)}")
    kind = type(settings[name])
    try:
        value: Any = {"true": True, "false": False}[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        raise UserError(f"--set {assignment}: {text!r} is no {kind.__name__}") from None
    if name in {f.name for f in fields(LearnerConfig)}:
        return replace(config, learner=replace(config.learner, **{name: value}))
    return replace(config, **{name: value})


def _check_directory(run_dir: Path, config: RunConfig, resume: bool) -> None:
    """Refuse to overwrite a run, or to resume one under other settings."""
    started = (run_dir / CHECKPOINT_FILE).is_file()
    if started and not resume:
        raise UserError(f"{run_dir} holds a run; add --resume, or choose another --out")
    if resume and not started:
        raise UserError(f"{run_dir} holds no checkpoint to resume from")
    if resume:
        # A config of before the network has no field for it.
        saved = {"latency": DEFAULTS.latency, **read_json(run_dir / CONFIG_FILE, "run config")}
        wanted = config.as_dict()
        changed = [key for key in wanted if key != "episodes" and saved.get(key) != wanted[key]]
        if changed:
            raise UserError(f"{run_dir} was trained with another {', '.join(changed)}")
        if config.episodes < saved["episodes"]:
            raise UserError(f"{run_dir} is a run of {saved['episodes']} episodes, not fewer")
