"""What the vehicle does, by its newest feedback, and when that is no longer known. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from edge_runtime.latency.command_hold import (
    ROUNDING_S,
    SILENCE_LIMIT_S,
    UNKNOWN_SAFE_STOP,
    Decision,
)
from edge_runtime.wire import SAFE_STOP, Feedback

NO_FEEDBACK = "no_feedback"
"""Brake reason: nothing was heard from the vehicle for 2 T, so the car brakes in its place."""
SELF_BRAKING = "self_braking"
"""Brake reason: the vehicle says that it brakes by itself."""


@dataclass(frozen=True)
class VehicleDecision(Decision):
    """What the vehicle did in one tick; without feedback, nobody knows."""

    feedback: Feedback | None = None
    feedback_age_s: float | None = None
    """From its arrival here, before any injected delay; None without feedback."""


class FeedbackHold:
    """The newest feedback, and how long ago it arrived. Times are monotonic seconds."""

    def __init__(self, now_s: float) -> None:
        self._newest: Feedback | None = None
        self._received_s = self._heard_s = now_s

    def admit(self, feedback: Feedback, received_s: float, now_s: float) -> None:
        """Take the newest feedback: received from the wire, and (network injected) heard now."""
        self._newest, self._received_s, self._heard_s = feedback, received_s, now_s

    def newest(self, now_s: float) -> Feedback | None:
        """Return the newest feedback; None if it has been silent for 2 T."""
        silent = now_s - self._heard_s > SILENCE_LIMIT_S + ROUNDING_S
        return None if silent else self._newest

    def decide(self, heard: Decision, episode: int, now_s: float) -> VehicleDecision:
        """Say what the vehicle did in the tick that ends now.

        ``heard`` is what its commands would have it do: the simulator hears those, too. They give
        a stop its reason, and decide nothing.
        """
        feedback = self.newest(now_s)
        known = _fields(heard)
        if feedback is None:
            return VehicleDecision(**{**known, "brake_reason": NO_FEEDBACK, "command_age_s": None})
        known["brake_reason"] = _brake_reason(feedback, heard, episode)
        if known["brake_reason"]:
            known["command_age_s"] = None
        age_s = now_s - self._received_s
        return VehicleDecision(**known, feedback=feedback, feedback_age_s=age_s)


def _fields(decision: Decision) -> dict[str, Any]:
    return {name: getattr(decision, name) for name in Decision.__dataclass_fields__}


def _brake_reason(feedback: Feedback, heard: Decision, episode: int) -> str:
    """Why the vehicle brakes; empty while it obeys the policy.

    Until it has taken a command of this episode it stands because the last one has ended: no
    fault, unless there are no commands.
    """
    if feedback.episode != episode:
        return heard.brake_reason
    if feedback.mode == SAFE_STOP:
        return heard.brake_reason or UNKNOWN_SAFE_STOP
    return SELF_BRAKING if feedback.self_braking else ""
