"""Run the command ``train``, or `train` in Python: check the options, train, print a summary."""

import argparse
import io
import math
import os
import re
import signal
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, as_completed
from contextlib import ExitStack, closing, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from multiprocessing import active_children
from os import PathLike
from pathlib import Path
from statistics import fmean
from typing import Any

import pandas as pd

from bridge.environments import say_once
from bridge.outcomes import is_told, success_estimate, success_share
from bridge.report import ProgressBar
from edge_runtime.cli import BAD_INPUT, INTERRUPTED, quit_on_signals
from edge_runtime.util import UserError, counted, name_in_file, read_json
from trainer import util
from trainer.environments import scenario_of
from trainer.evaluation import CHECKPOINT_FILE, located
from trainer.human.guide import Record
from trainer.learner.config import find_algorithm
from trainer.person import FASTEST, HUMANS, PERSON, SLOWEST
from trainer.training.config import (
    CONFIG_FILE,
    DEFAULTS,
    EXTENT,
    OPTIONS,
    TYPED,
    RunConfig,
    flat,
    make_config,
    parse_setting,
    settings_in,
)
from trainer.training.curves import write_learning_curve
from trainer.training.demonstrations import SCRIPTED
from trainer.training.metrics import EpisodeMetrics, metrics_table, read_metrics
from trainer.training.run import TrainingRun, environment_of

FINDS_NOTHING = (
    "every episode has had the same return so far: there is nothing to learn from. A human, or more"
    " noise (--set exploration_initial=1 --set exploration_final=0.5), may find what pays"
)


@dataclass(frozen=True)
class Run:
    """A training run, usable as the path of its directory."""

    directory: Path
    interrupted: bool = False  # Stopped before its configured end; ``resume`` continues it
    scenario: str | None = None  # As given to ``train``: it may be ``module:ID``

    def __fspath__(self) -> str:
        return str(self.directory)

    @property
    def metrics(self) -> pd.DataFrame:
        """The table of ``metrics.csv``, one row per training episode."""
        return metrics_table(self.directory)


def run(arguments: argparse.Namespace) -> int:
    if not arguments.seeds:
        return _status(_run(arguments))
    if vars(arguments).get("human") in HUMANS:
        raise UserError("--seeds does not go with a person")
    return max(_run_seeds(arguments))


def _status(run: Run) -> int:
    return INTERRUPTED if run.interrupted else 0


def _run_seeds(arguments: argparse.Namespace) -> Iterator[int]:
    """Train a run of one thread for each seed, side by side; yield how each ends, as a status."""
    jobs = []
    for seed in arguments.seeds:
        out = Path(arguments.out) / f"seed_{seed}"
        resume = arguments.resume and (out / CONFIG_FILE).is_file()
        own = {"seed": seed, "out": str(out), "resume": resume}
        jobs.append(argparse.Namespace(**{"threads": 1, **vars(arguments), **own}))
        _run(jobs[-1], only_check=True)  # All of them before hours go into the first
    with (
        util.side_by_side(_run_quietly, jobs, 0, 0) as work,
        ProgressBar("seeds", len(jobs)) as bar,
    ):

        def quit_all() -> bool:
            for each in work:
                each.cancel()
            for process in active_children():  # Each ends its run after the episode.
                os.kill(process.pid or 0, signal.SIGINT)
            return True

        with quit_on_signals(quit_all):
            for each in as_completed(work):
                bar.advance({})
                try:
                    status, printed, warned = each.result()
                except CancelledError:
                    status, printed, warned = INTERRUPTED, "", []
                except (UserError, OSError) as error:
                    status, printed = BAD_INPUT, ""
                    warned = [f"error: seed {work[each].seed}: {UserError(error)}"]
                for line in warned:
                    say_once(line)
                print(printed, end="")
                yield status


def _run_quietly(arguments: argparse.Namespace) -> tuple[int, str, list[str]]:
    """Return a run's exit status, what it prints at its end, and its warnings."""
    with redirect_stdout(io.StringIO()) as printed, redirect_stderr(io.StringIO()) as said:
        status = _status(_run(arguments))
    lines = filter(None, said.getvalue().splitlines())
    return status, printed.getvalue(), [line for line in lines if not line.startswith("training: ")]


def _run(arguments: argparse.Namespace, only_check: bool = False) -> Run:
    typed = {name: value for name, value in vars(arguments).items() if name in TYPED}
    path = Path(arguments.out) / CONFIG_FILE
    saved: dict[str, Any] = {}
    if arguments.resume and path.is_file():
        saved = settings_in(read_json(path, "run config"), str(path))
        for name in {"scenario", "algorithm", "human", "success"} - typed.keys():
            # A module's name must be typed: none is imported because a file names it.
            name_in_file(str(saved.get(name)), f"{arguments.out} was trained with", f"--{name}")
    values = {**saved, **typed, **dict(map(parse_setting, arguments.set))}
    return _begin(values.pop("preset", "ours"), values, arguments, only_check)


def train(
    scenario: str = DEFAULTS.scenario,
    *,
    out: str | PathLike[str] | None = None,
    algorithm: str = DEFAULTS.algorithm,
    human: str = DEFAULTS.human,
    episodes: int | None = None,
    steps: int = DEFAULTS.steps,
    seed: int = DEFAULTS.seed,
    preset: str = "ours",
    settings: Mapping[str, Any] | Sequence[str] = (),
    latency: str = DEFAULTS.latency,
    device: str = DEFAULTS.device,
    threads: int = DEFAULTS.threads,
    max_minutes: float | None = None,
    demonstrations: str = DEFAULTS.demonstrations,
    success: str = DEFAULTS.success,
    resume: bool = False,
    host: str = "127.0.0.1",
    port: int = 0,
    speed: float = 1.0,
    on_step: Record | None = None,
) -> Run:
    """Train a policy with human guidance, as ``python -m trainer train`` does.

    The arguments are that command's options; ``out`` defaults to a new directory in ``runs``, and
    ``settings`` maps names of ``--set`` to values. ``on_step(transition, intervention, info)`` is
    called after each control period. Returns the run, for ``evaluate`` and ``export``. Raises
    UserError: no such environment, algorithm, human or setting, or a directory in use.
    """
    options_given = dict(locals())
    if isinstance(settings, Mapping):
        settings = [f"{name}={value}" for name, value in settings.items()]
    values = {name: options_given[name] for name in (*OPTIONS, *EXTENT)}
    values |= dict(map(parse_setting, settings))
    return _begin(preset, values, argparse.Namespace(**options_given))


def _begin(
    preset: str, values: dict[str, Any], how: argparse.Namespace, only_check: bool = False
) -> Run:
    """Train with these settings; ``how`` holds the options that do not decide the result."""
    if not SLOWEST <= how.speed <= FASTEST:
        raise UserError(f"speed must be from {SLOWEST} to {FASTEST}: {how.speed}")
    human = values.get("human", DEFAULTS.human)
    # The config of a run that a person guides says ``person``.
    values["human"] = PERSON if human in (*HUMANS, PERSON) else located(human)
    demonstrations = values.get("demonstrations")
    if demonstrations and not SCRIPTED.fullmatch(demonstrations):
        values["demonstrations"] = os.path.abspath(demonstrations)
    values["scenario"] = scenario_of(values.get("scenario", DEFAULTS.scenario))
    config = make_config(preset, values)
    util.check_device(config.device)
    run_dir = (_new_directory(config) if how.out is None else Path(how.out)).absolute()
    with (
        util.claimed(run_dir),
        util.limited_threads(config.threads),
        closing(environment_of(config)) as env,
    ):
        config = make_config(preset, values, env)
        resume = check_directory(run_dir, config, how.resume)
        if only_check:
            return Run(run_dir)
        return _train(config, run_dir, env, how, resume)


def _new_directory(config: RunConfig) -> Path:
    stem = re.sub(r"[^\w-]+", "_", f"{config.scenario}-{config.algorithm}")
    paths = (Path("runs") / f"{stem}-{number}" for number in count(1))
    return next(path for path in paths if not path.exists())


def _train(
    config: RunConfig, run_dir: Path, env: Any, how: argparse.Namespace, resume: bool
) -> Run:
    end_s = util.deadline_s(how.max_minutes)
    with ExitStack() as stack:
        if config.human == PERSON:
            from trainer.person.run import training_with_person

            opened = training_with_person(how, config, run_dir, env, resume)
            training, quit_training = stack.enter_context(opened)
        else:
            training = TrainingRun(config, run_dir, resume, env)
            quit_training = partial(_quit, training)
        if on_step := vars(how).get("on_step"):
            training.recorders.append(on_step)
        extent = config.episodes, training.episode
        if config.steps:
            extent = config.steps, training.steps
        bar = stack.enter_context(ProgressBar("training", *extent))
        stack.enter_context(quit_on_signals(quit_training))
        recent: deque[EpisodeMetrics] = deque(maxlen=20)
        explored = training.progress >= config.learner.exploration_share
        figures = {"validation": "-"}

        def on_episode(metrics: EpisodeMetrics) -> None:
            nonlocal explored
            recent.append(metrics)
            ends = training.progress >= config.learner.exploration_share
            if ends and not explored and len(recent) > 1:
                explored = True
                returns = {row["episode_return"] for row in read_metrics(run_dir)}
                if len(returns) == 1 and find_algorithm(config.algorithm).q_term:
                    print(f"\n{FINDS_NOTHING}", file=sys.stderr)
            if not math.isnan(metrics.validation_success):
                figures["validation"] = f"{metrics.validation_success:.2f}"
            elif not math.isnan(metrics.validation_reward):
                figures["validation"] = f"return {metrics.validation_reward:.1f}"
            figures["return"] = f"{fmean(m.episode_return for m in recent):.1f}"
            if not math.isnan(success := success_share(m.outcome for m in recent)):
                figures["success"] = f"{success:.2f}"
            bar.advance(figures, metrics.steps if config.steps else 1)

        training.train(on_episode, end_s)
    if training.episode:  # a person may quit before the first
        write_learning_curve(run_dir)
    print(f"{_summary(metrics_table(run_dir), config)}: {run_dir}")
    interrupted = training.quitting and not training.over
    if interrupted:
        print("interrupted; the same command with --resume goes on", file=sys.stderr)
    return Run(run_dir, interrupted, config.scenario)


def _quit(training: TrainingRun) -> bool:
    # Not print, which fails inside another print that the signal interrupts. OSError: the reader,
    # such as `tee`, may have ended by the same ^C.
    with suppress(OSError):
        os.write(2, b"ending after this episode; a second time: at once, back to the checkpoint\n")
    training.quitting = True
    return True


def _summary(rows: pd.DataFrame, config: RunConfig) -> str:
    if rows.empty:
        return "no episodes"
    last, confirmed = rows.iloc[-1], rows.confirmed_success.max()
    amounts = {"episode": len(rows), "step": last.total_steps, "update": last.updates}
    parts = [counted(count, name) for name, count in amounts.items()]
    parts.append(f"{counted(last.total_takeovers, 'take-over')} with {last.total_human_s:.0f} s")
    if is_told(rows.outcome):
        parts.append(counted(last.total_failures, "failure"))
    if confirmed == confirmed:  # Not NaN: an actor was kept
        count = config.confirmation_factor * config.evaluation_runs
        share = success_estimate(round(confirmed * count), count).as_share()
        parts.append(f"kept actor {share} %")
    return ", ".join(parts)


def check_directory(run_dir: Path, config: RunConfig, resume: bool) -> bool:
    """Return whether there is a checkpoint to resume.

    Raises UserError rather than overwrite a run, or resume it under other settings.
    """
    started = (run_dir / CHECKPOINT_FILE).is_file()
    if started and not resume:
        raise UserError(f"{run_dir} holds a run; add --resume, or choose another --out")
    if resume and not started:
        # It may have been killed before its first checkpoint.
        begun = (run_dir / CONFIG_FILE).is_file()
        if not begun or len(read_metrics(run_dir)) > config.checkpoint_every:
            raise UserError(f"{run_dir} holds no checkpoint to resume from")
        say_once(f"{run_dir} holds no checkpoint yet: it begins anew")
    if resume:
        _check_settings(run_dir, config)
    return started


def _check_settings(run_dir: Path, config: RunConfig) -> None:
    path = run_dir / CONFIG_FILE
    saved, wanted = settings_in(read_json(path, "run config"), str(path)), flat(config)
    for name, now in wanted.items():
        before = saved.get(name)
        # A run may be extended, but not shortened.
        if before is None or (now < before if name in EXTENT else now != before):
            difference = f"{run_dir} was trained with {name} = {before}, not {now}"
            raise UserError(f"{difference}: repeat the options that it had")
