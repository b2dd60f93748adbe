"""Seconds for 10,000 training steps of each algorithm, in turns within one process.

Turns are whole episodes, so that what an update needs beside the environment is in the figure, and
a machine that slows down for a while slows all of them down.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from edge_runtime.errors import UserError
from edge_runtime.files import make_directory, read_json, write_json
from trainer.benches.machine import about
from trainer.experiments.figures.style import colour, label, new_figure, note_missing
from trainer.experiments.plan import NORMAL, Plan
from trainer.experiments.statistics import CONFIDENCE, RESAMPLES, Estimate, Holds
from trainer.experiments.units import Unit, obstacle, run_config, unit_id
from trainer.experiments.verdict import BAR, Claim, claim
from trainer.progress import ProgressBar
from trainer.training.run import TrainingRun

MEASURED_FILE = "measured.json"
PAPER_S = {"phil_td3": 360.70, "ia_td3": 348.71, "hi_td3": 328.93, "per_td3": 329.39}
"""The paper's table of time efficiency: seconds for 10,000 steps."""
SCENARIO = "left_turn"
RATIO = 1.05
"""What PHIL-TD3 may take, in times of IA-TD3."""
STEPS = 10_000

Turns = dict[str, list[tuple[int, float]]]
"""Algorithm -> (steps, seconds) of each of its turns."""


def measure(plan: Plan, humans: Path, device: str) -> dict[str, Any]:
    """Train all algorithms in turns, and report the turns and the machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as directory, ExitStack() as closing:
        runs = {}
        for algorithm in PAPER_S:
            config = run_config(_unit(algorithm), plan, humans, device)
            run_dir = Path(directory) / algorithm
            make_directory(run_dir)
            runs[algorithm] = TrainingRun(replace(config, evaluate_every_steps=0), run_dir)
            closing.callback(runs[algorithm].learning.close)
        turns = take_turns(runs, plan)
    torch.set_num_threads(before)
    return {
        **about(), "threads": 1, "device": device, "units": _ids(plan, humans), "turns": turns
    }  # fmt: skip


def _unit(algorithm: str) -> Unit:
    return Unit(SCENARIO, algorithm, NORMAL, 1)


def _ids(plan: Plan, humans: Path) -> dict[str, str]:
    """What decides each training that is timed, as an id; nothing without its human model."""
    if any(obstacle(_unit(algorithm), humans) for algorithm in PAPER_S):
        return {}
    return {algorithm: unit_id(_unit(algorithm), plan, humans) for algorithm in PAPER_S}


def take_turns(runs: Mapping[str, TrainingRun], plan: Plan) -> Turns:
    """Whole episodes in turns until each has learned for ``plan.timed_steps``.

    Who begins a round ends the next one. What comes before the first update is not counted.
    """
    names = list(runs)
    turns: Turns = {name: [] for name in names}
    steps = dict.fromkeys(names, 0)
    with ProgressBar("time", len(names) * plan.timed_steps) as bar:
        for run in runs.values():
            while run.learning.added < run.config.learner.warmup_steps:
                run.advance()
        number = 0
        while min(steps.values()) < plan.timed_steps:
            first = number % len(names)
            for name in names[first:] + names[:first]:
                turns[name].append(_turn(runs[name], plan.turn_steps))
                left = max(plan.timed_steps - steps[name], 0)
                steps[name] += turns[name][-1][0]
                bar.advance({"last": label(name)}, min(turns[name][-1][0], left))
            number += 1
    return turns


def _turn(run: TrainingRun, least_steps: int) -> tuple[int, float]:
    steps, began_s = 0, time.perf_counter()
    while steps < least_steps:
        steps += run.advance().steps
    return steps, time.perf_counter() - began_s


def seconds(turns: list[tuple[int, float]]) -> float:
    """For 10,000 steps."""
    steps, spent_s = np.sum(turns, axis=0)
    return float(STEPS * spent_s / steps)


def ratio(ours: list[tuple[int, float]], other: list[tuple[int, float]]) -> Estimate:
    """Our time for a step over another's, with a 95 % bootstrap interval over the rounds."""
    random = np.random.default_rng(0)
    first, second = np.array(ours, dtype=float), np.array(other, dtype=float)
    count = min(len(first), len(second))
    value = seconds(ours) / seconds(other)
    if count < 2:
        return Estimate(value, float("-inf"), float("inf"), count)
    rounds = random.integers(count, size=(RESAMPLES, count))
    own, theirs = first[rounds].sum(axis=1), second[rounds].sum(axis=1)
    ratios = (own[:, 1] / own[:, 0]) / (theirs[:, 1] / theirs[:, 0])
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = (float(x) for x in np.quantile(ratios, (tail, 1.0 - tail)))
    return Estimate(value, low, high, count)


def load_or_measure(
    directory: Path, plan: Plan, humans: Path, device: str, draw_only: bool
) -> Turns | None:
    """The turns in the experiment's directory, measured first where there are none.

    Raises:
        UserError: the file there is not one of these, or of other settings.
    """
    path = directory / MEASURED_FILE
    if not path.is_file():
        if draw_only:
            return None
        make_directory(directory)
        write_json(path, measure(plan, humans, device))
    try:
        measured = read_json(path, "measurement")
        turns = measured["turns"]
        # The first measurement does not say what it was of.
        ids = _ids(plan, humans)
        if ids and measured.get("units", ids) != ids:
            raise UserError(f"{path} was measured with other settings; remove it to measure again")
        return {name: [(int(n), float(s)) for n, s in turns[name]] for name in PAPER_S}
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is no measurement of this project") from error


def draw(turns: Turns | None) -> Figure:
    """Bars of seconds for 10,000 steps, the paper's beside ours, each relative to IA-TD3's."""
    figure = new_figure(7.0, 4.0)
    panel = figure.subplots()
    for place, algorithm in enumerate(PAPER_S):
        paper = PAPER_S[algorithm] / PAPER_S["ia_td3"]
        panel.bar(place - 0.2, paper, 0.38, color="white", edgecolor="0.5", hatch="//")
        panel.text(place - 0.2, paper, f"{PAPER_S[algorithm]:.0f} s", ha="center", va="bottom")
        if turns is None:
            continue
        ours_s = seconds(turns[algorithm])
        ours = ours_s / seconds(turns["ia_td3"])
        panel.bar(place + 0.2, ours, 0.38, color=colour(algorithm))
        panel.text(place + 0.2, ours, f"{ours_s:.0f} s", ha="center", va="bottom")
    panel.set_xticks(range(len(PAPER_S)), [label(name) for name in PAPER_S])
    panel.set_ylabel("time for a training step, IA-TD3 = 1")
    panel.set_title("10,000 training steps: the paper's (hatched) and ours", fontsize=10)
    panel.margins(y=0.12)
    panel.grid(alpha=0.3, axis="y")
    panel.set_axisbelow(True)
    if turns is None:
        note_missing(panel)
    return figure


def judge(turns: Turns | None) -> list[Claim]:
    """Whether the priorities cost next to nothing."""
    text = f"PHIL-TD3 takes at most {RATIO} times as long as IA-TD3 ({BAR})"
    paper = f"similar, {PAPER_S['phil_td3'] / PAPER_S['ia_td3']:.3f}"
    rule = "95 % bootstrap interval over the rounds, on one side of the bar"
    if turns is None:
        return [claim(text, paper, "", "undecided", 0, rule, None, False)]
    found = ratio(turns["phil_td3"], turns["ia_td3"])
    holds: Holds = "yes" if found.high <= RATIO else "no" if found.low > RATIO else "undecided"
    shown = ", ".join(f"{label(name)} {seconds(turns[name]):.0f} s" for name in PAPER_S)
    return [claim(text, paper, f"{found.text(3)}; {shown}", holds, 1, rule, found)]
