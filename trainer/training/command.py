"""Train a policy with human guidance: options, settings, and whether a run may begin or go on."""

import argparse
import difflib
import inspect
import math
import os
import re
import sys
import textwrap
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import count
from os import PathLike
from pathlib import Path
from typing import Any

from bridge.network import parse_spec
from bridge.outcomes import GOAL
from bridge.progress import ProgressBar
from bridge.rerun import check_sink
from edge_runtime.cli import INTERRUPTED, quit_on_signals
from edge_runtime.util import UserError, counted, name_in_file, read_json, read_toml
from trainer import options
from trainer.drivers import CHECKPOINT_FILE, is_expert, located
from trainer.environments import scenario_of
from trainer.learner.config import LearnerConfig, find_algorithm
from trainer.person.interface import (
    FASTEST,
    HUMANS,
    PERSON,
    SLOWEST,
    check_person_options,
)
from trainer.pictures import write_learning_curve
from trainer.training.config import CONFIG_FILE, EXTENT, GONE, LATER, PRESETS, RunConfig
from trainer.training.metrics import EpisodeMetrics, read_metrics, totals
from trainer.training.run import TrainingRun
from trainer.util import claimed

DEFAULTS = RunConfig()
OPTIONS = ("scenario", "algorithm", "seed", "human", "latency", "device", "threads")
"""What an option of its own decides."""
SETTINGS: dict[str, Any] = {
    **{n: v for n, v in asdict(DEFAULTS).items() if n not in (*OPTIONS, *EXTENT, "learner")},
    **asdict(DEFAULTS.learner),
}
"""Every setting that ``--set`` may change, with its default."""
EXPECTED = {bool: "true or false", int: "a whole number", float: "a number"}
_STDERR = 2
_ENDING = b"ending after this episode; a second time: at once, back to the last checkpoint\n"


def run(arguments: argparse.Namespace) -> int:
    """Train, showing progress; returns the exit status."""
    settings, own = arguments.set, Path(arguments.out) / CONFIG_FILE
    if arguments.config is not None:
        settings = [*_take_config(arguments), *settings]
    elif arguments.resume and own.is_file():
        settings = [*_take_own(arguments, own), *settings]
    known = {**vars(arguments), "settings": settings}
    done = train(**{name: known[name] for name in inspect.signature(train).parameters})
    return INTERRUPTED if done.interrupted else 0


@dataclass(frozen=True)
class Run:
    """A training run as a path: what is in its directory is all that there is of it."""

    directory: Path
    interrupted: bool = False  # Whether it was asked to end before its time; ``resume`` goes on
    scenario: str | None = None  # As ``train`` was told: so it may be of a module

    def __fspath__(self) -> str:
        return str(self.directory)

    @property
    def metrics(self) -> list[dict[str, str]]:
        """A row for each training episode, as in ``metrics.csv``."""
        return read_metrics(self.directory)


def train(
    scenario: str = DEFAULTS.scenario,
    *,
    out: str | PathLike[str] | None = None,
    algorithm: str = DEFAULTS.algorithm,
    human: str = DEFAULTS.human,
    episodes: int = DEFAULTS.episodes,
    steps: int = DEFAULTS.steps,
    seed: int = DEFAULTS.seed,
    preset: str = "ours",
    settings: Mapping[str, Any] | Sequence[str] = (),
    latency: str = DEFAULTS.latency,
    device: str = DEFAULTS.device,
    threads: int = DEFAULTS.threads,
    max_minutes: float | None = None,
    resume: bool = False,
    rerun: str | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    speed: float = 1.0,
) -> Run:
    """Train a policy with human guidance, as ``python -m trainer train`` does.

    The arguments are that command's options, ``out`` a new directory in ``runs`` by default, and
    ``settings`` what ``--set`` changes, name to value. Gives the run, for ``evaluate`` and
    ``export``.

    Raises UserError: no such environment, algorithm, human or setting, or a directory that is
    taken.
    """
    options.check_device(device)
    if human == PERSON:  # as a run's own --config says
        raise UserError(f"a person guides that run: name --human {', '.join(HUMANS)}")
    if not is_expert(human) and human not in HUMANS and not Path(human).exists():
        known = ", ".join([DEFAULTS.human, *HUMANS])
        words = f"none of {known}, no module:Class and no human model's directory"
        raise UserError(f"--human {human} is {words}")
    human = human if human in HUMANS else located(human)
    if not SLOWEST <= speed <= FASTEST:
        raise UserError(f"speed must be from {SLOWEST} to {FASTEST}: {speed}")
    if preset not in PRESETS:
        raise UserError(f"preset must be one of {', '.join(PRESETS)}: {preset}")
    start = PRESETS[preset]
    try:
        learner = replace(start.learner, **find_algorithm(algorithm).settings)
    except TypeError as error:  # The row is a plug-in's.
        raise UserError(f"settings of {algorithm}: {error}") from None
    config = replace(
        start,
        scenario=scenario_of(scenario),
        algorithm=algorithm,
        human=PERSON if human in HUMANS else human,
        episodes=episodes,
        steps=steps,
        seed=seed,
        latency=str(parse_spec(latency)),
        device=device,
        threads=threads,
        learner=learner,
    )
    if isinstance(settings, Mapping):
        settings = [f"{name}={value}" for name, value in settings.items()]
    changed = dict(map(parse_setting, settings))  # All at once: some hold only together.
    ours = {name: changed.pop(name) for name in tuple(changed) if not hasattr(learner, name)}
    config = replace(config, **ours, learner=replace(learner, **changed))
    run_dir = (_new_directory(config) if out is None else Path(out)).absolute()
    person = argparse.Namespace(
        human=human, scenario=config.scenario, host=host, port=port, speed=speed
    )
    with claimed(run_dir), options.limited_threads(threads):
        person.resume = check_directory(run_dir, config, resume)
        return _train(person, config, run_dir, rerun, options.deadline_s(max_minutes))


def _new_directory(config: RunConfig) -> Path:
    """The first of ``runs/SCENARIO-ALGORITHM-1`` and on that is not there."""
    stem = re.sub(r"[^\w-]+", "_", f"{config.scenario}-{config.algorithm}")
    paths = (Path("runs") / f"{stem}-{number}" for number in count(1))
    return next(path for path in paths if not path.exists())


def _train(
    person: argparse.Namespace, config: RunConfig, run_dir: Path, rerun: str | None, end_s: float
) -> Run:
    sink = None if rerun is None else check_sink(rerun)
    with ExitStack() as stack:
        training: TrainingRun
        if person.human in HUMANS:
            from trainer.person.run import training_with_person

            training = stack.enter_context(training_with_person(person, config, run_dir))
        else:
            check_person_options(person)
            training = TrainingRun(config, run_dir, person.resume)
        extent = (
            (config.steps, training.steps) if config.steps else (config.episodes, training.episode)
        )
        bar = stack.enter_context(ProgressBar("training", *extent))
        watch = None
        if sink:
            from trainer.view import watched  # rerun takes a second to load

            watch = stack.enter_context(watched(training, sink))
        # Entered last: the first signal is ours, and the second the viewer's.
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
    print(f"{_summary(run_dir, training.env.control_period_s)}: {run_dir}")
    if training.over and training.steps < config.steps:
        said = f"{config.episodes} episodes were over first: --episodes N allows more"
        print(said, file=sys.stderr)
    interrupted = training.quitting and not training.over
    if interrupted:
        print("interrupted; the same command with --resume goes on", file=sys.stderr)
    return Run(run_dir, interrupted, config.scenario)


def _quit(training: TrainingRun) -> bool:
    heeded = training.quit()
    if training.quitting:
        # Not print: a signal may come in the midst of one, which takes no other. And the reader,
        # such as `tee`, may have had the same ^C.
        with suppress(OSError):
            os.write(_STDERR, _ENDING)
    return heeded


def _summary(run_dir: Path, period_s: float) -> str:
    found = totals(read_metrics(run_dir), period_s)
    if not found:
        return "no episodes"
    amounts = [counted(found[f"{name}s"], name) for name in ("episode", "step", "update")]
    steps = counted(found["human_steps"], "step")
    human = f"{counted(found['takeovers'], 'take-over')} with {steps}, {found['human_s']:.0f} s"
    alone = [f"{float(level):.0%} alone after {there['human_s']:.0f}"
             for level, there in found["until"].items() if there]  # fmt: skip
    human += f" ({', '.join(alone)})" if alone and found["human_steps"] else ""
    return ", ".join([*amounts, human, counted(sum(found["failures"].values()), "failure")])


def _take_config(arguments: argparse.Namespace) -> list[str]:
    """Take what ``--config`` says and no option does; the settings in it, as ``--set`` has them."""
    path, given = Path(arguments.config), getattr(arguments, "given", ())
    values = _flat(read_toml(path, "config"))
    both = {"preset": _preset_names(arguments.preset)} if "preset" in given else {}
    rows = {arguments.algorithm, str(values.get("algorithm", arguments.algorithm))}
    if len(rows) == 2 and "algorithm" in given:
        both["algorithm"] = set().union(*(find_algorithm(row).settings for row in rows))
    for option, names in both.items():
        if clash := [name for name in values if name in names]:
            raise UserError(f"config {path} sets {clash[0]}, and so does --{option}: leave one out")
    return _take(arguments, path, values)


def _take_own(arguments: argparse.Namespace, path: Path) -> list[str]:
    """The same of the run's own config, where it goes on; `check_directory` compares the rest.

    What ``--preset`` may change is the preset's where one is given. A name of a module is to be
    typed again: no file decides what is imported.
    """
    kept = {*SETTINGS, *OPTIONS, *EXTENT}
    if "preset" in getattr(arguments, "given", ()):
        kept -= set().union(*map(_preset_names, PRESETS))
    values = {name: v for name, v in _flat(read_json(path, "run config")).items() if name in kept}
    for name in {"scenario", "algorithm", "human"} - set(getattr(arguments, "given", ())):
        name_in_file(str(values.get(name)), f"{path.parent} was trained with", f"--{name}")
    return _take(arguments, path, values)


def _take(arguments: argparse.Namespace, path: Path, values: dict[str, Any]) -> list[str]:
    assignments, given = [], getattr(arguments, "given", ())
    for name, value in values.items():
        if name not in (*OPTIONS, *EXTENT, "preset"):
            assignments.append(f"{name}={value}")
        elif type(value) is not type(getattr(DEFAULTS, name, "")):
            raise UserError(f"config {path}: {name} cannot be {value!r}")
        elif name not in given:
            setattr(arguments, name, value)
    return assignments


def _preset_names(preset: str) -> set[str]:
    """The settings that it changes."""
    changed = _flat(asdict(PRESETS[preset]))
    return {name for name, default in SETTINGS.items() if changed[name] != default}


def setting_lines() -> Iterator[str]:
    """Every setting as it is typed by default, and what it means."""
    said = options.meanings(RunConfig) | options.meanings(LearnerConfig)
    for name, default in SETTINGS.items():
        typed = str(default).lower() if isinstance(default, bool) else str(default)
        begin, indent = f"  {f'{name}={typed}':<33} ", 36 * " "
        yield textwrap.fill(
            said.get(name, ""), 98, initial_indent=begin, subsequent_indent=indent,
            break_on_hyphens=False,
        )  # fmt: skip


def parse_setting(assignment: str) -> tuple[str, Any]:
    """The name and the value of one NAME=VALUE.

    Raises UserError: no such setting, or no such value of it.
    """
    name, given, text = assignment.partition("=")
    if not given:
        raise UserError(f"--set {assignment}: expected NAME=VALUE")
    if name not in SETTINGS:
        near = difflib.get_close_matches(name, SETTINGS, 1)
        guess = f"did you mean {near[0]}?" if near else "--set alone lists them"
        raise UserError(f"--set {assignment}: there is no setting {name!r}; {guess}")
    kind = type(SETTINGS[name])
    try:
        value: Any = {"true": True, "false": False}[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        raise UserError(f"--set {assignment}: expected {EXPECTED[kind]}, got {text!r}") from None
    return name, value


def check_directory(run_dir: Path, config: RunConfig, resume: bool) -> bool:
    """Whether there is a checkpoint to go on from.

    Raises UserError rather than overwrite a run, or resume one under other settings.
    """
    started = (run_dir / CHECKPOINT_FILE).is_file()
    if started and not resume:
        raise UserError(f"{run_dir} holds a run; add --resume, or choose another --out")
    if resume and not started:
        # It may have been killed before the first one.
        begun, done = (run_dir / CONFIG_FILE).is_file(), len(read_metrics(run_dir))
        if not begun or done > config.checkpoint_every:
            raise UserError(f"{run_dir} holds no checkpoint to resume from")
        print(f"{run_dir} holds no checkpoint yet: it begins anew", file=sys.stderr)
    if resume:
        _check_settings(run_dir, config)
    return started


def _check_settings(run_dir: Path, config: RunConfig) -> None:
    path = run_dir / CONFIG_FILE
    saved, wanted = _flat(read_json(path, "run config")), _flat(asdict(config))
    saved = {name: SETTINGS[name] for name in LATER if name in SETTINGS} | saved
    if not all(isinstance(saved.get(name), int) for name in EXTENT):
        raise UserError(f"run config {path} does not say how many episodes and steps")
    changed = []
    for name in wanted:
        if name not in EXTENT and (name not in saved or saved[name] != wanted[name]):
            before = _option(name, saved) if name in saved else f"no {name}"
            changed.append(f"{before} (now {_typed(name, wanted)})")
    if changed:
        raise UserError(f"{run_dir} was trained with {', '.join(changed)}: repeat what it had")
    for name in EXTENT:
        # Steps left out are 0: the run would go by episodes, and begin to explore anew.
        if wanted[name] < saved[name]:
            raise UserError(f"{run_dir} is a run of --{name} {saved[name]}: repeat that, or more")


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    """A config's settings by their names, those of the learner among them.

    Former settings are left out. UserError where one has a value that is no longer possible.
    """
    for name, taken in GONE.items():
        if values.get(name, taken[0]) not in taken:
            raise UserError(f"the setting {name} is gone: {values[name]} is no longer possible")
    values = {name: value for name, value in values.items() if name not in GONE}
    learner = values.get("learner")
    if not isinstance(learner, dict):
        return values
    return {name: value for name, value in values.items() if name != "learner"} | learner


def _option(name: str, values: dict[str, Any]) -> str:
    """The option with its value, as it was typed."""
    if name == "period_s":  # 0: what the environment says
        return f"--period {values[name]}" if values[name] else "no --period"
    return (f"--{name} " if name in OPTIONS else f"--set {name}=") + _typed(name, values)


def _typed(name: str, values: dict[str, Any]) -> str:
    return "|".join(HUMANS) if (name, values[name]) == ("human", PERSON) else str(values[name])
