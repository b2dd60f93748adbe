"""Accept newer states of the current simulator, and measure their lag. Pure: time is passed in.

Contract, section 3: a new session takes over only when the current one has been silent for 2 T. A
state is rejected if it is not newer than the last accepted one, or further ahead than a simulator
can have come (unless the state before it leapt as far).
"""

from __future__ import annotations

import math
from typing import Dict, NamedTuple, Optional, Tuple

from edge_runtime.wire import Reason, Rejection, State

TAKEOVER_PERIODS = 2
MAX_SESSIONS = 10_000  # About 6 MB; at T = 0.1 s half an hour of constant take-overs
# A message from far ahead would make all later ones stale, so a leap is limited: to this many lost
# messages, and by the two rates below to what a fast simulator counts while nothing arrives.
MAX_SKIPPED_EPISODES = 10
MAX_SKIPPED_STEPS = 10_000
MAX_LOST_STEPS = 10  # Between two states that arrive
SKIPPED_EPISODES_PER_S = 1.0
SKIPPED_STEPS_PER_PERIOD = 10.0

DRIFT = 200e-6  # s per s: two clocks may drift apart this fast, and the least offset with them

Position = Tuple[int, int]  # (episode, step): what "newer" compares within a session


class _Last(NamedTuple):
    position: Position
    accepted_s: float


class LatestState:
    """Accepts or rejects each state in order of arrival, and counts both."""

    def __init__(self, control_period_s: float) -> None:
        self._period_s = control_period_s
        self.accepted = 0
        self.rejected: Dict[str, int] = {}
        self._session: Optional[str] = None
        self._heard_s = -math.inf
        # The last position of each session: a delayed message of an earlier one is stale, too.
        self._lasts: Dict[str, _Last] = {}
        # Session, episode, step of the newest leap rejected since the last accepted state
        self._leap: Optional[Tuple[str, int, int]] = None

    def offer(self, state: State, now_s: float) -> Optional[Rejection]:
        """Accept the state (None) or reject it. `now_s`: monotonic time of arrival."""
        rejection = self._judge(state, now_s)
        if rejection is not None:
            return self.reject(rejection)
        self._session, self._heard_s, self._leap = state.session, now_s, None
        self._lasts[state.session] = _Last((state.episode, state.step), now_s)
        self.accepted += 1
        return None

    def reject(self, rejection: Rejection) -> Rejection:
        """Count a rejection, also a decoder's, and return it."""
        reason = rejection.reason.value
        self.rejected[reason] = self.rejected.get(reason, 0) + 1
        return rejection

    def _judge(self, state: State, now_s: float) -> Optional[Rejection]:
        session = state.session
        if session == self._session:
            # Even a stale message shows that this simulator is there.
            self._heard_s = now_s
        elif now_s - self._heard_s < TAKEOVER_PERIODS * self._period_s:
            words = f"session {session!r} while {self._session!r} is not silent"
            return Rejection(Reason.FOREIGN_SESSION, words)
        last = self._lasts.get(session)
        if last is None:
            if len(self._lasts) < MAX_SESSIONS:
                return None
            words = f"there were {MAX_SESSIONS} simulators before; start the runtime again"
            return Rejection(Reason.FOREIGN_SESSION, words)
        refusal = _judge_position((state.episode, state.step), last, now_s, self._period_s)
        if refusal is None or refusal.reason is not Reason.FUTURE:
            return refusal
        leap, self._leap = self._leap, (session, state.episode, state.step)
        # Two states in a row beyond the leap: the simulator really has come so far.
        if leap is not None and leap[:2] == (session, state.episode):
            refusal = None if 0 < state.step - leap[2] <= MAX_LOST_STEPS else refusal
        return refusal


def _judge_position(
    position: Position, last: _Last, now_s: float, period_s: float
) -> Optional[Rejection]:
    """Reject a position that is not newer, or that no simulator can have reached by now."""
    elapsed_s = now_s - last.accepted_s
    episodes = position[0] - last.position[0]
    steps = position[1] - (last.position[1] if episodes == 0 else 0)
    if position <= last.position:
        reason = Reason.DUPLICATE if position == last.position else Reason.STALE
    elif (
        episodes > MAX_SKIPPED_EPISODES + SKIPPED_EPISODES_PER_S * elapsed_s
        or steps > MAX_SKIPPED_STEPS + SKIPPED_STEPS_PER_PERIOD * elapsed_s / period_s
    ):
        reason = Reason.FUTURE
    else:
        return None
    (old_episode, old_step), (episode, step) = last.position, position
    words = f"episode {episode} step {step} after episode {old_episode} step {old_step}"
    return Rejection(reason, words)


class _Least(NamedTuple):  # of a session
    noted_s: float
    offset_s: float  # arrival less stamp
    trip_s: float  # inf: none is known


class Freshness:
    """Measures the lag of each state, in order of arrival, without synchronised clocks.

    Arrival minus the sender's stamp is the delay plus the unknown offset of the two clocks. Its
    least value in a session belongs to the quickest state; the excess over it is a state's lag. A
    lag above `limit_s` is too late. This detects a backlog that arrives at the usual pace, and a
    delay that grows.

    A step of the sender's clock looks like a lag, and counts as one until there is a safe stop.
    Then the round trip of a command and the next state, which needs no offset, shows whether a
    backlog is left. Two cases stay ambiguous: a clock set ahead looks like a backlog of that size;
    a clock set back looks like a delay that has moved from the commands to the states. If the
    stamps show no lag, up to `limit_s` of a round trip is charged to the command: otherwise jitter
    both ways would stop the vehicle for good.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        # An earlier session may come back with its backlog. LatestState bounds how many there are.
        self._leasts: Dict[str, _Least] = {}

    def lag_s(
        self,
        session: str,
        sent_s: float,
        arrived_s: float,
        trip_s: Optional[float],
        stands: bool,
        final: bool = False,
    ) -> float:
        """Return the lag of a state in s, 0 for the first of its session.

        `sent_s` is the sender's stamp and `arrived_s` monotonic. `trip_s` is the round trip, None
        where it is unknown. `stands`: the mode is safe stop. A final state updates nothing: a
        simulator sends it past the network that it injects.
        """
        offset_s = arrived_s - sent_s
        known = self._leasts.get(session, _Least(arrived_s, offset_s, math.inf))
        grown_s = DRIFT * (arrived_s - known.noted_s)
        least_s, least_trip_s = known.offset_s + grown_s, known.trip_s + grown_s
        lag_s = offset_s - least_s
        if final:
            return max(lag_s, 0.0)
        stepped = abs(lag_s) > self._limit_s  # the delay changed, or a clock was set
        knows_trip = least_trip_s < math.inf
        if trip_s is not None and trip_s < 0.0:
            trip_s = None  # a clock was set between its two readings
        if trip_s is not None and (knows_trip or not stepped):
            # Only the first trip is reduced by the lag: later lags come from trips themselves.
            quickest_s = trip_s if knows_trip else max(trip_s - max(lag_s, 0.0), 0.0)
            least_trip_s = min(least_trip_s, quickest_s)
        if stands and trip_s is not None and knows_trip:
            least_s, lag_s = self._by_trip(offset_s, least_s, trip_s - least_trip_s)
        elif stepped and knows_trip:
            # Below the least, a clock was set or the link was slow before: late from now on.
            least_s, lag_s = offset_s - abs(lag_s), abs(lag_s)
        else:
            least_s, lag_s = min(least_s, offset_s), max(lag_s, 0.0)
        self._leasts[session] = _Least(arrived_s, least_s, least_trip_s)
        return lag_s

    def _by_trip(self, offset_s: float, least_s: float, excess_s: float) -> Tuple[float, float]:
        """Return the least offset and the lag by a round trip `excess_s` above the quickest."""
        shown_s = offset_s - excess_s  # the true least is no less
        if offset_s - least_s < -self._limit_s:  # a clock was set ahead
            least_s = shown_s
        least_s = min(max(least_s, shown_s), offset_s)
        # Commands lag, too: with all of the trip charged to the state, jitter would stop it.
        lag_s = offset_s - min(least_s, shown_s + self._limit_s)
        return (offset_s - lag_s if lag_s <= self._limit_s else least_s), lag_s
