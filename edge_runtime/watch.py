"""`status --watch`: a short status for the person beside the vehicle, on a phone's terminal."""

from __future__ import annotations

import sys
import time
from typing import Any, Callable, List, Mapping, Optional, Sequence

from edge_runtime.link import link_rows
from edge_runtime.util import UserError, printable

_PERIOD_S = 1.0
_OLD_S = 1.5  # feedback comes twenty times a second
Status = Mapping[str, Any]  # the reply of the queryable


def watch(look: Callable[[], Status], first: Status) -> None:
    """Print the status once a second until ^C, also while the runtime does not answer."""
    lines, clear = render(first), "\x1b[H\x1b[2J" if sys.stdout.isatty() else ""
    while True:
        next_s = time.monotonic() + _PERIOD_S
        print(clear + "\n".join(map(printable, [time.strftime("%H:%M:%S"), *lines])), flush=True)
        time.sleep(max(0.0, next_s - time.monotonic()))
        try:
            lines = render(look())
        except UserError as error:
            lines = [f"NO ANSWER: {error}"]


def render(status: Status) -> List[str]:
    """Render the status as lines of at most 50 characters; only faults may be longer."""
    feedback, command = (status.get(topic) or {} for topic in ("feedback", "command"))
    names = [row["name"] for row in status["manifest"]["action"]]
    speeds = feedback.get("speed_mps"), feedback.get("commanded_speed_mps")
    rows = {
        "vehicle": f"{status['vehicle_id']} ({status['vehicle']})",
        "mode": f"{status['mode']} {status['reason']}",
        "moved by": _who(status),
        "fault": ", ".join(feedback.get("faults", ())) or status["vehicle_fault"] or "none",
        "asked": _actions(names, command.get("action")),
        "achieved": _actions(names, feedback.get("action")),
        "speed": f"{_number(speeds[0], 'm/s')} of {_number(speeds[1])}",
        "cap": f"{_number(status.get('max_speed_mps'), 'm/s')},"
        f" {_number(status.get('max_steering_rad'), 'rad')}",
        "leash": f"{_number(status.get('leash_left_m'), 'm')} of {_number(status.get('leash_m'))}",
        "battery": _number(feedback.get("battery_v"), "V"),
        "board": _number(status.get("temperature_c"), "C"),
        **link_rows(status.get("link", {})),
    }
    age_s = (status["sent_ns"] - feedback.get("sent_ns", status["sent_ns"])) * 1e-9
    if age_s > _OLD_S:
        rows["achieved"] = rows["speed"] = f"not heard for {age_s:.0f} s"
    return [f"{name:<9} {value}" for name, value in rows.items()]


def _who(status: Status) -> str:
    if status["vehicle"] == "none":
        return "nobody: no vehicle"
    return "NOBODY until a re-arm" if status["needs_rearm"] else "THE POLICY"


def _actions(names: Sequence[str], action: Optional[Sequence[float]]) -> str:
    return ", ".join(f"{name} {value:.2f}" for name, value in zip(names, action or ())) or "-"


def _number(value: Optional[float], unit: str = "") -> str:
    return "-" if value is None else f"{value:.2f} {unit}".rstrip()
