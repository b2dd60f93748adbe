"""The log of safe stops: when the vehicle braked, why, and how soon it stood. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from edge_runtime.latency.command_hold import Decision

STANDSTILL_MPS = 0.05


@dataclass
class SafeStopEvent:
    """One unbroken stretch of braking; its fields are those of the report."""

    episode: int
    step: int
    """The first tick in which the vehicle braked."""
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
    """Collects the events of a whole run."""

    def __init__(self, period_s: float) -> None:
        self.events: list[SafeStopEvent] = []
        self._period_s = period_s
        self._open: SafeStopEvent | None = None

    def observe(self, episode: int, step: int, decision: Decision, speed_mps: float) -> None:
        """Note one tick: what was decided at ``step``, and the speed at the tick's end (m/s)."""
        event = self._open
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
        if event.stopped_after_s is None and abs(speed_mps) < STANDSTILL_MPS:
            event.stopped_after_s = self._since(event, step + 1)

    def _since(self, event: SafeStopEvent, step: int) -> float:
        return round((step - event.step) * self._period_s, 6)
