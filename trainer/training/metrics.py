"""A run's metrics: its episodes as rows of CSV and of TensorBoard, and what they amount to."""

import argparse
import csv
import io
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch.utils.tensorboard import SummaryWriter

from bridge.outcomes import GOAL, failed, settled
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.util import UserError, read_bytes
from trainer.training.config import CURVE_FILE

NAN = float("nan")
METRICS_FILE, REPORT_FILE = "metrics.csv", "report.json"
COUNTED = ("episode", "total_steps", "interventions", "human_steps")
WHOLE = (*COUNTED, "updates")
ALWAYS = (*COUNTED, "steps", "episode_return", "distance_m")
"""Columns that hold a number in every row; others are empty in runs from before they came."""


@dataclass
class EpisodeMetrics:
    """One training episode; means over its steps or updates unless said otherwise."""

    episode: int
    total_steps: int = 0  # Environment steps since the run began, without discarded episodes
    updates: int = 0  # Updates since the run began
    steps: int = 0
    episode_return: float = 0.0  # Sum of the rewards, without the shaping of eq. 17
    distance_m: float = 0.0  # Surviving distance
    outcome: str = ""
    interventions: int = 0
    human_steps: int = 0
    total_human_s: float = 0.0  # Simulated seconds that the human drove since the run began
    total_takeovers: int = 0
    total_failures: int = 0  # Episodes that missed the goal so far, whoever drove
    human_s_to_90: float = NAN  # `total_human_s` when validation first reached 90 % success
    human_s_to_98: float = NAN
    exploration_std: float = 0.0
    critic_loss: float = NAN
    policy_loss: float = NAN
    cloning_loss: float = NAN
    value: float = NAN  # Mean Q_1 of the batches
    policy_priority: float = NAN  # Mean priority of the policy's transitions at the episode's end
    human_priority: float = NAN
    environment_s: float = 0.0
    """Time spent in the environment and with the human, while the learner updates."""
    acting_s: float = 0.0  # Time of the policy's actions
    storing_s: float = 0.0  # Time of drawing minibatches, storing steps and their new priorities
    learning_s: float = 0.0  # Time of the updates themselves, beside the parts above
    waiting_s: float = 0.0
    """How long the loop waited for an update after the environment's step was done."""
    validation_success: float = NAN
    """Success rate on the validation seeds (nan: no validation after this episode)."""
    validation_distance_m: float = NAN
    validation_reward: float = NAN
    """Mean return of the validation; at equal success rates it decides which actor is kept."""


NAMES = [f.name for f in fields(EpisodeMetrics)]


class MetricsWriter:
    """Appends rows; a resumed run first drops the rows after its checkpoint. ``period_s`` is T."""

    def __init__(self, run_dir: Path, from_episode: int = 0, period_s: float = 0.1) -> None:
        self.path = run_dir / METRICS_FILE
        kept = read_metrics(run_dir)[:from_episode]
        if len(kept) < from_episode:
            raise UserError(f"{self.path} lacks episodes before the checkpoint: {from_episode}")
        text = io.StringIO()
        writer = csv.DictWriter(text, NAMES)
        writer.writeheader()
        writer.writerows(kept)
        write_atomic(str(self.path), text.getvalue().encode())
        self._period_s, self._spent = period_s, spent(kept, period_s)
        self._outcomes = [row["outcome"] for row in kept]
        there = totals(kept, period_s).get("until", {})
        self._human_s_to = {level: it["human_s"] for level, it in there.items() if it}
        self._file = self.path.open("a", newline="")
        self._csv = csv.DictWriter(self._file, NAMES)
        self._board = SummaryWriter(str(run_dir / "tensorboard"), purge_step=from_episode)

    def add(self, metrics: EpisodeMetrics) -> None:
        """Write one episode's row, with the totals so far; UserError where the disk is full."""
        self._spent["human_s"] += metrics.human_steps * self._period_s
        self._spent["takeovers"] += metrics.interventions
        self._outcomes.append(metrics.outcome)
        metrics.total_human_s = round(self._spent["human_s"], 6)
        metrics.total_takeovers = self._spent["takeovers"]
        metrics.total_failures = sum(map(failed, settled(self._outcomes)))
        for level in LEARNED:
            if is_reached(level, metrics.validation_success):
                self._human_s_to.setdefault(f"{level:g}", metrics.total_human_s)
        reached = (self._human_s_to.get(f"{level:g}", NAN) for level in LEARNED)
        metrics.human_s_to_90, metrics.human_s_to_98 = reached
        row = asdict(metrics)
        try:
            self._csv.writerow(row)
            self._file.flush()
            os.fsync(self._file.fileno())  # No power cut leaves a checkpoint without its rows.
        except OSError as error:
            raise UserError(f"cannot write {self.path}: {error.strerror}") from None
        row["success"] = float(metrics.outcome == GOAL)
        for name, value in row.items():
            if isinstance(value, (int, float)) and value == value:
                self._board.add_scalar(name, value, metrics.episode)

    def close(self) -> None:
        with suppress(OSError):  # Closing tries once more to write what `add` could not.
            self._file.close()
        self._board.close()


def read_metrics(run_dir: Path) -> list[dict[str, str]]:
    """Read the rows of a run, none where it has none; a column that came later is empty.

    A row that was cut off at the end is left out: no checkpoint comes before its row is whole.
    Raises UserError for a file that is damaged, or not of this project.
    """
    path = run_dir / METRICS_FILE
    if not path.exists():
        return []
    try:
        # As csv ends lines: an outcome may hold what `str.splitlines` takes for another end.
        whole, end, _ = read_bytes(path, "metrics").rpartition(b"\n")
        reader = csv.DictReader(io.StringIO((whole + end).decode(), newline=""), strict=True)
        if not {*ALWAYS, "outcome"} <= set(reader.fieldnames or []) <= set(NAMES):
            raise ValueError("its columns are others")
        rows = list(reader)
        for number, row in enumerate(rows):
            for name, value in row.items():  # None stands for a column too few or too many.
                if name in ALWAYS or (value != "" and name != "outcome"):
                    (int if name in WHOLE else float)(value)
            if int(row["episode"]) != number:
                raise ValueError(f"row {number + 1} is of episode {row['episode']}")
    except (ValueError, TypeError, csv.Error) as error:
        raise UserError(f"{path} is no metrics of a training, or damaged: {error}") from None
    return [{**dict.fromkeys(NAMES, ""), **row} for row in rows]


LEARNED = (0.9, 0.98)
"""Success rates of the policy alone, in validation, whose cost is reported."""


def was_validated(row: Mapping[str, str]) -> bool:
    return row["validation_success"] not in ("", "nan")


def is_reached(level: float, success: float) -> bool:
    """Return whether a success rate reaches a level, up to rounding."""
    return success >= level - 1e-9


def spent(rows: Sequence[dict[str, str]], period_s: float) -> dict[str, Any]:
    """Sum up what episodes cost: steps, the human's effort, failures by outcome."""
    human_steps = sum(int(row["human_steps"]) for row in rows)
    failures = Counter(filter(failed, settled(row["outcome"] for row in rows)))
    return {
        "steps": int(rows[-1]["total_steps"]) if rows else 0,
        "human_steps": human_steps,
        "human_s": round(human_steps * period_s, 6),
        "takeovers": sum(int(row["interventions"]) for row in rows),
        "failures": dict(sorted(failures.items())),
    }


def totals(
    rows: Sequence[dict[str, str]], period_s: float, kept_episode: int | None = None
) -> dict[str, Any]:
    """Sum up what a run cost and what it reached, from its rows; empty without rows.

    ``failures``: training episodes, with the human's help, that missed the goal, by outcome.
    ``validation``: best and last success rate, and the steps after which the kept actor reached the
    best. ``until``: what was spent until the policy alone first reached each of ``LEARNED``, or
    None. ``kept_episode``: episodes before the kept actor; None: the rows tell.
    """
    if not rows:
        return {}
    measured = [
        (float(row["validation_success"]), float(row.get("validation_reward") or "nan"), number)
        for number, row in enumerate(rows)
        if was_validated(row)
    ]
    validation = {}
    if measured:
        best, _, number = max(measured)  # As `Validation` keeps it: of equal ones the last.
        at_step = int(rows[: kept_episode or number + 1][-1]["total_steps"])
        validation = {"best": best, "best_at_step": at_step, "last": measured[-1][0]}
    until = {}
    for level in LEARNED:
        there = [number for success, _, number in measured if is_reached(level, success)]
        until[f"{level:g}"] = spent(rows[: there[0] + 1], period_s) if there else None
    return {
        "episodes": len(rows),
        "updates": int(rows[-1]["updates"] or 0),
        **spent(rows, period_s),
        "validation": validation,
        "until": until,
    }


DOTS_PER_INCH = 110
WINDOW = 20  # Episodes of the moving average
PANELS = {
    "episode_return": "return (without shaping)",
    "distance_m": "surviving distance, m",
    "success": "success",
    "human_share": "share of steps driven by the human",
}
Values = NDArray[np.float64]


def run(arguments: argparse.Namespace) -> int:
    if arguments.out is None and len(arguments.run_dirs) > 1:
        raise UserError("several runs go into one picture: --out F.png")
    print(write_learning_curve(*map(Path, arguments.run_dirs), out=arguments.out))
    return 0


def write_learning_curve(*run_dirs: Path, out: str | None = None) -> Path:
    """Draw return, surviving distance, success and human share over the episodes as a PNG.

    Each of several runs is a thin line; the thick one is their mean, up to the end of the shortest.
    ``out`` is by default in the first run's directory. UserError: a run has no metrics yet.
    """
    path = run_dirs[0] / CURVE_FILE if out is None else Path(out)
    check_writable(path)
    runs = [_columns(run_dir) for run_dir in run_dirs]
    shortest = min(len(run["episode"]) for run in runs)
    episodes = runs[0]["episode"][:shortest]
    figure = Figure(figsize=(10, 6), layout="constrained")
    panels = dict(zip(PANELS, figure.subplots(2, 2, sharex=True).flat, strict=True))
    for name, panel in panels.items():
        curves = [moving_average(run[name], WINDOW) for run in runs]
        label = f"mean of {WINDOW}"
        if len(runs) == 1:
            panel.plot(episodes, runs[0][name], ".", markersize=3, color="0.75")
        else:
            label = f"{len(runs)} runs, {label}"
            for run, curve in zip(runs, curves, strict=True):
                panel.plot(run["episode"], curve, color="C0", alpha=0.25, linewidth=1)
        mean = np.mean([curve[:shortest] for curve in curves], axis=0)
        panel.plot(episodes, mean, color="C0", label=label)
        panel.set_title(PANELS[name])
        panel.grid(alpha=0.3)
    # Mean success of the policy alone, where all runs were validated.
    validated = np.array([run["validation"][:shortest] for run in runs])
    tested = ~np.isnan(validated).any(axis=0)
    means = validated[:, tested].mean(axis=0)
    success = panels["success"]
    success.plot(episodes[tested], means, "o-", color="C1", label="policy alone, validation")
    success.legend()
    for name in ("success", "human_share"):
        panels[name].set_xlabel("episode")
    write_figure(figure, path)
    return path


def write_figure(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH)
    write_atomic(path, buffer.getvalue())


def moving_average(values: Values, window: int) -> Values:
    """Return the means of the last ``window`` values (fewer at the start), same length."""
    sums = np.convolve(values, np.ones(window))[: len(values)]
    return sums / np.minimum(np.arange(1, len(values) + 1), window)


def _columns(run_dir: Path) -> dict[str, Values]:
    rows = read_metrics(run_dir)
    if not rows:
        raise UserError(f"{run_dir} holds no metrics to draw")

    def column(name: str) -> Values:
        # Kept results have an empty field where there was no number.
        return np.array([row.get(name) or "nan" for row in rows], dtype=float)

    return {
        "episode": column("episode") + 1,
        "episode_return": column("episode_return"),
        "distance_m": column("distance_m"),
        "success": np.array([row["outcome"] == GOAL for row in rows], dtype=float),
        "human_share": column("human_steps") / column("steps"),
        "validation": column("validation_success"),
    }
