"""Which command the simulated vehicle obeys, and when it brakes by itself. Pure: time is passed in.

This is the vehicle's side of the contract's safety rule: the newest command is held from tick to
tick; when none has arrived for 2 T, or when the command itself says ``safe_stop``, the vehicle
brakes. The command is its own heartbeat, so there is nothing else to listen to.
"""

from __future__ import annotations

from dataclasses import dataclass

from edge_runtime.wire import CONTROL_PERIOD_S, Command

SILENCE_LIMIT_S = 2 * CONTROL_PERIOD_S
COMMAND_WINDOW_S = 0.025
"""A command that arrives within this time after the tick still acts in it."""
ROUNDING_S = 1e-9
"""Sums such as 0.3 + 0.01 + 0.015 miss 0.325 by less than this; no real delay is as short."""

NO_COMMAND = "no_command"
"""Brake reason: the vehicle brakes by itself because nothing arrived for 2 T."""
UNKNOWN_SAFE_STOP = "safe_stop"
"""Brake reason when a safe_stop command gives none of its own."""


@dataclass(frozen=True)
class Decision:
    """What the vehicle does in one tick."""

    command: Command | None
    """The newest command, held; None before the first of the episode."""
    fresh: bool
    """It arrived since the decision before this one."""
    brake_reason: str
    """Why the vehicle brakes; empty while it obeys the command."""
    undriven_s: float
    """Time since the newest ``drive`` command arrived (since the episode began, if none has)."""
    command_age_s: float | None = None
    """From the sending of the state that the obeyed command answers; None where none is obeyed."""


class CommandHold:
    """The newest command of one episode, and its age."""

    def __init__(self, now_s: float) -> None:
        self.newest: Command | None = None
        self._heard_s = now_s
        self._driven_s = now_s
        self._sent_s = now_s
        self._fresh = False

    @property
    def newest_step(self) -> int:
        """Return the step of the newest command; -1 before the first."""
        return -1 if self.newest is None else self.newest.step

    def admit(self, command: Command, now_s: float, sent_s: float) -> bool:
        """Take the command if it is newer than the newest one; return whether it was taken.

        ``sent_s`` is when the state was sent that the command answers.

        An edge runtime in safe stop repeats its answer to the last state it heard at rate 1/T;
        such a repetition is as good a heartbeat as a new answer. A repeated ``drive`` is not: it
        would keep a frozen controller alive.
        """
        if self.newest is not None and not _supersedes(command, self.newest):
            return False
        self.newest = command
        self._heard_s, self._sent_s = now_s, sent_s
        if command.mode == "drive":
            self._driven_s = now_s
        self._fresh = True
        return True

    def decide(self, now_s: float, edge_silence_s: float | None = None) -> Decision:
        """Decide this tick.

        ``edge_silence_s`` is given when lock-step has waited in vain: virtual time stood still
        meanwhile, so the wall time without an answer (s) counts in its place.
        """
        brake_reason = self._brake_reason(now_s, edge_silence_s)
        obeys = self.newest is not None and not brake_reason
        decision = Decision(
            command=self.newest,
            fresh=self._fresh,
            brake_reason=brake_reason,
            undriven_s=now_s - self._driven_s if edge_silence_s is None else edge_silence_s,
            command_age_s=now_s - self._sent_s if obeys else None,
        )
        self._fresh = False
        return decision

    def _brake_reason(self, now_s: float, edge_silence_s: float | None) -> str:
        if edge_silence_s is not None or now_s - self._heard_s > SILENCE_LIMIT_S + ROUNDING_S:
            return NO_COMMAND
        if self.newest is not None and self.newest.mode == "safe_stop":
            return self.newest.reason or UNKNOWN_SAFE_STOP
        return ""


def _supersedes(command: Command, newest: Command) -> bool:
    if command.step == newest.step:
        return command.mode == "safe_stop"
    return command.step > newest.step
