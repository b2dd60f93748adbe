"""When the policy may drive: a pure state machine over (mode, event, time). Contract, section 5.

TRANSITIONS holds every transition; the functions below it only choose the event. T is the control
period of the policy that drives.
"""

from __future__ import annotations

from enum import Enum
from typing import Dict, NamedTuple, Optional, Tuple

# One lost state leaves a gap of exactly 2 T. Without a little patience the jitter of the sender's
# clock would decide whether it costs one step or a stop. A stop is promised within 2 T + T / 2.
SILENCE_PERIODS = 2.2
FRESH_STATES_TO_RECOVER = 5
# Between two episodes of one drive a simulator resets in seconds. After a longer pause nobody
# may still be beside the vehicle.
MAX_PAUSE_S = 10.0


class Mode(str, Enum):
    """STANDBY: nothing to answer. DRIVE: the policy's action goes out. SAFE_STOP: the brake."""

    STANDBY = "standby"
    DRIVE = "drive"
    SAFE_STOP = "safe_stop"


class Event(str, Enum):
    """The first three are fresh states with a finite answer in time."""

    FRESH = "fresh_state"
    RECOVERED = "recovered"  # the fresh state that meets the condition to drive again
    FINAL = "final_state"  # the episode ends with it
    SILENT = "no_fresh_state"  # for longer than silence_s
    LATE = "state_late"  # the state lags behind its stamps by more than answer_s (latest.py)
    NOT_FINITE = "output_not_finite"
    FAILED = "inference_failed"  # the policy raised, or answered with another type or shape
    DEAD = "policy_thread_dead"  # an exception has ended it: only a new process helps
    TOO_LONG = "inference_too_long"  # longer than T, or its answer is older than answer_s
    PAUSED = "pause_too_long"  # a vehicle had leave to drive and did not for MAX_PAUSE_S
    OTHER_SESSION = "other_session"  # a vehicle's states come from another simulator than before
    OTHER_TASK = "other_task"  # the state is of another task than the policy
    NOT_ARMED = "not_armed"  # the start was no permission for the vehicle to move
    EPISODE = "episode"  # a vehicle needs a permission for each new episode
    LEASH = "leash"  # a vehicle has gone as far as one permission lets it
    VEHICLE = "vehicle_fault"  # it is silent, does not obey, or reports the impossible
    REARM = "rearm"  # an operator allows driving again


_S, _D, _X = Mode.STANDBY, Mode.DRIVE, Mode.SAFE_STOP

# The mode after the event, by the mode before: in STANDBY, in DRIVE, in SAFE_STOP.
_ROWS: Dict[Event, Tuple[Mode, Mode, Mode]] = {
    Event.FRESH: (_D, _D, _X),
    Event.RECOVERED: (_D, _D, _D),
    Event.FINAL: (_S, _S, _X),  # the end of an episode does not end a safe stop
    Event.SILENT: (_S, _X, _X),  # between two episodes nothing is due
    Event.LATE: (_X, _D, _X),  # it is not answered: without a fresh one a drive ends as SILENT
    Event.NOT_FINITE: (_X, _X, _X),
    Event.FAILED: (_X, _X, _X),
    Event.DEAD: (_X, _X, _X),
    Event.TOO_LONG: (_X, _X, _X),
    Event.PAUSED: (_X, _X, _X),
    Event.OTHER_SESSION: (_X, _X, _X),
    Event.OTHER_TASK: (_X, _X, _X),
    Event.NOT_ARMED: (_X, _X, _X),
    Event.EPISODE: (_X, _X, _X),
    Event.LEASH: (_X, _X, _X),
    Event.VEHICLE: (_X, _X, _X),
    Event.REARM: (_S, _D, _X),  # a fresh state must follow
}
TRANSITIONS: Dict[Tuple[Mode, Event], Mode] = {
    (before, event): after for event, row in _ROWS.items() for before, after in zip(Mode, row)
}
# An event that stops a standby or a drive is a fault.
FAULTS = tuple(event for event in Event if _X in (TRANSITIONS[_S, event], TRANSITIONS[_D, event]))
FRESH_EVENTS = (Event.FRESH, Event.RECOVERED, Event.FINAL)


class Safety(NamedTuple):
    """The state of the machine. `reason` is the fault that stopped it, empty in other modes.

    `last_fresh_s` and `session` are the monotonic arrival of the newest state that was not late,
    and the simulator that sent it, None before the first one. `permitted_s` is when it last drove
    or was re-armed, or the arrival of the very first state. T and `ride_s` (0: off) never change.
    """

    control_period_s: float  # T
    mode: Mode = Mode.STANDBY
    reason: str = ""
    fresh_in_a_row: int = 0
    rearmed: bool = False
    last_fresh_s: Optional[float] = None
    session: Optional[str] = None
    safe_stops: int = 0
    permitted_s: Optional[float] = None
    ride_s: float = 0.0

    @property
    def answer_s(self) -> float:
        """For how long the newest state may be answered: 2 T, and a fifth of T as grace."""
        return SILENCE_PERIODS * self.control_period_s

    @property
    def silence_s(self) -> float:
        """For how long silence is no fault: in a drive, the last plan adds `ride_s`."""
        return SILENCE_PERIODS * self.control_period_s + self.ride_s * (self.mode is Mode.DRIVE)


def is_silent(safety: Safety, now_s: float) -> bool:
    """Return whether the newest state is older than silence_s (or there was none)."""
    return safety.last_fresh_s is None or now_s - safety.last_fresh_s > safety.silence_s


def classify_arrival(
    safety: Safety, session: str, arrived_s: float, needs_rearm: bool
) -> Optional[Event]:
    """Event implied by the gap before a new state and by its sender; None where it is in time."""
    if safety.last_fresh_s is None:
        return None
    if session != safety.session:
        # It was accepted because the one before was silent for 2 T, even within the grace.
        return Event.OTHER_SESSION if needs_rearm else Event.SILENT
    may_drive = needs_rearm and (safety.mode is Mode.STANDBY or safety.rearmed)
    # Not since the last state: final ones may come for hours without a drive.
    since_s = arrived_s if safety.permitted_s is None else safety.permitted_s
    if may_drive and arrived_s - since_s > MAX_PAUSE_S:
        return Event.PAUSED
    return Event.SILENT if is_silent(safety, arrived_s) else None


def classify_fresh(safety: Safety, final: bool, needs_rearm: bool) -> Event:
    """Event of a fresh state with a finite answer in time."""
    if final:
        return Event.FINAL
    enough = safety.fresh_in_a_row + 1 >= FRESH_STATES_TO_RECOVER
    if safety.mode is Mode.SAFE_STOP and enough and (safety.rearmed or not needs_rearm):
        return Event.RECOVERED
    return Event.FRESH


def advance(safety: Safety, event: Event) -> Safety:
    """Return the state after the event. Arrival times are noted by `note_arrival`."""
    mode = TRANSITIONS[safety.mode, event]
    stops, is_fault = mode is Mode.SAFE_STOP, event in FAULTS
    reason = event.value if is_fault else safety.reason
    return safety._replace(
        mode=mode,
        reason=reason if stops else "",
        fresh_in_a_row=0 if is_fault else safety.fresh_in_a_row + int(event in FRESH_EVENTS),
        # A fault takes an unused permission back: it was given for another situation.
        rearmed=stops and not is_fault and (safety.rearmed or event is Event.REARM),
        safe_stops=safety.safe_stops + int(stops and safety.mode is not Mode.SAFE_STOP),
    )


def note_arrival(safety: Safety, session: str, arrived_s: float) -> Safety:
    """Note arrival and sender of the newest state, before its answer is known.

    Not called for a late state: the silence goes on.
    """
    drives = safety.mode is Mode.DRIVE or safety.permitted_s is None
    return safety._replace(
        last_fresh_s=arrived_s,
        permitted_s=arrived_s if drives else safety.permitted_s,
        session=session,
    )
