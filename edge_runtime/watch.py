"""`status --watch`: what matters to the person beside the vehicle, for the terminal of a phone."""

from __future__ import annotations

import sys
import time
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence

from edge_runtime.link import FIELDS
from edge_runtime.util import UserError, printable
from edge_runtime.wire import DRIVE

_PERIOD_S = 1.0
_CLEAR = "\x1b[H\x1b[2J"
_OLD_S = 1.5  # Feedback comes twenty times a second

Status = Mapping[str, Any]  # The reply of the queryable


def watch(look: Callable[[], Status], first: Status) -> None:
    """Print the status once a second until ^C; a runtime that is gone is waited for."""
    lines = render(first)
    clear = _CLEAR if sys.stdout.isatty() else ""
    while True:
        asked_s = time.monotonic()
        print(clear + "\n".join(map(printable, [time.strftime("%H:%M:%S"), *lines])), flush=True)
        time.sleep(max(0.0, asked_s + _PERIOD_S - time.monotonic()))
        try:
            lines = render(look())
        except UserError as error:
            lines = [f"NO ANSWER: {error}"]


def render(status: Status) -> List[str]:
    """Return a line for each thing, at most some 40 characters wide."""
    feedback: Status = status.get("feedback") or {}
    command: Status = status.get("command") or {}
    names = [row["name"] for row in status["manifest"]["action"]]
    faults = ", ".join(feedback.get("faults", ())) or status["vehicle_fault"]
    rows = {
        "vehicle": f"{status['vehicle_id']} ({status['vehicle']})",
        "mode": " ".join(filter(None, (status["mode"], status["reason"]))),
        "moved by": _who(status),
        "fault": faults or "none",
        "asked": _actions(names, command.get("action")),
        "achieved": _actions(names, feedback.get("action")),
        "speed": _number(feedback.get("speed_mps"), "m/s")
        + _of(feedback.get("commanded_speed_mps"), "asked"),
        "cap": f"{_number(status.get('max_speed_mps'), 'm/s')},"
        f" {_number(status.get('max_steering_rad'), 'rad')}",
        "leash": _number(status.get("leash_left_m"), "m left") + _of(status.get("leash_m"), "of"),
        "battery": _number(feedback.get("battery_v"), "V"),
        "board": _number(status.get("temperature_c"), "C"),
        **_link(status.get("link", {})),
    }
    age_s = (status["sent_ns"] - feedback.get("sent_ns", status["sent_ns"])) * 1e-9
    if age_s > _OLD_S:
        rows["achieved"] = rows["speed"] = f"not heard for {age_s:.0f} s"
    return [f"{name:<9} {value}" for name, value in rows.items()]


def _who(status: Status) -> str:
    """Say who may move the vehicle now."""
    if status["vehicle"] == "none":
        return "nobody: no vehicle"
    if status["needs_rearm"]:
        return "NOBODY until a re-arm"
    return "THE POLICY" if status["mode"] == DRIVE else "THE POLICY, with the next states"


def _link(link: Mapping[str, float]) -> Dict[str, str]:
    if not link.keys() >= set(FIELDS):
        return {"link": "not known yet"}
    return {
        f"link {way}": f"{link[f'{way}_ms']:.0f} ms +-{link[f'{way}_jitter_ms']:.0f},"
        f" {link[f'{way}_lost_percent']:.1f} % lost"
        for way in ("up", "down")
    }


def _actions(names: Sequence[str], action: Optional[Sequence[float]]) -> str:
    if action is None:
        return "-"
    return ", ".join(f"{name} {value:.2f}" for name, value in zip(names, action))


def _number(value: Optional[float], unit: str) -> str:
    return "-" if value is None else f"{value:.2f} {unit}"


def _of(value: Optional[float], word: str) -> str:
    return "" if value is None else f" ({word} {value:.2f})"
