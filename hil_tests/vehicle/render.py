"""The report as Markdown. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hil_tests.campaign.render import share
from hil_tests.vehicle.rigs import LOOPS, VEHICLE


def verdict(comparison: Mapping[str, Any]) -> str:
    """The bar in one sentence."""
    row = comparison["rows"][VEHICLE]
    met = "is met" if comparison["holds"] else "is NOT met"
    return (
        f"With the vehicle in the loop {comparison['scenario']} succeeds in "
        f"{share(row['success'])} of {row['episodes']} episodes: "
        f"the bar of {comparison['target_success']:.0%} {met}."
    )


def lag_sentence(sweep: Mapping[str, Any]) -> str:
    """The lag budget by the sum of dead time and time constant, and by the lag measured."""
    found = sweep["lag_budget"]
    goal = f"at least {found['target_success']:.0%} success"
    if found["all_hold"]:
        return f"The policy holds {goal} at every lag that was tested."
    if found["sum_ms"] is None:
        return f"The policy is below {found['target_success']:.0%} success at the least lag tested."
    measured = "" if found["measured_ms"] is None else f" (measured: {found['measured_ms']:.0f} ms)"
    return (
        f"The policy holds {goal} at every tested point whose dead time and time constant sum up "
        f"to {found['sum_ms']:g} ms or less{measured}."
    )


def render_comparison(comparison: Mapping[str, Any]) -> str:
    """The verdict, a column for each loop, and what the vehicle was like."""
    rows = [comparison["rows"][loop] for loop in LOOPS]
    longer = comparison["cost"]
    lines = [
        verdict(comparison),
        "",
        f"Where both reach the goal ({longer['seeds']} seeds), the drive takes "
        f"{_interval(longer['longer_s'], 2)} s longer with the vehicle.",
        "",
        "| | policy in the loop | vehicle in the loop |",
        "|---|---|---|",
        *(_line(name, [tell(row) for row in rows]) for name, tell in _ROWS),
    ]
    return "\n".join(lines)


def render_sweep(sweep: Mapping[str, Any], figures: Mapping[str, str]) -> str:
    """The sentences, the pictures, and the table: success, measured lag, stops of the driver."""
    rows = list(sweep["rows"].values())
    dead = sorted({row["dead_ms"] for row in rows})
    constant = sorted({row["constant_ms"] for row in rows})
    sentences = [lag_sentence(sweep)]
    if sweep["budget"]:
        sentences.append(sweep["budget"]["sentence"])
    head = ["time constant \\ dead time, ms", *(str(value) for value in dead)]
    lines = [
        *(f"{sentence}\n" for sentence in sentences),
        *(f"![{name}]({path})\n" for name, path in figures.items()),
        f"Success of {sweep['runs']} episodes, and in brackets the lag of the speed that the "
        "drives showed, ms; a star where the driver stopped the vehicle, which did not follow:",
        "",
        "| " + " | ".join(head) + " |",
        "|---" * len(head) + "|",
    ]
    for value in constant:
        by_dead = {row["dead_ms"]: row for row in rows if row["constant_ms"] == value}
        cells = [_point(by_dead[ms]) if ms in by_dead else "-" for ms in dead]
        lines.append("| " + " | ".join([str(value), *cells]) + " |")
    return "\n".join(lines)


def _point(row: Mapping[str, Any]) -> str:
    star = "*" if row["stops"] else ""
    return f"{row['success']['value']:.0%}{star} ({_number(row['lag_ms'], 0)})"


def _line(name: str, cells: Sequence[str]) -> str:
    return f"| {name} | " + " | ".join(cells) + " |"


def _interval(estimate: Mapping[str, float], digits: int) -> str:
    value, low, high = (f"{estimate[name]:.{digits}f}" for name in ("value", "low", "high"))
    return f"{value} ({low} to {high})"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _pair(found: Mapping[str, float | None], digits: int, names: Sequence[str]) -> str:
    return " / ".join(_number(found[name], digits) for name in names)


def _of_vehicle(row: Mapping[str, Any], tell: Any) -> str:
    return "-" if row["vehicle"] is None else str(tell(row["vehicle"]))


def _errors(vehicle: Mapping[str, Any]) -> str:
    errors = vehicle["action_error"].items()
    return ", ".join(f"{name} {_pair(error, 2, ('rmse', 'max'))}" for name, error in errors)


def _lags(vehicle: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {_number(lag, 0)}" for name, lag in vehicle["lag_ms"].items())


_ROWS: list[tuple[str, Any]] = [
    ("episodes", lambda row: str(row["episodes"])),
    ("success (95 %)", lambda row: share(row["success"])),
    ("collisions", lambda row: f"{row['collision_rate']:.0%}"),
    ("surviving distance, m (95 %)", lambda row: _interval(row["surviving_distance_m"], 2)),
    ("time, s", lambda row: f"{row['episode_time_s']:.2f}"),
    ("latency p50 / p99, ms", lambda row: _pair(row["latency_ms"], 1, ("p50", "p99"))),
    ("safe stops an episode", lambda row: f"{row['safe_stops_per_episode']:.2f}"),
    (
        "speed error rmse / max, m/s of the vehicle",
        lambda row: _of_vehicle(row, lambda v: _pair(v["speed_error_mps"], 3, ("rmse", "max"))),
    ),
    ("action error rmse / max", lambda row: _of_vehicle(row, _errors)),
    ("actuator lag, ms", lambda row: _of_vehicle(row, _lags)),
    (
        "feedback age p50 / p99, ms",
        lambda row: _of_vehicle(row, lambda v: _pair(v["feedback_age_ms"], 1, ("p50", "p99"))),
    ),
    ("metres of the vehicle for one of the scenario", lambda row: _of_vehicle(row, _scale)),
]


def _scale(vehicle: Mapping[str, Any]) -> str:
    return _number(vehicle["scale"], 3)
