"""Results of episodes, safe stops, and the report with the contract's keys (section 2).

`EpisodeResult` and `summarise` serve driving in process (trainer) and over the wire (bridge); the
rest is for ``bridge simulate``. `TrackingLog` measures how well a vehicle in the loop follows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bridge.outcomes import COLLISION, GOAL, UNTOLD, settled
from bridge.virtual_link import BRAKE_PERIODS, NO_COMMAND, Decision
from edge_runtime.util import counted, printable
from edge_runtime.wire import Command, Feedback

ACCELERATIONS = ("lateral_acceleration_mps2", "longitudinal_acceleration_mps2")
QUANTITIES = {
    "surviving_distance_m": "distance_m",
    "episode_reward": "reward",
    "episode_time_s": "time_s",
    **{name: name for name in ACCELERATIONS},
}
"""Key of the report to field of `EpisodeResult`."""


@dataclass
class EpisodeResult:
    """One driven episode.

    `outcome` is as in the contract for this repository's environments; another environment may
    report its own word, FAILED, TRUNCATED or UNKNOWN. Accelerations are the mean of |a| over the
    episode's steps, None where they are unknown. `actions` holds for each step the action that the
    environment was given, as floats.
    """

    seed: int
    outcome: str
    distance_m: float
    reward: float
    time_s: float
    lateral_acceleration_mps2: float | None
    longitudinal_acceleration_mps2: float | None
    steps: int
    actions: list[list[float]] = field(default_factory=list)


def summarise(
    results: Sequence[EpisodeResult], scenario: str, condition: str, policy_id: str, seed: int
) -> dict[str, Any]:
    """Settle the outcomes of `results` and return the contract's summary.

    `std` is over the episodes (population, ddof 0). Mean and deviation are None for a quantity that
    no episode reports.
    """
    for result, outcome in zip(results, settled(r.outcome for r in results), strict=True):
        result.outcome = outcome
    outcomes = Counter(result.outcome for result in results)
    columns = {key: [getattr(row, name) for row in results] for key, name in QUANTITIES.items()}
    return {
        "scenario": scenario,
        "condition": condition,
        "episodes": len(results),
        "success_rate": outcomes[GOAL] / len(results) if outcomes.keys() - UNTOLD else None,
        "collision_rate": outcomes[COLLISION] / len(results),
        **{
            key: {"mean": of_known(values), "std": of_known(values, np.std)}
            for key, values in columns.items()
        },
        "policy_id": policy_id,
        "seed": seed,
    }


def of_known(values: Iterable[float | None], figure: Any = np.mean) -> float | None:
    """Return the figure of the values that are not None; None if all are."""
    known = [value for value in values if value is not None]
    return float(figure(known)) if known else None


STANDSTILL_MPS = 0.05


@dataclass
class SafeStopEvent:
    """One unbroken stretch of braking; its fields are those of the report."""

    episode: int
    step: int  # The first tick in which the vehicle braked
    reason: str
    """``no_command`` if the simulator braked by itself, else the edge runtime's reason; with a
    vehicle in the loop also ``no_feedback`` and ``self_braking``."""
    brake_after_s: float
    """From the last ``drive`` command to the brake (in lock-step: wall time if the edge runtime
    does not answer, virtual time otherwise)."""
    stopped_after_s: float | None = None
    """From the brake to standstill, simulated time; None if it never stood."""
    resumed_after_s: float | None = None
    """From the brake until it drove again, simulated time; None if the episode ended first."""


class SafeStopLog:
    """Collects the events of a whole run.

    The car also brakes after 2 T without the first command of an episode. Where one of the first
    states is answered, that was a round trip and is no stop.
    """

    def __init__(self, period_s: float) -> None:
        self.events: list[SafeStopEvent] = []
        self._period_s = period_s
        self._open: SafeStopEvent | None = None
        self._waits = False  # In all of the open event the first command may have been under way

    def observe(self, episode: int, step: int, decision: Decision, speed_mps: float) -> None:
        """Note one tick: what was decided at ``step``, and the speed at the tick's end (m/s)."""
        event, command = self._open, decision.command
        if command is None:
            self._waits &= decision.waits
        elif self._waits and event is not None and event.episode == episode:
            self._waits = False
            if command.step <= BRAKE_PERIODS:
                self.events.remove(event)
                self._open = event = None
        if event is not None and not (decision.brake_reason and event.episode == episode):
            if event.episode == episode:
                event.resumed_after_s = self._since(event, step)
            self._open = event = None
        if not decision.brake_reason:
            return
        if event is None:
            event = SafeStopEvent(episode, step, decision.brake_reason, decision.undriven_s)
            self.events.append(event)
            self._open = event
            self._waits = decision.waits and event.reason == NO_COMMAND
        if event.stopped_after_s is None and abs(speed_mps) < STANDSTILL_MPS:
            event.stopped_after_s = self._since(event, step + 1)

    def _since(self, event: SafeStopEvent, step: int) -> float:
        return round((step - event.step) * self._period_s, 6)


QUANTILES = {"p50": 50, "p90": 90, "p99": 99, "max": 100}


def quantiles(values_ms: Sequence[float]) -> dict[str, float | None]:
    """Return p50, p90, p99 and max of times in ms; None each if there are none."""
    if not values_ms:
        return dict.fromkeys(QUANTILES)
    found = np.percentile(values_ms, list(QUANTILES.values()))
    return dict(zip(QUANTILES, map(float, found), strict=True))


def make_report(
    results: Sequence[EpisodeResult],
    safe_stop_events: Sequence[SafeStopEvent],
    latencies_ms: Sequence[float],
    command_ages_ms: Sequence[float],
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Join the summary of the episodes with what happened on the wire.

    ``facts`` are further rows of the report: what was asked for, counts, ``policy_ids`` and
    ``wall_s``. The report's policy_id is that of the policy that appeared last.
    """
    policy_id = next(reversed(facts["policy_ids"]), "")
    summary = summarise(results, facts["scenario"], facts["condition"], policy_id, facts["seed"])
    return {
        **summary,
        "latency_ms": quantiles(latencies_ms),
        "answered_states": len(latencies_ms),
        "command_age_ms": quantiles(command_ages_ms),
        "vehicle": None,
        **facts,
        "safe_stops": len(safe_stop_events),
        "times_real_time": sum(result.time_s for result in results) / facts["wall_s"],
        "safe_stop_events": [asdict(event) for event in safe_stop_events],
        "per_episode": [asdict(result) for result in results],
    }


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Iterator[str]:
    """Yield the lines of a Markdown table and an empty line; ``|`` in a cell becomes ``/``."""
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield f"| {' | '.join(str(cell).replace('|', '/') for cell in row)} |"
    yield ""


def summary_line(report: Mapping[str, Any]) -> str:
    """Return the report in one line for a terminal."""
    latency = report["latency_ms"]
    times = "no command came"
    if latency["p50"] is not None:
        times = "latency p50 {p50:.1f} ms, p99 {p99:.1f} ms".format(**latency)
    if report["success_rate"] is None:
        ends = "return {mean:.1f} +- {std:.1f}".format(**report["episode_reward"])
    else:
        outcomes = Counter({GOAL: 0})
        outcomes.update(row["outcome"] for row in report["per_episode"])
        ends = ", ".join(f"{count} {name}" for name, count in outcomes.items())
    stops = Counter(event["reason"] for event in report["safe_stop_events"])
    parts = (
        f"{counted(report['episodes'], 'episode')}: {ends}",
        times,
        _reasons("safe stop", stops),
        _reasons("rejected message", report["rejected"]),
    )
    return printable("; ".join(parts))


def episode_line(
    number: int, episodes: int, result: EpisodeResult, stops: Sequence[SafeStopEvent]
) -> str:
    """Return what became of an episode, as in "episode 2 of 5: goal after 12.3 s"."""
    braked = f"; {_reasons('safe stop', Counter(e.reason for e in stops))}" if stops else ""
    told = f"episode {number} of {episodes}: {result.outcome} after {result.time_s:.1f} s"
    return printable(told + braked)


def _reasons(noun: str, counts: Mapping[str, int]) -> str:
    """Return text like "3 safe stops (2 no_command, 1 vehicle_fault)"."""
    each = ", ".join(f"{count} {reason}" for reason, count in counts.items() if count)
    return counted(sum(counts.values()), noun) + (f" ({each})" if each else "")


MAX_LAG_S = 2.0
LAG_STEP_S = 0.005
LEAST_SPREAD = 0.02
"""Standard deviation (of full action, or in m/s) below which too little was asked to tell a lag."""
MOST_FAULTS = 32  # Different words that are counted: no list of a stranger's fills the memory

Rows = list[tuple[int, float]]  # Stamp in ns, and value


class Series:
    """One quantity in one episode: when what was asked for, and when what was reached.

    ``held``: what was asked for holds until the next; otherwise it is interpolated.
    """

    def __init__(self, asked: Rows, reached: Rows, held: bool) -> None:
        self.held, start_ns = held, reached[0][0]
        self.asked_s, self.asked = _columns(asked, start_ns)
        self.reached_s, self.reached = _columns(reached, start_ns)

    def errors(self, delay_s: float = 0.0) -> NDArray[np.float64]:
        """Return what was reached minus what was asked for ``delay_s`` before."""
        at_s = self.reached_s - delay_s
        if not self.held:
            return self.reached - np.interp(at_s, self.asked_s, self.asked, left=self.reached[0])
        values = np.concatenate([self.reached[:1], self.asked])
        return self.reached - values[np.searchsorted(self.asked_s, at_s, side="right")]


def _columns(rows: Rows, start_ns: int) -> NDArray[np.float64]:
    """Return times (s) and values, ascending even where a clock was set."""
    ordered = sorted(rows, key=itemgetter(0))
    return np.array([((stamp - start_ns) / 1e9, value) for stamp, value in ordered]).T


def errors(series: Sequence[Series]) -> dict[str, float | None]:
    """Return rmse and max of the tracking error, with the lag in it."""
    if not series:
        return {"rmse": None, "max": None}
    found = np.concatenate([each.errors() for each in series])
    return {"rmse": float(np.sqrt(np.mean(found**2))), "max": float(np.abs(found).max())}


def lag_ms(series: Sequence[Series]) -> float | None:
    """Return the delay that aligns asked and reached best, in ms.

    It has the least mean square of reached(t) - asked(t - delay), from 0 to MAX_LAG_S in steps of
    LAG_STEP_S; the middle where several are as good, for feedback at 20 Hz cannot tell steps apart
    that fall between two reports. For a dead time followed by a first-order response, it lies
    between the dead time and the sum of both, and near the sum where what is asked changes slowly.
    None where next to nothing changed, and where the best delay is the end of what is tried.
    """
    if not series or np.std(np.concatenate([each.asked for each in series])) < LEAST_SPREAD:
        return None
    delays_s = np.arange(0.0, MAX_LAG_S + LAG_STEP_S / 2, LAG_STEP_S)
    squares = [sum(float(np.sum(each.errors(d) ** 2)) for each in series) for d in delays_s]
    best_s = delays_s[np.isclose(squares, min(squares), rtol=1e-6, atol=1e-12)]
    return None if best_s[-1] == delays_s[-1] else round(float(best_s.mean()) * 1e3, 3)


class TrackingLog:
    """What a vehicle was asked and what it reached, by episode; between two nothing counts.

    All times are the edge runtime's stamps, of commands and feedback alike, so that neither the
    way to the simulator nor another clock is in any of them. An action is asked for from its
    command on until the next command; a speed set-point, which the driver moves all the time, is
    interpolated. Each episode begins at rest, so before its first command what was reached is what
    was asked. Feedback of a vehicle that brakes by itself is left out.
    """

    def __init__(self) -> None:
        self.faults: Counter[str] = Counter()
        """Words of the vehicle, by the feedback messages that held them."""
        self.vehicle = ""
        self._episodes: list[tuple[list[Command], list[Feedback]]] = []
        self._is_open = False

    def begin(self) -> None:
        """Note that an episode begins."""
        self._is_open = True
        self._episodes.append(([], []))

    def end(self) -> None:
        """Note that the episode has ended."""
        self._is_open = False

    def command(self, command: Command) -> None:
        """Take a command, in order."""
        if self._is_open:
            self._episodes[-1][0].append(command)

    def feedback(self, feedback: Feedback) -> None:
        """Take a feedback, in order."""
        self.vehicle = feedback.vehicle
        if not self._is_open:
            return
        for words in feedback.faults:
            if words in self.faults or len(self.faults) < MOST_FAULTS:
                self.faults[words] += 1
        if not feedback.self_braking:
            self._episodes[-1][1].append(feedback)

    def report(self, action_names: Sequence[str]) -> dict[str, Any]:
        """Return errors and lags, None where nothing was measured.

        ``action_names`` are in the order of a command's action.
        """
        speed = []
        actions: dict[str, list[Series]] = {name: [] for name in action_names}
        for commands, feedback in self._episodes:
            if told := [f for f in feedback if f.commanded_speed_mps is not None]:
                asked = [(f.sent_ns, f.commanded_speed_mps or 0.0) for f in told]
                speed.append(Series(asked, [(f.sent_ns, f.speed_mps) for f in told], held=False))
            for index, name in enumerate(action_names if commands and feedback else ()):
                asked = [(c.sent_ns, c.action[index]) for c in commands]
                reached = [(f.sent_ns, f.action[index]) for f in feedback]
                actions[name].append(Series(asked, reached, held=True))
        lags = {"speed": speed, **actions}
        return {
            "name": self.vehicle,
            "samples": sum(len(feedback) for _, feedback in self._episodes),
            "speed_error_mps": errors(speed),
            "action_error": {name: errors(series) for name, series in actions.items()},
            "lag_ms": {name: lag_ms(series) for name, series in lags.items()},
            "faults": dict(self.faults),
        }
