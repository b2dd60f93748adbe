"""How the driver sees the chassis: a pure state machine. TRANSITIONS is all of it.

STOPPED is a latch of our own: the chassis gives control back by itself when frames resume after
its time-out, when the remote control lets go, or when an error passes. Only ENABLE leads out.
"""

from __future__ import annotations

from enum import Enum
from typing import Dict, Tuple


class State(str, Enum):
    """DISABLED: nothing is sent. ENABLING and STOPPED: speed 0 is sent. ENABLED: commands are."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    ENABLED = "enabled"
    STOPPED = "stopped"


class Event(str, Enum):
    """What can happen. All after CLOSE are what the chassis, the bus or time do."""

    ENABLE = "enable"
    BRAKE = "brake"
    CLOSE = "close"
    CONFIRMED = "confirmed"  # CAN control, brake released, no error
    NOT_CONFIRMED = "not_confirmed"  # within ENABLE_TIMEOUT_S
    COMMAND_LATE = "command_late"  # no fresh command for 2 T
    REMOTE = "remote_control"
    ESTOP = "emergency_stop"
    STANDBY = "chassis_standby"  # or another mode that is not CAN control
    LOCKED = "brake_locked"
    FAULT = "chassis_fault"
    SILENT = "feedback_silent"
    LYING = "feedback_impossible"
    STUCK = "speed_stuck"
    BUS = "bus_error"
    FOREIGN = "foreign_command"  # somebody else commands the chassis


_D, _G, _E, _X = State.DISABLED, State.ENABLING, State.ENABLED, State.STOPPED

TRANSITIONS: Dict[Tuple[State, Event], State] = {
    (_D, Event.ENABLE): _G,
    (_D, Event.BRAKE): _D,
    (_D, Event.CLOSE): _D,
    (_D, Event.CONFIRMED): _D,
    (_D, Event.NOT_CONFIRMED): _D,
    (_D, Event.COMMAND_LATE): _D,
    (_D, Event.REMOTE): _D,
    (_D, Event.ESTOP): _D,
    (_D, Event.STANDBY): _D,
    (_D, Event.LOCKED): _D,
    (_D, Event.FAULT): _D,
    (_D, Event.SILENT): _D,
    (_D, Event.LYING): _D,
    (_D, Event.STUCK): _D,
    (_D, Event.BUS): _D,
    (_D, Event.FOREIGN): _D,
    (_G, Event.ENABLE): _G,
    (_G, Event.BRAKE): _X,
    (_G, Event.CLOSE): _D,
    (_G, Event.CONFIRMED): _E,
    (_G, Event.NOT_CONFIRMED): _X,
    (_G, Event.COMMAND_LATE): _G,  # nothing moves yet
    (_G, Event.REMOTE): _X,
    (_G, Event.ESTOP): _X,
    (_G, Event.STANDBY): _G,  # what is to be ended; so for the next three
    (_G, Event.LOCKED): _G,
    (_G, Event.FAULT): _G,
    (_G, Event.SILENT): _G,
    (_G, Event.LYING): _G,
    (_G, Event.STUCK): _G,
    (_G, Event.BUS): _X,
    (_G, Event.FOREIGN): _X,
    (_E, Event.ENABLE): _G,
    (_E, Event.BRAKE): _X,
    (_E, Event.CLOSE): _D,
    (_E, Event.CONFIRMED): _E,
    (_E, Event.NOT_CONFIRMED): _E,
    (_E, Event.COMMAND_LATE): _X,
    (_E, Event.REMOTE): _X,
    (_E, Event.ESTOP): _X,
    (_E, Event.STANDBY): _X,
    (_E, Event.LOCKED): _X,
    (_E, Event.FAULT): _X,
    (_E, Event.SILENT): _X,
    (_E, Event.LYING): _X,
    (_E, Event.STUCK): _X,
    (_E, Event.BUS): _X,
    (_E, Event.FOREIGN): _X,
    (_X, Event.ENABLE): _G,
    (_X, Event.BRAKE): _X,
    (_X, Event.CLOSE): _D,
    (_X, Event.CONFIRMED): _X,
    (_X, Event.NOT_CONFIRMED): _X,
    (_X, Event.COMMAND_LATE): _X,
    (_X, Event.REMOTE): _X,
    (_X, Event.ESTOP): _X,
    (_X, Event.STANDBY): _X,
    (_X, Event.LOCKED): _X,
    (_X, Event.FAULT): _X,
    (_X, Event.SILENT): _X,
    (_X, Event.LYING): _X,
    (_X, Event.STUCK): _X,
    (_X, Event.BUS): _X,
    (_X, Event.FOREIGN): _X,
}


def render_table() -> str:
    """TRANSITIONS as a Markdown table: a row for each event, a column for each state."""
    lines = [
        "| event | " + " | ".join(f"in {state.value}" for state in State) + " |",
        "|---" * (len(State) + 1) + "|",
    ]
    for event in Event:
        cells = (TRANSITIONS[state, event].value for state in State)
        lines.append(f"| {event.value} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
