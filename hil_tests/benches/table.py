"""The bars, and the figures as a table for a person."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table

RATIO_BAR, MEMORY_BAR_MB, FLAT_BAR_MB, IDLE_BAR, START_BAR_S, LOCKSTEP_BAR = (
    1.25, 110.0, 1.0, 0.02, 1.5, 30.0,
)  # fmt: skip
"""At most as many times the floor; at most; at most growth; of a core; s; times real time."""
WIDTH = 110


class Line(NamedTuple):
    """One line."""

    what: str
    ours: str
    floor: str = ""
    ratio: str = ""
    bar: str = ""


def lines(report: Mapping[str, Any]) -> list[Line]:
    """The lines of what was measured."""
    return [
        *_latency(report["latency"]["latency_ms"]),
        *_process(report["process"]),
        *_lockstep(report["lockstep"]),
    ]


def show(report: Mapping[str, Any]) -> None:
    """Print the table."""
    machine = report["machine"]
    title = (
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load_before']:.1f} "
        f"before and {machine['load_after']:.1f} after"
    )
    table = Table(title=title, box=box.SIMPLE, title_justify="left")
    for name in Line._fields:
        table.add_column(name, justify="left" if name in ("what", "bar") else "right")
    for line in lines(report):
        table.add_row(*line)
    Console(markup=False, highlight=False, width=WIDTH).print(table)


def _latency(quantiles: Mapping[str, Any]) -> Iterator[Line]:
    for name, row in quantiles.items():
        low, high = row["interval"]
        yield Line(
            f"state sent to command received, {name}, ms",
            f"{row['ours']:.3f}",
            f"{row['floor']:.3f}",
            f"{row['ratio']:.2f} [{low:.2f}, {high:.2f}]",
            _bar(f"≤ {RATIO_BAR:g} times", row["ratio"] <= RATIO_BAR),
        )


def _process(process: Mapping[str, Any]) -> Iterator[Line]:
    ours, floor = process["memory_mb"], process["floor_memory_mb"]
    yield Line(
        "memory after start, MB",
        f"{ours['start']:.1f}",
        f"{floor['start']:.1f}",
    )
    yield Line(
        f"memory after {ours['steps']:,} steps, MB",
        f"{ours['end']:.1f}",
        f"{floor['end']:.1f} ({floor['steps']:,})",
        bar=_bar(f"< {MEMORY_BAR_MB:g}", ours["end"] < MEMORY_BAR_MB),
    )
    grown_mb = ours["grown_after_first_tenth"]
    yield Line(
        "  growth after the first tenth, MB",
        f"{grown_mb:.2f}",
        f"{floor['grown_after_first_tenth']:.2f}",
        bar=_bar(f"< {FLAT_BAR_MB:g}", grown_mb < FLAT_BAR_MB),
    )
    idle = process["idle_load"]
    yield Line(
        "idle, part of a core", f"{idle:.2%}", bar=_bar(f"< {IDLE_BAR:.0%}", idle < IDLE_BAR)
    )
    start_s = process["first_command_s"]["median"]
    yield Line(
        f"process start to first command, s (median of {process['first_command_s']['starts']})",
        f"{start_s:.2f}",
        bar=_bar(f"< {START_BAR_S:g}", start_s < START_BAR_S),
    )


def _lockstep(lockstep: Mapping[str, Any]) -> Iterator[Line]:
    times = lockstep["times_real_time"]
    yield Line(
        f"lock-step, {lockstep['scenario']}: times real time",
        f"{times:.1f}",
        bar=_bar(f"≥ {LOCKSTEP_BAR:g}", times >= LOCKSTEP_BAR),
    )


def _bar(bar: str, met: bool) -> str:
    return f"{bar}  {'met' if met else 'MISSED'}"
