"""Which feedback of the wire the simulator believes; all other is counted by reason. Pure.

As with commands, and for a better reason: in the loop with a vehicle, feedback moves the car.
"""

from __future__ import annotations

from collections import Counter

from edge_runtime.latency.command_hold import SILENCE_LIMIT_S
from edge_runtime.wire import Feedback, Reason, Rejection, decode_feedback

ACTION_SIZE = "action_size"
"""Rejection reason: the policy has another number of actions than the environment."""
ACTION_RANGE = "action_range"
"""Rejection reason: no actuator is beyond its end."""
UNKNOWN_STEP = "unknown_step"
"""Rejection reason: the command that it has taken answers a state that was never sent."""
ROUNDING = 1e-3
NOT_COMMANDED = ""
"""Session of a vehicle that has not taken a command since its edge runtime was started."""


class FeedbackCheck:
    """Reads feedback for one simulator session and keeps the counts of the whole run.

    Another simulator's session is nobody's fault before the vehicle has heard of this one, and is
    not believed either. Its stamps say which feedback is the newest; after 2 T without any, order
    begins anew: another board, with another clock, may have taken over.
    """

    def __init__(self, session: str, action_size: int) -> None:
        self.rejected: Counter[str] = Counter()
        self.heard: Feedback | None = None
        """The last that could be read, of whatever session: it tells that a vehicle is there."""
        self.heard_s = 0.0
        self._session = session
        self._action_size = action_size
        self._sent = (-1, -1)
        self._met = False
        self._newest: Feedback | None = None
        self._newest_s = 0.0

    def sent(self, episode: int, step: int) -> None:
        """Note that a state has been sent."""
        self._sent = (episode, step)

    def read(self, payload: bytes, now_s: float) -> Feedback | None:
        """Return the feedback if it is this vehicle's newest; None otherwise.

        ``now_s``: monotonic time.
        """
        feedback = decode_feedback(payload)
        if isinstance(feedback, Rejection):
            self.rejected[feedback.reason.value] += 1
            return None
        self.heard, self.heard_s = feedback, now_s
        own = feedback.session in (self._session, NOT_COMMANDED)
        if not own and not self._met:
            return None
        fault = self._fault(feedback, now_s) if own else Reason.FOREIGN_SESSION.value
        if fault:
            self.rejected[fault] += 1
            return None
        self._met = self._met or feedback.session == self._session
        self._newest, self._newest_s = feedback, now_s
        return feedback

    def _fault(self, feedback: Feedback, now_s: float) -> str:
        """Why a well-formed feedback of this session is not believed; empty if it is."""
        if len(feedback.action) != self._action_size:
            return ACTION_SIZE
        if any(abs(value) > 1.0 + ROUNDING for value in feedback.action):
            return ACTION_RANGE
        if (feedback.episode, feedback.step) > self._sent:
            return UNKNOWN_STEP
        newest = self._newest
        if newest is None:
            return ""
        if feedback.sent_ns == newest.sent_ns:
            return Reason.DUPLICATE.value
        in_order = now_s - self._newest_s <= SILENCE_LIMIT_S
        return Reason.STALE.value if in_order and feedback.sent_ns < newest.sent_ns else ""
