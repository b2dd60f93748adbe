"""The report of ``bridge simulate``: the contract's keys, and what explains them. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from bridge.safe_stops import SafeStopEvent
from edge_runtime.episode_report import GOAL, EpisodeResult, summarise
from edge_runtime.util import counted, printable

QUANTILES = {"p50": 50, "p90": 90, "p99": 99, "max": 100}


def quantiles(values_ms: Sequence[float]) -> dict[str, float | None]:
    """Return p50, p90, p99 and max of times in ms; None each if there are none."""
    if not values_ms:
        return dict.fromkeys(QUANTILES)
    found = np.percentile(values_ms, list(QUANTILES.values()))
    return dict(zip(QUANTILES, map(float, found), strict=True))


def rejections(by_edge: Mapping[str, int], by_simulator: Mapping[str, int]) -> dict[str, Any]:
    """Return the report's counts of rejected messages by reason: of each side, and the sum."""
    return {
        "rejected": dict(Counter(by_edge) + Counter(by_simulator)),
        "rejected_by_edge": dict(by_edge),
        "rejected_by_simulator": dict(by_simulator),
    }


def make_report(
    results: Sequence[EpisodeResult],
    safe_stop_events: Sequence[SafeStopEvent],
    latencies_ms: Sequence[float],
    command_ages_ms: Sequence[float],
    counts: Mapping[str, Any],
    settings: Mapping[str, Any],
    vehicle: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Join the summary of the episodes with what happened on the wire.

    ``settings`` holds scenario, condition, policy_ids, seed, clock, loop, standing, latency_spec
    and wall_s; ``vehicle`` is the part of a vehicle in the loop;
    ``counts`` holds deadline_misses, tick_overruns, missed_ticks, edge_changes,
    wall_clock_stalls and ``rejections``. The report's policy_id is that of the policy that
    answered last.
    """
    return {
        **summarise(
            results,
            scenario=settings["scenario"],
            condition=settings["condition"],
            policy_id=settings["policy_ids"][-1] if settings["policy_ids"] else "",
            seed=settings["seed"],
        ),
        "policy_ids": list(settings["policy_ids"]),
        "latency_ms": quantiles(latencies_ms),
        "answered_states": len(latencies_ms),
        "command_age_ms": quantiles(command_ages_ms),
        **counts,
        "safe_stops": len(safe_stop_events),
        **{name: settings[name] for name in ("clock", "loop", "standing")},
        "latency_spec": settings["latency_spec"],
        "wall_s": settings["wall_s"],
        "vehicle": vehicle,
        "times_real_time": sum(result.time_s for result in results) / settings["wall_s"],
        "safe_stop_events": [asdict(event) for event in safe_stop_events],
        "per_episode": [result.as_dict() for result in results],
    }


def summary_line(report: Mapping[str, Any]) -> str:
    """Return the report in one line for a terminal.

    Ticks without a new command are not in it: those of a stop are told as that, and of the others
    the latency tells.
    """
    latency = report["latency_ms"]
    times = "no command came"
    if latency["p50"] is not None:
        times = f"latency p50 {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms"
    outcomes = Counter({GOAL: 0})
    outcomes.update(row["outcome"] for row in report["per_episode"])
    ends = (
        f"{count} {name} ({count / report['episodes']:.0%})" for name, count in outcomes.items()
    )
    stops = Counter(event["reason"] for event in report["safe_stop_events"])
    vehicle = "" if report["vehicle"] is None else f"; {_vehicle_words(report['vehicle'])}"
    return printable(
        f"{counted(report['episodes'], 'episode')}: {', '.join(ends)}; {times}; "
        f"{_reasons('safe stop', stops)}; "
        f"{_reasons('rejected message', report['rejected'])}{vehicle}"
    )


def episode_line(
    number: int, episodes: int, result: EpisodeResult, stops: Sequence[SafeStopEvent]
) -> str:
    """Return what became of an episode, as in "episode 2 of 5: goal after 12.3 s"."""
    reasons = Counter(event.reason for event in stops)
    braked = f"; {_reasons('safe stop', reasons)}" if reasons else ""
    return printable(
        f"episode {number} of {episodes}: {result.outcome} after {result.time_s:.1f} s{braked}"
    )


def _reasons(noun: str, counts: Mapping[str, int]) -> str:
    """As in "3 safe stops (2 no_command, 1 vehicle_fault)"."""
    each = ", ".join(f"{count} {reason}" for reason, count in counts.items() if count)
    return counted(sum(counts.values()), noun) + (f" ({each})" if each else "")


def _vehicle_words(vehicle: Mapping[str, Any]) -> str:
    """As in "hunter: lag speed 135 ms, pedal 160 ms"."""
    told = {name: lag for name, lag in vehicle["lag_ms"].items() if lag is not None}
    lags = ", ".join(f"{name} {lag:.0f} ms" for name, lag in told.items())
    return f"{vehicle['name']}: lag {lags or 'not measured'}"
