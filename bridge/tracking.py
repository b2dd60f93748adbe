"""How well a vehicle follows: what it was asked, what it reached, and how much later. Pure.

All times here are the edge runtime's stamps, of commands and feedback alike, so that neither the
way to the simulator nor another clock is in any of it.

The lag is the delay that best aligns both series: of all delays from 0 to MAX_LAG_S in steps of
LAG_STEP_S, that with the least mean square of reached(t) - asked(t - delay) over all feedback; the
middle where several are as good, as feedback at 20 Hz cannot tell steps apart that fall between
two reports. For a dead time with a first-order response behind it, it lies between the dead time
and the sum of both, and near the sum where what is asked changes slowly. An action is asked for
from its command on until the next one; a speed set-point, which the driver moves all the time, is
interpolated. Each episode begins at rest, so before its first command what was reached then is
what was asked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_runtime.wire import Command, Feedback

MAX_LAG_S = 2.0
LAG_STEP_S = 0.005
LEAST_SPREAD = 0.02
"""Standard deviation (of full action, or in m/s) below which too little was asked to tell a lag."""
MOST_FAULTS = 32
"""Different words that are counted: a list made up by anybody must not fill the memory."""

Numbers = NDArray[np.float64]


@dataclass
class Series:
    """One quantity in one episode: when what was asked for, and when what was reached."""

    asked_s: Numbers
    asked: Numbers
    reached_s: Numbers
    reached: Numbers
    held: bool
    """What was asked for holds until the next; otherwise it is interpolated."""

    def errors(self, delay_s: float = 0.0) -> Numbers:
        """Reached minus what was asked for ``delay_s`` before."""
        at_s = self.reached_s - delay_s
        if not self.held:
            return self.reached - np.interp(at_s, self.asked_s, self.asked, left=self.reached[0])
        values = np.concatenate([self.reached[:1], self.asked])
        return self.reached - values[np.searchsorted(self.asked_s, at_s, side="right")]


def errors(series: Sequence[Series]) -> dict[str, float | None]:
    """Return rmse and max of the tracking error, as it happened, with the lag in it."""
    if not series:
        return {"rmse": None, "max": None}
    found = np.concatenate([one.errors() for one in series])
    return {"rmse": float(np.sqrt(np.mean(found**2))), "max": float(np.abs(found).max())}


def lag_ms(series: Sequence[Series]) -> float | None:
    """Return the delay that aligns best, in ms; None where nothing can be said.

    So where next to nothing changed, and where the best delay is the end of what is tried.
    """
    if not series or np.std(np.concatenate([one.asked for one in series])) < LEAST_SPREAD:
        return None
    delays_s = np.arange(0.0, MAX_LAG_S + LAG_STEP_S / 2, LAG_STEP_S)
    squares = [sum(float(np.sum(one.errors(d) ** 2)) for one in series) for d in delays_s]
    best_s = delays_s[np.isclose(squares, min(squares), rtol=1e-6, atol=1e-12)]
    return None if best_s[-1] == delays_s[-1] else round(float(best_s.mean()) * 1e3, 3)


@dataclass
class _Episode:
    commands: list[Command] = field(default_factory=list)
    feedback: list[Feedback] = field(default_factory=list)


class TrackingLog:
    """Commands and feedback of a run, by episode; what happens between two is nobody's error.

    A vehicle that brakes by itself follows nobody meanwhile: that feedback is left out.
    """

    def __init__(self) -> None:
        self.faults: Counter[str] = Counter()
        """Words of the vehicle, by the feedback messages that held them."""
        self.vehicle = ""
        self._episodes: list[_Episode] = []
        self._open: _Episode | None = None

    def begin(self) -> None:
        """Note that an episode begins."""
        self._open = _Episode()
        self._episodes.append(self._open)

    def end(self) -> None:
        """Note that it has ended."""
        self._open = None

    def command(self, command: Command) -> None:
        """Take a command, in order."""
        if self._open is not None:
            self._open.commands.append(command)

    def feedback(self, feedback: Feedback) -> None:
        """Take a feedback, in order."""
        self.vehicle = feedback.vehicle
        if self._open is None:
            return
        for words in feedback.faults:
            if words in self.faults or len(self.faults) < MOST_FAULTS:
                self.faults[words] += 1
        if not feedback.self_braking:
            self._open.feedback.append(feedback)

    def report(self, action_names: Sequence[str]) -> dict[str, Any]:
        """Return errors and lags; ``action_names`` in the order of a command's action.

        None stands wherever nothing was measured: a vehicle that takes no speed has no set-point.
        """
        speed = [one for episode in self._episodes if (one := _speed(episode)) is not None]
        actions = {name: self._action(index) for index, name in enumerate(action_names)}
        return {
            "name": self.vehicle,
            "scale": self._scale(),
            "samples": sum(len(episode.feedback) for episode in self._episodes),
            "speed_error_mps": errors(speed),
            "action_error": {name: errors(series) for name, series in actions.items()},
            "lag_ms": {
                "speed": lag_ms(speed),
                **{name: lag_ms(series) for name, series in actions.items()},
            },
            "faults": dict(self.faults),
        }

    def _action(self, index: int) -> list[Series]:
        found = []
        for episode in self._episodes:
            commands, feedback = episode.commands, episode.feedback
            if commands and feedback:
                zero_ns = feedback[0].sent_ns
                asked = _columns(((c.sent_ns, c.action[index]) for c in commands), zero_ns)
                reached = _columns(((f.sent_ns, f.action[index]) for f in feedback), zero_ns)
                found.append(Series(*asked, *reached, held=True))
        return found

    def _scale(self) -> float | None:
        """Metres of the vehicle for one of the scenario, from where that is told best: at speed."""
        told = [f for e in self._episodes for f in e.feedback if f.scenario_speed_mps]
        if not told:
            return None
        fastest = max(told, key=lambda f: abs(f.scenario_speed_mps or 0.0))
        return fastest.speed_mps / (fastest.scenario_speed_mps or 1.0)


def _speed(episode: _Episode) -> Series | None:
    told = [f for f in episode.feedback if f.commanded_speed_mps is not None]
    if not told:
        return None
    zero_ns = told[0].sent_ns
    asked = _columns(((f.sent_ns, f.commanded_speed_mps or 0.0) for f in told), zero_ns)
    reached = _columns(((f.sent_ns, f.speed_mps) for f in told), zero_ns)
    return Series(*asked, *reached, held=False)


def _columns(rows: Iterable[tuple[int, float]], zero_ns: int) -> tuple[Numbers, Numbers]:
    """Times in s since ``zero_ns``, ascending even where a clock was stepped, and the values."""
    times_ns, values = zip(*sorted(rows, key=lambda row: row[0]), strict=True)
    seconds = [(time_ns - zero_ns) / 1e9 for time_ns in times_ns]
    return np.array(seconds), np.array(values, dtype=np.float64)
