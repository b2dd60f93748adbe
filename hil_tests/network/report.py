"""The comparison as a table in Markdown and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_runtime.files import write_atomic

NAMES = {
    "tcp": "Zenoh on TCP",
    "udp": "Zenoh on UDP",
    "udp_jumbo": "UDP, one packet a state",
    "relay": "bridge relay",
    "virtual": "virtual time",
}
HEAD = ("network, each way", "through", "p50", "p90", "p99", "max", "unanswered", "safe stops",
        "success", "failed starts")  # fmt: skip

MOST_UNANSWERED_PERCENT = 50.0


def write_report(result: dict[str, Any], folder: Path) -> None:
    """Write table.md and quantiles.png into an existing folder."""
    write_atomic(folder / "table.md", table(result).encode())
    draw(result, folder / "quantiles.png")


def table(result: dict[str, Any]) -> str:
    """The rows in Markdown; round trips in ms, from state sent to command received."""
    lines = [f"| {' | '.join(HEAD)} |", f"|{'---|' * len(HEAD)}"]
    for row in result["rows"]:
        lines.append(f"| {' | '.join(_cells(row))} |")
    return "\n".join(lines) + "\n"


def _cells(row: dict[str, Any]) -> list[str]:
    begin = [f"`{row['latency_spec']}`", NAMES[row["transport"]]]
    failed = str(len(row["failed_starts"]))
    if "round_trip_ms" not in row:
        return [*begin, *["-"] * (len(HEAD) - 3), failed]
    times = row["round_trip_ms"]
    return [
        *begin,
        *("-" if times[name] is None else f"{times[name]:.0f}" for name in times),
        f"{row['unanswered_percent']:.1f} %",
        str(row["safe_stops"]),
        f"{row['success_rate']:.0%}",
        failed,
    ]


def _has_times(row: dict[str, Any]) -> bool:
    """Whether any state was answered: a loop may never start, and a link may come up half dead."""
    return row.get("round_trip_ms", {}).get("p50") is not None


def _annotate(axes: Any, place: float, high_ms: float, unanswered_percent: float) -> None:
    """Quick answers are worth little where few states have one: then in red."""
    dead = unanswered_percent > MOST_UNANSWERED_PERCENT
    axes.annotate(
        f"{unanswered_percent:.0f}%", (place, high_ms), textcoords="offset points", xytext=(0, 6),
        ha="center", fontsize=7, color="red" if dead else "0.3", weight="bold" if dead else None,
    )  # fmt: skip


def draw(result: dict[str, Any], path: Path) -> None:
    """Median to p99 of every cell, grouped by network."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    networks = list(dict.fromkeys(row["latency_spec"] for row in result["rows"]))
    ways = list(dict.fromkeys(row["transport"] for row in result["rows"]))
    figure, axes = plt.subplots(figsize=(9, 4.2), layout="constrained")
    for number, way in enumerate(ways):
        rows = [row for row in result["rows"] if row["transport"] == way and _has_times(row)]
        places = [networks.index(row["latency_spec"]) + 0.15 * number for row in rows]
        p50, p90, p99 = (
            [row["round_trip_ms"][name] for row in rows] for name in ("p50", "p90", "p99")
        )
        (line,) = axes.plot(places, p50, "o", label=NAMES[way])
        axes.vlines(places, p50, p99, colors=line.get_color(), linewidth=2)
        axes.plot(places, p90, "_", color=line.get_color(), markersize=9)
        axes.plot(places, p99, "^", color=line.get_color(), markersize=5)
        for place, high, row in zip(places, p99, rows, strict=True):
            _annotate(axes, place, high, row["unanswered_percent"])
    axes.axhline(200, color="grey", linestyle=":", linewidth=1)
    axes.annotate("2 T = 200 ms: safe stop", (0, 200), textcoords="offset points", xytext=(0, 3))
    axes.set_yscale("log")
    axes.margins(y=0.12)
    axes.set_title("round trips of what was answered; above: states without an answer", fontsize=9)
    axes.set_ylabel("state sent to command received, ms\n(circle p50, dash p90, triangle p99)")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    names = [name.replace(",", "\n") for name in networks]
    axes.set_xticks([place + 0.3 for place in range(len(networks))], names, fontsize=8)
    axes.legend(fontsize=8)
    temporary = path.with_name(f".{path.name}")
    figure.savefig(temporary, format="png", dpi=120)
    plt.close(figure)
    temporary.replace(path)
