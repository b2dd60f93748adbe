"""A run's metrics: one row per episode, with running totals, in CSV and TensorBoard."""

import csv
import io
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import pandas as pd
from torch.utils.tensorboard import SummaryWriter

from bridge.outcomes import failed, settled, success_share
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError, read_bytes
from trainer.util import fitting

NAN = float("nan")
METRICS_FILE = "metrics.csv"
LEARNED = (0.9, 0.98)
"""Success rates in validation; the human seconds until each are reported."""


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
    """Time that the loop waited for an update after the environment's step was done."""
    validation_success: float = NAN
    """Success rate on the validation seeds (nan: no validation after this episode, or nothing tells
    whether a drive succeeded)."""
    validation_distance_m: float = NAN
    validation_reward: float = NAN
    """Mean return of the validation (nan: none); at equal success rates it decides which actor is
    kept."""
    confirmed_success: float = NAN
    """Success rate on the second set of seeds (nan: not driven, since the first was worse)."""
    confirmed_reward: float = NAN


KINDS: dict[str, Any] = {f.name: f.type for f in fields(EpisodeMetrics)}
NAMES = [*KINDS]


class MetricsWriter:
    """Appends rows; a resumed run first drops the rows after its checkpoint. ``period_s`` is T."""

    def __init__(self, run_dir: Path, from_episode: int = 0, period_s: float = 0.1) -> None:
        path, self._period_s = run_dir / METRICS_FILE, period_s
        self._rows = read_metrics(run_dir)[:from_episode]
        if len(self._rows) < from_episode:
            raise UserError(f"{path} lacks episodes before the checkpoint: {from_episode}")
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
        rows = [*self._rows, asdict(metrics)]
        human_steps, takeovers = (sum(int(row[name]) for row in rows)
                                  for name in ("human_steps", "interventions"))  # fmt: skip
        metrics.total_human_s = round(human_steps * self._period_s, 6)
        metrics.total_takeovers = takeovers
        metrics.total_failures = sum(map(failed, settled(row["outcome"] for row in rows)))
        rows[-1] = asdict(metrics)
        metrics.human_s_to_90, metrics.human_s_to_98 = (
            next((float(row["total_human_s"]) for row in rows
                  if is_reached(level, float(row["validation_success"]))), NAN)
            for level in LEARNED
        )  # fmt: skip
        row = asdict(metrics)
        self._rows.append(row.copy())
        self._csv.writerow(row)
        self._file.flush()
        os.fsync(self._file.fileno())  # No power cut leaves a checkpoint without its rows.
        row["success"] = success_share([metrics.outcome])
        for name, value in row.items():
            if isinstance(value, (int, float)) and value == value:
                self._board.add_scalar(name, value, metrics.episode)

    def close(self) -> None:
        self._file.close()
        self._board.close()


def read_metrics(run_dir: Path) -> list[dict[str, str]]:
    """Read the rows of a run; none without a file.

    A row cut off at the end is left out: a checkpoint is written only after its row is complete.
    Raises UserError for a file that is damaged, or not of this project.
    """
    path = run_dir / METRICS_FILE
    if not path.exists():
        return []
    with fitting(f"{path} is no metrics of a training, or damaged"):
        # Split as csv does: an outcome may hold other line ends of `str.splitlines`.
        complete, end, _ = read_bytes(path, "metrics").rpartition(b"\n")
        text = io.StringIO((complete + end).decode(), newline="")
        rows = list(csv.DictReader(text, strict=True))
        for number, row in enumerate(rows):
            values = {name: KINDS[name](text) for name, text in row.items()}
            if [*row] != NAMES or values["episode"] != number:
                raise ValueError(row)
    return rows


def metrics_table(run_dir: Path) -> pd.DataFrame:
    """Return a run's rows as numbers, and the outcome as text."""
    return pd.DataFrame(read_metrics(run_dir), columns=NAMES).astype(KINDS)


def is_reached(level: float, success: float) -> bool:
    """Return whether a success rate reaches a level, up to rounding."""
    return success >= level - 1e-9
