"""How the driver sees a vehicle behind ROS 2: a pure state machine. LEADS_TO is all of it.

STOPPED is a latch: the chassis drives again by itself as soon as somebody sends it a speed. Only
ENABLE leads out.
"""

from __future__ import annotations

from enum import Enum
from typing import Dict


class State(str, Enum):
    """DISABLED: nothing is sent. ENABLING and STOPPED: speed 0 is sent. ENABLED: commands are."""

    DISABLED = "disabled"
    ENABLING = "enabling"
    ENABLED = "enabled"
    STOPPED = "stopped"


class Event(str, Enum):
    """What can happen. All after CLOSE are what the odometry or time do."""

    ENABLE = "enable"
    BRAKE = "brake"
    CLOSE = "close"
    CONFIRMED = "confirmed"  # fresh odometry
    NOT_CONFIRMED = "not_confirmed"  # within ENABLE_TIMEOUT_S
    COMMAND_LATE = "command_late"  # no fresh command for 2 T
    SILENT = "odometry_silent"
    LYING = "odometry_impossible"
    STUCK = "speed_stuck"


_D, _G, _E, _X = State.DISABLED, State.ENABLING, State.ENABLED, State.STOPPED

# By the state before. A state that is not named stays as it is.
LEADS_TO: Dict[Event, Dict[State, State]] = {
    Event.ENABLE: {_D: _G, _E: _G, _X: _G},
    Event.BRAKE: {_G: _X, _E: _X},
    Event.CLOSE: {_G: _D, _E: _D, _X: _D},
    Event.CONFIRMED: {_G: _E},
    Event.NOT_CONFIRMED: {_G: _X},
    Event.COMMAND_LATE: {_E: _X},  # while ENABLING nothing moves yet
    Event.SILENT: {_E: _X},  # while ENABLING that is what is to be ended
    Event.LYING: {_G: _X, _E: _X},
    Event.STUCK: {_E: _X},
}
