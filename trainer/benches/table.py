"""The figures as a table for a person."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table

SB3_BAR, TRAINING_BAR, REPLAY_BAR_MB = 4.0, 1.15, 400.0
"""At least as many times Stable-Baselines3's updates; at most as many times the learner alone; at
most."""
ENVIRONMENT_BARS = {"left_turn": 10.0, "congestion": 8.0}
"""At least as many times highway-env's steps."""

SB3 = "stable_baselines3"
PEERS = {
    "ours_float32": "the same in float32",
    "reference": "plain eager version",
    SB3: "Stable-Baselines3 TD3",
    "highway_env_grayscale": "highway-env grayscale",
}
FILE_WIDTH = 120
WITHOUT_SB3 = "Stable-Baselines3 TD3: left out, no --peers"


class Row(NamedTuple):
    """One line."""

    what: str
    ours: str
    peer: str = ""
    ratio: str = ""
    bar: str = ""


def rows(report: dict[str, Any]) -> list[Row]:
    """The lines of what was measured."""
    parts = {
        "learner": _learner,
        "environment": _environment,
        "training": _training,
        "replay": _replay,
        "memory": _memory,
    }
    return [row for name, lines in parts.items() if name in report for row in lines(report[name])]


def show(report: dict[str, Any]) -> None:
    """Print the table to stdout."""
    cores = f"{report['machine']['cores']} cores"
    title = f"{report['machine']['processor']}, {cores}, threads: {report['threads']}"
    table = Table(title=title, box=box.SIMPLE, title_justify="left")
    for name in Row._fields:
        number = name in ("ours", "ratio")
        table.add_column(name, no_wrap=number, justify="right" if number else "left")
    for row in rows(report):
        table.add_row(*row)
    # A file has no width; rich would fold its lines at 80.
    width = None if sys.stdout.isatty() else FILE_WIDTH
    Console(markup=False, highlight=False, width=width).print(table)


def _learner(figures: dict[str, Any]) -> Iterator[Row]:
    ours_ms = figures["ms_per_update"]
    what = f"PHIL-TD3 update, batch {figures['batch_size']}, ms"
    for name, peer in figures["peers"].items():
        yield Row(
            what,
            f"{ours_ms:.1f}",
            f"{peer['ms_per_update']:.1f}  {PEERS[name]}",
            _times(peer["ratio"]),
            _bar(f"≥ {SB3_BAR:g}", peer["ratio"]["of_medians"] >= SB3_BAR) if name == SB3 else "",
        )
    if SB3 not in figures["peers"]:
        yield Row(what, f"{ours_ms:.1f}", WITHOUT_SB3)
    yield Row("updates/s", f"{figures['updates_per_s']:.1f}")


def _environment(figures: dict[str, Any]) -> Iterator[Row]:
    for scenario, figure in figures.items():
        bar = ENVIRONMENT_BARS[scenario]
        for name, peer in figure["peers"].items():
            ratio = peer["ratio"]["of_medians"]
            yield Row(
                f"{scenario} with observation, steps/s",
                f"{figure['steps_per_s']:.0f}",
                f"{peer['steps_per_s']:.0f}  {PEERS[name]}",
                _times(peer["ratio"]),
                _bar(f"≥ {bar:g}", ratio >= bar),
            )


def _training(figures: dict[str, Any]) -> Iterator[Row]:
    seconds, ratio = figures["s_per_10k_steps"], figures["ratio_to_learner_alone"]["of_sums"]
    yield Row(
        "training, s per 10,000 steps",
        f"{seconds['total']:.1f}",
        f"{figures['learner_alone_s_per_10k_updates']:.1f}  learner alone",
        f"{ratio:.3f}",
        _bar(f"≤ {TRAINING_BAR:g}", ratio <= TRAINING_BAR),
    )
    for name, value in seconds.items():
        if name != "total":
            yield Row(f"  of it {name}", f"{value:.1f}")


def _replay(figures: dict[str, Any]) -> Iterator[Row]:
    held = f"replay of {figures['transitions']:,}"
    for what, key in (
        (f"draw {figures['batch_size']}", "sample_ms"),
        (f"{figures['batch_size']} priorities", "update_priorities_ms"),
        ("add one", "add_ms"),
    ):
        yield Row(f"{held}: {what}, ms", f"{figures[key]:.3f}")
    # Pages that were never written to are allocated, but not resident.
    most_mb = max(figures["allocated_mb"], figures["resident_mb"])
    yield Row(
        f"{held}: memory, MB",
        f"{most_mb:.0f}",
        bar=_bar(f"< {REPLAY_BAR_MB:g}", most_mb < REPLAY_BAR_MB),
    )


def _memory(figures: dict[str, Any]) -> Iterator[Row]:
    what = f"training of {figures['steps']} steps: peak memory, MB"
    yield Row(what, f"{figures['training_peak_mb']:.0f}")


def _times(ratio: dict[str, float]) -> str:
    return f"{ratio['of_medians']:.2f}"


def _bar(bar: str, met: bool) -> str:
    return f"{bar}  {'met' if met else 'MISSED'}"
