"""The report as Markdown. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_HEAD = (
    "value", "success", "95 %", "surviving distance, m", "collisions", "safe stops an episode",
    "ticks without a new command", "latency p50 / p99, ms",
)  # fmt: skip


def render_latency(
    latency: Mapping[str, Any],
    figures: Mapping[str, str],
    others: Mapping[str, Mapping[str, Any]],
) -> str:
    """Sentences of the budgets, pictures, what real time says, and a table for each axis."""
    lines = _budgets(latency, figures, others) if latency["axes"] else []
    if latency["realtime_check"]:
        lines += [*_realtime(latency["realtime_check"]), ""]
    for axis in latency["axes"]:
        lines += [*_table(axis, latency["rows"]), ""]
    return "\n".join(lines)


def _budgets(
    latency: Mapping[str, Any], figures: Mapping[str, str], others: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    sentences = [part["budget"]["sentence"] for part in (latency, *others.values())]
    speed = f"{latency['faster_than_real_time']:.1f} times real time in each worker"
    return [
        *(f"{sentence}\n" for sentence in sentences),
        "A limit is the largest tested value up to which, at every tested value, the share of "
        f"successes over {latency['runs']} episodes (the same seeds in every row) is at the "
        f"target; nothing is interpolated. Clock: {latency['clock']}, {speed}, the start of each "
        "simulator included.",
        "",
        *(f"![{name}]({path})\n" for name, path in figures.items()),
    ]


def _realtime(check: Mapping[str, Any]) -> list[str]:
    verdict = "agree" if check["agree"] else "do NOT all agree"
    lines = [
        f"Real and virtual time {verdict} within their intervals "
        f"({check['runs']} episodes, the same seeds):",
        "",
        *_head("network", "virtual", "real", "safe stops an episode: virtual", "real", "agree"),
    ]
    for row in check["rows"]:
        stops = (row[f"{clock}_safe_stops_per_episode"] for clock in ("virtual", "real"))
        cells = (
            f"`{row['spec']}`", share(row["virtual"]), share(row["real"]),
            *(f"{stop:.2f}" for stop in stops), "yes" if row["agree"] else "**no**",
        )  # fmt: skip
        lines.append(_line(cells))
    return lines


def _table(axis: Mapping[str, Any], rows: Mapping[str, Any]) -> list[str]:
    lines = [f"### {axis['title'][0].upper()}{axis['title'][1:]}", "", *_head(*_HEAD)]
    for value, spec in zip(axis["values"], axis["specs"], strict=True):
        row = rows[spec]
        success, distance, latency = (
            row["success"], row["surviving_distance_m"], row["latency_ms"],
        )  # fmt: skip
        p50, p99 = (
            "-" if latency[name] is None else f"{latency[name]:.0f}" for name in ("p50", "p99")
        )
        cells = (
            f"{value:g} {axis['unit']}",
            f"{success['value']:.0%}",
            f"{success['low']:.0%} to {success['high']:.0%}",
            f"{distance['value']:.2f} ({distance['low']:.2f} to {distance['high']:.2f})",
            f"{row['collision_rate']:.0%}",
            f"{row['safe_stops_per_episode']:.2f}",
            f"{row['ticks_without_new_command']:.0%}",
            f"{p50} / {p99}",
        )
        lines.append(_line(cells))
    return lines


def share(estimate: Mapping[str, float]) -> str:
    """As in "95 % (83 to 99)"."""
    return f"{estimate['value']:.0%} ({estimate['low']:.0%} to {estimate['high']:.0%})"


def _head(*names: str) -> list[str]:
    return [_line(names), "|---" * len(names) + "|"]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
