"""A run's metrics: its episodes as rows of CSV and of TensorBoard, and what they amount to."""

import csv
import io
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import pandas as pd
from torch.utils.tensorboard import SummaryWriter

from bridge.outcomes import GOAL, Estimate, failed, settled, success_estimate
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError, read_bytes
from trainer.util import fitting

NAN = float("nan")
METRICS_FILE, REPORT_FILE = "metrics.csv", "report.json"
WHOLE = ("episode", "total_steps", "interventions", "human_steps", "updates")
LEARNED = (0.9, 0.98)
"""Success rates of the policy alone, in validation, whose cost is reported."""


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
    """Success rate on the validation seeds (nan: no validation after this episode, or nothing tells
    whether a drive succeeded)."""
    validation_distance_m: float = NAN
    validation_reward: float = NAN
    """Mean return of the validation (nan: none); at equal success rates it decides which actor is
    kept."""
    confirmed_success: float = NAN
    """Success rate on the second set of seeds (nan: no better than the kept actor before that)."""
    confirmed_reward: float = NAN


NAMES = [f.name for f in fields(EpisodeMetrics)]


class MetricsWriter:
    """Appends rows; a resumed run first drops the rows after its checkpoint. ``period_s`` is T.

    ``undue``: it drops the last row's validation, too.
    """

    def __init__(
        self, run_dir: Path, from_episode: int = 0, period_s: float = 0.1, undue: bool = False
    ) -> None:
        path, self._period_s = run_dir / METRICS_FILE, period_s
        self._rows = read_metrics(run_dir)[:from_episode]
        if len(self._rows) < from_episode:
            raise UserError(f"{path} lacks episodes before the checkpoint: {from_episode}")
        for row in self._rows[-1:] if undue else ():
            row.update({n: "nan" for n in NAMES if n.startswith(("validation", "confirmed"))})
        text = io.StringIO()
        writer = csv.DictWriter(text, NAMES)
        writer.writeheader()
        writer.writerows(self._rows)
        write_atomic(path, text.getvalue().encode())
        self._file = path.open("a", newline="")
        self._csv = csv.DictWriter(self._file, NAMES)
        self._board = SummaryWriter(str(run_dir / "tensorboard"), purge_step=from_episode)

    def add(self, metrics: EpisodeMetrics) -> None:
        """Write one episode's row, with the totals so far."""
        self._rows.append({name: str(value) for name, value in asdict(metrics).items()})
        so_far = totals(self._rows, self._period_s)
        metrics.total_human_s, metrics.total_takeovers = so_far["human_s"], so_far["takeovers"]
        metrics.total_failures = sum(so_far["failures"].values())
        metrics.human_s_to_90, metrics.human_s_to_98 = (
            until["human_s"] if until else NAN for until in so_far["until"].values()
        )
        row = asdict(metrics)
        self._csv.writerow(row)
        self._file.flush()
        os.fsync(self._file.fileno())  # No power cut leaves a checkpoint without its rows.
        row["success"] = float(metrics.outcome == GOAL)
        for name, value in row.items():
            if isinstance(value, (int, float)) and value == value:
                self._board.add_scalar(name, value, metrics.episode)

    def close(self) -> None:
        self._file.close()
        self._board.close()


def read_metrics(run_dir: Path) -> list[dict[str, str]]:
    """Read the rows of a run, none where it has none.

    A row that was cut off at the end is left out: no checkpoint comes before its row is whole.
    Raises UserError for a file that is damaged, or not of this project.
    """
    path = run_dir / METRICS_FILE
    if not path.exists():
        return []
    with fitting(f"{path} is no metrics of a training, or damaged"):
        # As csv ends lines: an outcome may hold what `str.splitlines` takes for another end.
        whole, end, _ = read_bytes(path, "metrics").rpartition(b"\n")
        text = io.StringIO((whole + end).decode(), newline="")
        rows = list(csv.DictReader(text, strict=True))
        for number, row in enumerate(rows):
            values = {name: _number(name, text) for name, text in row.items() if name != "outcome"}
            if [*row] != NAMES or values["episode"] != number:
                raise ValueError(row)
    return rows


def metrics_table(run_dir: Path) -> pd.DataFrame:
    """Return a run's rows as numbers, and the outcome as text."""
    kinds = {name: str if name == "outcome" else int if name in WHOLE else float for name in NAMES}
    return pd.DataFrame(read_metrics(run_dir), columns=NAMES).astype(kinds)


def _number(name: str, text: str) -> float:
    return int(text) if name in WHOLE else float(text)


def was_validated(row: Mapping[str, str]) -> bool:
    return row["validation_reward"] != "nan"


def is_reached(level: float, success: float) -> bool:
    """Return whether a success rate reaches a level, up to rounding."""
    return success >= level - 1e-9


def spent(rows: Sequence[Mapping[str, str]], period_s: float) -> dict[str, Any]:
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


def _scores(rows: Sequence[Mapping[str, str]], kind: str) -> list[tuple[float, float, int]]:
    """Return the success, return and row number of each validation, or each confirmed one."""
    success, reward = (f"{kind}_{name}" for name in ("success", "reward"))
    scores = [(float(row[success]), float(row[reward]), n) for n, row in enumerate(rows)]
    # Unknown successes are all alike.
    return [(0.0 if math.isnan(s) else s, r, n) for s, r, n in scores if not math.isnan(r)]


def totals(
    rows: Sequence[Mapping[str, str]], period_s: float, confirming: int = 0
) -> dict[str, Any]:
    """Sum up what a run cost and what it reached, from its rows; empty without rows.

    ``failures``: training episodes, with the human's help, that missed the goal, by outcome.
    ``validation``: best and last success rate, None where it is unknown, and the environment steps
    before the best; in the second set, of ``confirming`` drives, the kept actor's rate with its
    interval.
    ``until``: what was spent until the policy alone first reached each of ``LEARNED``, or None.
    """
    if not rows:
        return {}
    measured = _scores(rows, "validation")
    validation: dict[str, Any] = {}
    if measured:
        kept = max(_scores(rows, "confirmed") or measured)  # Of equal ones the last
        share, _, number = kept
        known = rows[number]["validation_success"] != "nan" or None
        validation = {
            "best": known and float(rows[number]["validation_success"]),
            "best_at_step": int(rows[number]["total_steps"]),
            "last": known and measured[-1][0],
        }
        if confirming and known:
            estimate = success_estimate(round(share * confirming), confirming)
            validation["confirmed"] = dict(zip(Estimate._fields, estimate, strict=True))
    until = {}
    for level in LEARNED:
        there = [number for success, _, number in measured if is_reached(level, success)]
        until[f"{level:g}"] = spent(rows[: there[0] + 1], period_s) if there else None
    return {
        "episodes": len(rows),
        "updates": int(rows[-1]["updates"]),
        **spent(rows, period_s),
        "validation": validation,
        "until": until,
    }
