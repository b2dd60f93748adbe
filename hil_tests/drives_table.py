"""The table that ends a demo: how each of its drives went."""

from __future__ import annotations

from typing import Any

from rich.table import Table

COLUMNS = ("drive", "success", "distance, m", "p50, ms", "p99, ms", "safe stops")


def drives_table(reports: dict[str, dict[str, Any]]) -> Table:
    """A row for each report, under its name."""
    table = Table(title="Left turn, the same seeds; latency from state sent to command received")
    for column in COLUMNS:
        table.add_column(column, justify="left" if column == COLUMNS[0] else "right")
    for name, report in reports.items():
        table.add_row(name, *_cells(report))
    return table


def _cells(report: dict[str, Any]) -> list[str]:
    distance, latency = report["surviving_distance_m"], report.get("latency_ms")
    return [
        f"{report['success_rate']:.0%}",
        f"{distance['mean']:.2f} ± {distance['std']:.2f}",
        f"{latency['p50']:.1f}" if latency else "-",
        f"{latency['p99']:.1f}" if latency else "-",
        str(report.get("safe_stops", "-")),
    ]
