"""How late a state is, whatever the sender's clock says. Pure: times are passed in.

Arrival less the sender's stamp is the delay plus the unknown offset of two clocks. The least of a
session belongs to its quickest state; what another state has above it is its lag. So a backlog
that a link hands over at the usual pace is seen, and so is a delay that grows slowly.

A step of the sender's clock looks like a lag, and counts as one until there is a safe stop. Then
the round trip of a command and the next state shows whether a backlog is left. It needs no offset:
each of the two clocks is read twice (`heard_sent_ns`, `heard_ns` of the wire). Two things cannot be
told apart: a clock set ahead and a backlog of just that size; a clock set back and a delay that has
moved from the commands to the states. Where the stamps show no lag, `limit_s` of a round trip may
be the command's: over jitter both ways it would else stay in a stop for good.
"""

from __future__ import annotations

import math
from typing import Dict, NamedTuple, Optional, Tuple

DRIFT = 200e-6  # s per s: two clocks may drift apart so fast, and the least with them


class _Least(NamedTuple):
    """Of a session, in s: arrival less stamp, and the round trip (inf: none is known)."""

    noted_s: float
    offset_s: float
    trip_s: float


class Freshness:
    """Judges every state in the order of arrival; `limit_s` is the lag that is too late."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        # An earlier session may come back with its backlog. latest.py bounds how many there are.
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
        """The lag of a state, 0 for the first of its session.

        `sent_s` is the sender's stamp and `arrived_s` monotonic. `trip_s` is the round trip, None
        where the sender does not say what it has heard. `stands`: in a safe stop. A final state
        teaches nothing: a simulator sends it past the network that it injects.
        """
        offset_s = arrived_s - sent_s
        known = self._leasts.get(session, _Least(arrived_s, offset_s, math.inf))
        grown_s = DRIFT * (arrived_s - known.noted_s)
        least_s, least_trip_s = known.offset_s + grown_s, known.trip_s + grown_s
        lag_s = offset_s - least_s
        if final:
            return max(lag_s, 0.0)
        stepped = abs(lag_s) > self._limit_s  # the delay, or a clock
        knows_trip = least_trip_s < math.inf
        if trip_s is not None and trip_s < 0.0:
            trip_s = None  # a clock was set between its two readings
        if trip_s is not None and (knows_trip or not stepped):
            # Only of the first is a lag taken off: later ones come of trips themselves.
            quickest_s = trip_s if knows_trip else max(trip_s - max(lag_s, 0.0), 0.0)
            least_trip_s = min(least_trip_s, quickest_s)
        if stands and trip_s is not None and knows_trip:
            least_s, lag_s = self._by_trip(offset_s, least_s, trip_s - least_trip_s)
        elif stepped and knows_trip:
            # Where it is less, a clock was set, or the link was slow before: all is late from now.
            least_s, lag_s = offset_s - abs(lag_s), abs(lag_s)
        else:
            least_s, lag_s = min(least_s, offset_s), max(lag_s, 0.0)
        self._leasts[session] = _Least(arrived_s, least_s, least_trip_s)
        return lag_s

    def _by_trip(self, offset_s: float, least_s: float, excess_s: float) -> Tuple[float, float]:
        """The least offset and the lag by a round trip `excess_s` above the quickest."""
        shown_s = offset_s - excess_s  # the true least is no less
        if offset_s - least_s < -self._limit_s:  # a clock was set ahead
            least_s = shown_s
        least_s = min(max(least_s, shown_s), offset_s)
        # Commands lag, too: were all of the trip the state's, it would never drive over jitter.
        lag_s = offset_s - min(least_s, shown_s + self._limit_s)
        return (offset_s - lag_s if lag_s <= self._limit_s else least_s), lag_s
