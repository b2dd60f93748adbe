"""The fault table as Markdown, the one that the README shows. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_HEAD = ("fault", "expected", "tries", "reaction, ms", "limit", "recovery, ms", "limit", "verdict")


def render_faults(report: Mapping[str, Any]) -> str:
    """A row for each fault; reaction and recovery as min / median / max over its tries."""
    lines = ["| " + " | ".join(_HEAD) + " |", "|---" * len(_HEAD) + "|"]
    for row in report["rows"]:
        cells = (
            row["done"],
            row["expected"],
            str(row["tries"]) + (f" (+{row['disturbed']} again)" if row["disturbed"] else ""),
            _spread(row["reaction_ms"]),
            _limit(row["reaction_limit_ms"]),
            _spread(row["recovery_ms"]),
            _limit(row["recovery_limit_ms"]),
            verdict(row),
        )
        lines.append("| " + " | ".join(cells) + " |")
    lines.append("")
    lines.append(
        f"{report['crashes']} crashes and {report['unsafe_commands']} unsafe commands "
        f"over the whole campaign."
    )
    return "\n".join(lines)


def verdict(row: Mapping[str, Any]) -> str:
    """``met``, or what was not."""
    faults = []
    if row["reactions_late"]:
        faults.append(f"{row['reactions_late']} reactions late")
    if row["recoveries_late"]:
        faults.append(f"{row['recoveries_late']} recoveries late")
    for name in ("unsafe", "crashes", "wrong"):
        if row[name]:
            faults.append(f"{len(row[name])} {name}")
    counted = sum(row["rejected"].values())
    met = f"met, {counted:,} rejected and counted" if counted else "met"
    return "MISSED: " + ", ".join(faults) if faults else met


def _spread(spread: Mapping[str, float] | None) -> str:
    if spread is None:
        return "-"
    return " / ".join(f"{spread[name]:.0f}" for name in ("min", "median", "max"))


def _limit(limit_ms: float | None) -> str:
    return "-" if limit_ms is None else f"{limit_ms:.0f}"
