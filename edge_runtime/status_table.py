"""The reply to the status query as lines for a person."""

from __future__ import annotations

from typing import Any, Callable, Dict, List, Tuple

from edge_runtime.words import printable

_Row = Tuple[str, Callable[[Dict[str, Any]], str]]

# What a row says of a reply; a runtime of an earlier version may not tell all of it.
_ROWS: List[_Row] = [
    ("vehicle", lambda s: f"{s['vehicle_id']}, driver {s['vehicle']}"),
    ("mode", lambda s: _mode(s)),
    ("states", lambda s: f"{s['accepted']} accepted, {s['superseded']} superseded by newer ones"),
    ("vehicle fault", lambda s: s.get("vehicle_fault") or "none"),
    ("rejected", lambda s: _counts(s["rejected"])),
    ("safe stops", lambda s: str(s["safe_stops"])),
    ("deadline misses", lambda s: str(s["deadline_misses"])),
    ("inference", lambda s: _quantiles(s["inference_ms"])),
    ("state to command", lambda s: _quantiles(s.get("command_ms", {}))),
    ("policy", lambda s: f"{s['policy_id'][:12]} ({s['manifest']['scenario']})"),
    ("uptime", lambda s: f"{s['uptime_s']:.0f} s"),
    ("temperature", lambda s: _temperature(s.get("temperature_c"))),
    ("load", lambda s: f"{s.get('load_1min', 0.0):.2f} over 1 min"),
    ("memory", lambda s: f"{s.get('rss_mb', 0.0):.0f} MB"),
    ("other runtimes", lambda s: f"{s.get('rivals', 0)} seen with this vehicle id"),
    ("version", lambda s: str(s["version"])),
]


def render_status(status: Dict[str, Any]) -> str:
    """One line for each row; `status` is the reply of the queryable."""
    width = max(len(label) for label, _ in _ROWS)
    return "\n".join(f"{label:<{width}}  {printable(say(status))}" for label, say in _ROWS)


def _mode(status: Dict[str, Any]) -> str:
    reason = f", because of {status['reason']}" if status["reason"] else ""
    rearm = "; waits for `rearm`" if status["needs_rearm"] else ""
    return f"{status['mode']}{reason}{rearm}"


def _counts(counts: Dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items())) or "none"


def _quantiles(summary: Dict[str, float]) -> str:
    return ", ".join(f"{label} {value:.2f} ms" for label, value in summary.items()) or "unknown"


def _temperature(value_c: Any) -> str:
    return "no sensor" if value_c is None else f"{value_c:.0f} degC"
