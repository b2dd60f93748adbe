"""Train a policy with human guidance: options, settings, and whether a run may begin or go on."""

from __future__ import annotations

import argparse
import difflib
import importlib
import math
import os
import sys
import textwrap
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bridge.network import parse_spec
from bridge.progress import ProgressBar
from bridge.report import GOAL
from edge_runtime.cli import INTERRUPTED, examples
from edge_runtime.util import UserError, counted
from trainer import options
from trainer.drivers import CHECKPOINT_FILE
from trainer.learner.config import ALGORITHMS, LearnerConfig
from trainer.person.interface import HUMANS, PERSON, add_person, check_person_options
from trainer.pictures import write_learning_curve
from trainer.training.config import PRESETS, RunConfig
from trainer.training.metrics import EpisodeMetrics, read_metrics, totals
from trainer.training.run import CONFIG_FILE, TrainingRun
from trainer.util import claimed, quit_on_signals

EXAMPLE = examples(
    "python -m trainer train --scenario left_turn --steps 4000 --out runs/phil_1",
    "python -m trainer train --steps 8000 --out runs/phil_1 --resume",
    "python -m trainer train --human keyboard --rerun mine.rrd --out runs/mine",
    "python -m trainer train --scenario congestion --algorithm phil_td3 --seed 1 \\\n"
    "    --human runs/human_congestion --set batch_size=64 --max-minutes 30 --out runs/phil_2",
    "python -m trainer train --set    # lists the settings",
)
DEFAULTS = RunConfig()
OPTIONS = ("scenario", "algorithm", "seed", "human", "latency", "device", "threads")
"""What an option of its own decides."""
EXTENT = ("episodes", "steps")
"""How long a run is: it may go on for longer."""
LEARNERS = tuple(field.name for field in fields(LearnerConfig))
OWN = tuple(
    field.name for field in fields(RunConfig) if field.name not in (*OPTIONS, *EXTENT, "learner")
)
"""The run's own settings for ``--set``, besides the learner's."""
EXPECTED = {bool: "true or false", int: "a whole number", float: "a number"}
_STDERR = 2
_ENDING = b"ending after this episode; a second time: at once, back to the last checkpoint\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    what = parser.add_argument_group("what is trained")
    options.add_scenario(what)
    what.add_argument(
        "--algorithm",
        choices=list(ALGORITHMS),
        default=DEFAULTS.algorithm,
        metavar="NAME",
        help=f"the learner: {', '.join(ALGORITHMS)}",
    )
    options.add_seed(what, "everything that is drawn at random")
    options.add_fields(what, DEFAULTS, *EXTENT)
    what.add_argument(
        "--preset",
        choices=list(PRESETS),
        default="ours",
        help="the settings to start from: this project's, or the paper's as they are printed",
    )
    what.add_argument(
        "--set",
        action=_Set,
        nargs="?",
        default=[],
        metavar="NAME=VALUE",
        help="change a setting, as often as you like; without a value: list all with their "
        "defaults and meanings",
    )
    options.add_latency(what, "the network between policy and vehicle, also in validation")
    guide = parser.add_argument_group("the human")
    guide.add_argument(
        "--human",
        default=DEFAULTS.human,
        metavar=f"expert|HUMAN_DIR|{'|'.join(HUMANS)}",
        help="the scripted expert, a model trained by `trainer human`, or you",
    )
    add_person(parser)
    how = parser.add_argument_group("the run")
    how.add_argument("--out", required=True, metavar="RUN_DIR", help="the directory of the run")
    how.add_argument("--resume", action="store_true", help="go on from RUN_DIR's checkpoint")
    options.add_time_limit(how, "stop after the episode that passes this time")
    how.add_argument(
        "--device", choices=["cpu", "cuda"], default="cpu", help="where the learner computes"
    )
    options.add_threads(how)
    how.add_argument(
        "--rerun",
        metavar="spawn|serve|F.rrd",
        help="show the run in rerun: in a window, on a page on this machine, or into a file",
    )


def run(arguments: argparse.Namespace) -> int:
    """Train, showing progress; returns the exit status."""
    if arguments.device == "cuda" and not torch.cuda.is_available():
        raise UserError("no CUDA device is available; use --device cpu")
    options.set_threads(arguments.threads)
    human = arguments.human
    if human != DEFAULTS.human and human not in HUMANS and not Path(human).exists():
        known = ", ".join([DEFAULTS.human, *HUMANS])
        raise UserError(f"--human {human} is none of {known}, nor a human model's directory")
    given = {name: getattr(arguments, name) for name in (*OPTIONS, *EXTENT)}
    given["human"] = PERSON if human in HUMANS else human
    given["latency"] = str(parse_spec(arguments.latency))
    config = replace(PRESETS[arguments.preset], **given)
    for assignment in arguments.set:
        config = with_setting(config, assignment)
    run_dir = Path(arguments.out)
    with claimed(run_dir):
        check_directory(run_dir, config, arguments.resume)
        return _train(arguments, config, run_dir)


def _train(arguments: argparse.Namespace, config: RunConfig, run_dir: Path) -> int:
    view: Any = None
    if arguments.rerun is not None:
        view = importlib.import_module("trainer.view")
        sink = view.check_word(arguments.rerun)
    with ExitStack() as stack:
        training: TrainingRun
        if arguments.human in HUMANS:
            from trainer.person.run import training_with_person

            training = stack.enter_context(training_with_person(arguments, config, run_dir))
        else:
            check_person_options(arguments)
            training = TrainingRun(config, run_dir, arguments.resume)
        end_s = options.deadline_s(arguments)
        extent = (
            (config.steps, training.steps) if config.steps else (config.episodes, training.episode)
        )
        bar = stack.enter_context(ProgressBar("training", *extent))
        watch = stack.enter_context(view.watched(training, sink)) if view else None
        # The last: behind the first signal is what a viewer makes of them.
        stack.enter_context(quit_on_signals(partial(_quit, training)))
        recent: deque[EpisodeMetrics] = deque(maxlen=20)
        validation = "-"

        def on_episode(metrics: EpisodeMetrics) -> None:
            nonlocal validation
            recent.append(metrics)
            if not math.isnan(metrics.validation_success):
                validation = f"{metrics.validation_success:.2f}"
            count = len(recent)
            figures = {
                "return": f"{sum(m.episode_return for m in recent) / count:.1f}",
                "distance": f"{sum(m.distance_m for m in recent) / count:.1f} m",
                "success": f"{sum(m.outcome == GOAL for m in recent) / count:.2f}",
                "validation": validation,
            }
            bar.advance(figures, metrics.steps if config.steps else 1)
            if watch:
                watch(metrics)

        training.train(on_episode, end_s)
    if training.episode:  # a person may quit before the first
        write_learning_curve(run_dir)
    print(f"{_summary(run_dir)}: {run_dir}")
    if training.quitting and not training.over:
        print("interrupted; the same command with --resume goes on", file=sys.stderr)
        return INTERRUPTED
    return 0


def _quit(training: TrainingRun) -> bool:
    heeded = training.quit()
    if training.quitting:
        # Not print: a signal may come in the midst of one, which takes no other. And the reader,
        # such as `tee`, may have had the same ^C.
        with suppress(OSError):
            os.write(_STDERR, _ENDING)
    return heeded


def _summary(run_dir: Path) -> str:
    found = totals(read_metrics(run_dir))
    if not found:
        return "no episodes"
    amounts = [counted(found[f"{name}s"], name) for name in ("episode", "step", "update")]
    steps = counted(found["human_steps"], "step")
    human = f"{counted(found['takeovers'], 'take-over')} with {steps}"
    return ", ".join([*amounts, human, counted(sum(found["failures"].values()), "failure")])


class _Set(argparse.Action):
    """``--set NAME=VALUE``, collected; ``--set`` alone lists the settings, as --help does options.

    Other options need not be there for that.
    """

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: Any, value: Any, option: str | None = None
    ) -> None:
        if value is None:
            print("\n".join(setting_lines()))
            parser.exit()
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), value])


def settings() -> dict[str, Any]:
    """Every setting that ``--set`` may change, with its default."""
    own = {name: getattr(DEFAULTS, name) for name in OWN}
    return own | {name: getattr(DEFAULTS.learner, name) for name in LEARNERS}


def setting_lines() -> Iterator[str]:
    """Every setting as it is typed by default, and what it means."""
    said = options.meanings(RunConfig) | options.meanings(LearnerConfig)
    for name, default in settings().items():
        typed = str(default).lower() if isinstance(default, bool) else str(default)
        begin, indent = f"  {f'{name}={typed}':<33} ", 36 * " "
        yield textwrap.fill(said.get(name, ""), 98, initial_indent=begin, subsequent_indent=indent)


def with_setting(config: RunConfig, assignment: str) -> RunConfig:
    """The config with one NAME=VALUE.

    Raises:
        UserError: no such setting, or no such value of it.
    """
    name, given, text = assignment.partition("=")
    if not given:
        raise UserError(f"--set {assignment}: expected NAME=VALUE")
    known = settings()
    if name not in known:
        near = difflib.get_close_matches(name, known, 1)
        guess = f"did you mean {near[0]}?" if near else "--set alone lists them"
        raise UserError(f"--set {assignment}: there is no setting {name!r}; {guess}")
    kind = type(known[name])
    try:
        value: Any = {"true": True, "false": False}[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        raise UserError(f"--set {assignment}: expected {EXPECTED[kind]}, got {text!r}") from None
    if name in LEARNERS:
        return replace(config, learner=replace(config.learner, **{name: value}))
    return replace(config, **{name: value})


def check_directory(run_dir: Path, config: RunConfig, resume: bool) -> None:
    """Refuse to overwrite a run, or to resume one under other settings; raises UserError."""
    started = (run_dir / CHECKPOINT_FILE).is_file()
    if started and not resume:
        raise UserError(f"{run_dir} holds a run; add --resume, or choose another --out")
    if resume and not started:
        raise UserError(f"{run_dir} holds no checkpoint to resume from")
    if resume:
        _check_settings(run_dir, config)


def _check_settings(run_dir: Path, config: RunConfig) -> None:
    path = run_dir / CONFIG_FILE
    saved, wanted = _flat(options.read_json(path, "run config")), _flat(config.as_dict())
    if not all(isinstance(saved.get(name), int) for name in EXTENT):
        raise UserError(f"run config {path} does not say how many episodes and steps")
    changed = []
    for name in wanted:
        if name not in EXTENT and (name not in saved or saved[name] != wanted[name]):
            option = f"--{name} " if name in OPTIONS else f"--set {name}="
            before = f"{option}{_typed(name, saved)}" if name in saved else f"no {name}"
            changed.append(f"{before} (now {_typed(name, wanted)})")
    if changed:
        raise UserError(f"{run_dir} was trained with {', '.join(changed)}: repeat what it had")
    for name in EXTENT:
        if 0 < wanted[name] < saved[name]:
            raise UserError(f"{run_dir} is a run of {saved[name]} {name}, not fewer")


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    """A config's settings by their names, those of the learner among them."""
    learner = values.get("learner")
    own = {name: value for name, value in values.items() if name != "learner"}
    return {**own, **learner} if isinstance(learner, dict) else own


def _typed(name: str, values: dict[str, Any]) -> str:
    # A run may go on with another device of the person's.
    return "|".join(HUMANS) if (name, values[name]) == ("human", PERSON) else str(values[name])
