"""Train a policy with human guidance."""

from __future__ import annotations

import argparse
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bridge.network import parse_spec
from bridge.report import GOAL
from edge_runtime.cli import INTERRUPTED, examples, not_negative, positive
from edge_runtime.util import UserError, counted
from trainer.commands.options import add_latency, add_scenario, add_threads, set_threads
from trainer.commands.resuming import check_directory
from trainer.commands.settings import DEFAULTS, settings, with_setting
from trainer.commands.time_limit import add_time_limit, deadline_s
from trainer.learner.config import ALGORITHMS
from trainer.locks import claimed
from trainer.person.options import PERSON, add_person, check_no_person
from trainer.person.registry import HUMANS
from trainer.plots import write_learning_curve
from trainer.progress import ProgressBar
from trainer.signals import quit_on_signals
from trainer.training.config import PRESETS, RunConfig
from trainer.training.metrics import EpisodeMetrics, read_metrics, totals
from trainer.training.run import TrainingRun

EXAMPLE = examples(
    "python -m trainer train --scenario left_turn --steps 4000 --out runs/phil_1",
    "python -m trainer train --steps 8000 --out runs/phil_1 --resume",
    "python -m trainer train --human keyboard --rerun mine.rrd --out runs/mine",
    "python -m trainer train --scenario congestion --algorithm phil_td3 --seed 1 \\\n"
    "    --human runs/human_congestion --set batch_size=64 --max-minutes 30 --out runs/phil_2",
)

_STDERR = 2
_ENDING = b"ending after this episode; a second time: at once, back to the last checkpoint\n"


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
        "--steps",
        type=not_negative,
        default=DEFAULTS.steps,
        metavar="N",
        help="environment steps to train in all, if the episodes last so long; 0: no limit",
    )
    parser.add_argument(
        "--preset",
        choices=list(PRESETS),
        default="ours",
        help="settings to start from: this project's, or the paper's as they are printed",
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
    add_time_limit(parser, "stop after the episode that passes this time")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"change a setting: {', '.join(settings())}",
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
    with claimed(run_dir):
        check_directory(run_dir, config, arguments.resume)
        return _train(arguments, config, run_dir)


def _train(arguments: argparse.Namespace, config: RunConfig, run_dir: Path) -> int:
    sink = _sink(arguments.rerun)
    with _training(arguments, config, run_dir) as training:
        end_s = deadline_s(arguments)
        with (
            ProgressBar("training", *_extent(training)) as bar,
            _watched(training, sink) as watch,
            # The last: behind the first signal is what a viewer makes of them.
            quit_on_signals(partial(_quit, training)),
        ):
            training.train(_both(_Reporter(bar, bool(config.steps)), watch), end_s)
    if training.episode:  # a person may quit before the first
        write_learning_curve(run_dir)
    print(f"{_summary(run_dir)}: {run_dir}")
    if training.quitting and not training.over:
        print("interrupted; the same command with --resume goes on", file=sys.stderr)
        return INTERRUPTED
    return 0


def _summary(run_dir: Path) -> str:
    found = totals(read_metrics(run_dir))
    if not found:
        return "no episodes"
    parts = [
        counted(found["episodes"], "episode"),
        counted(found["steps"], "step"),
        counted(found["updates"], "update"),
        f"{counted(found['takeovers'], 'take-over')} with {counted(found['human_steps'], 'step')}",
        counted(sum(found["failures"].values()), "failure"),
    ]
    return ", ".join(parts)


def _extent(training: TrainingRun) -> tuple[int, int]:
    """What the progress bar counts to, and from: steps where they are limited, else episodes."""
    config = training.config
    if config.steps:
        return config.steps, training.steps
    return config.episodes, training.episode


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
        yield TrainingRun(config, run_dir, arguments.resume)


def _quit(training: TrainingRun) -> bool:
    heeded = training.quit()
    if training.quitting:
        # Not print: a signal may come in the midst of one, which takes no other. And whoever read
        # it, as `tee`, may have had the same ^C.
        with suppress(OSError):
            os.write(_STDERR, _ENDING)
    return heeded


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
    """Feeds the progress bar from the episodes' metrics: means over the last twenty.

    Args:
        bar: the progress bar.
        by_steps: whether it counts environment steps.
    """

    def __init__(self, bar: ProgressBar, by_steps: bool = False) -> None:
        self.bar, self.by_steps = bar, by_steps
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
            },
            metrics.steps if self.by_steps else 1,
        )


def _config(arguments: argparse.Namespace) -> RunConfig:
    config = replace(
        PRESETS[arguments.preset],
        scenario=arguments.scenario,
        algorithm=arguments.algorithm,
        seed=arguments.seed,
        episodes=arguments.episodes,
        steps=arguments.steps,
        human=PERSON if arguments.human in HUMANS else arguments.human,
        latency=str(parse_spec(arguments.latency)),
        device=arguments.device,
        threads=arguments.threads,
    )
    for assignment in arguments.set:
        config = with_setting(config, assignment)
    return config
