"""Which state is the newest of the right simulator, and why the others are not.

Pure: time is passed in. Contract, section 3: a new session is taken over only when the current
one has been silent for 2 T, and a state that is not newer than the last accepted one is rejected.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Dict, Optional, Tuple

from edge_runtime.wire import CONTROL_PERIOD_S, Reason, Rejection, State

TAKEOVER_SILENCE_S = 2 * CONTROL_PERIOD_S
_REMEMBERED_SESSIONS = 16

Position = Tuple[int, int]  # (episode, step): what "newer" compares within a session


class LatestState:
    """Accepts or rejects each state in order of arrival, and counts both."""

    def __init__(self) -> None:
        self.accepted = 0
        self.rejected: Dict[str, int] = {}
        self._session: Optional[str] = None
        self._heard_s = 0.0
        # Where each session stood: a delayed message of an earlier one never goes back either.
        self._positions: OrderedDict[str, Position] = OrderedDict()

    def offer(self, state: State, now_s: float) -> Optional[Rejection]:
        """Accept the state (None) or say why not. `now_s`: monotonic time of arrival."""
        rejection = self._judge(state, now_s)
        if rejection is not None:
            return self.reject(rejection)
        self._session = state.session
        self._heard_s = now_s
        self._remember(state)
        self.accepted += 1
        return None

    def reject(self, rejection: Rejection) -> Rejection:
        """Count a rejection, also one from the decoder, and hand it back."""
        reason = rejection.reason.value
        self.rejected[reason] = self.rejected.get(reason, 0) + 1
        return rejection

    def _judge(self, state: State, now_s: float) -> Optional[Rejection]:
        if state.session == self._session:
            # Even a stale message shows that this simulator is there.
            self._heard_s = now_s
        elif self._session is not None and now_s - self._heard_s < TAKEOVER_SILENCE_S:
            return Rejection(
                Reason.FOREIGN_SESSION,
                f"session {state.session!r} while {self._session!r} is not silent",
            )
        return self._judge_order(state)

    def _judge_order(self, state: State) -> Optional[Rejection]:
        last = self._positions.get(state.session)
        if last is None or (state.episode, state.step) > last:
            return None
        reason = Reason.DUPLICATE if (state.episode, state.step) == last else Reason.STALE
        return Rejection(
            reason, f"episode {state.episode} step {state.step} after {last[0]} step {last[1]}"
        )

    def _remember(self, state: State) -> None:
        self._positions[state.session] = (state.episode, state.step)
        self._positions.move_to_end(state.session)
        while len(self._positions) > _REMEMBERED_SESSIONS:
            self._positions.popitem(last=False)
