"""What a fault waits for on a rig, and when that came."""

from __future__ import annotations

from edge_runtime.wire import DRIVE, SAFE_STOP
from hil_tests.faults.processes import wait_until
from hil_tests.faults.rig import Rig
from hil_tests.faults.timeline import CommandSeen, first


def own_brake_s(rig: Rig, since_s: float) -> float:
    """When the simulated vehicle's brake went on after ``since_s``."""
    what = "the simulator's own brake"
    return wait_until(
        lambda: first(rig.brakes(), lambda b: b.pressed and b.seen_s > since_s), what
    ).seen_s


def stop_command(rig: Rig, since_s: float) -> CommandSeen:
    """The first safe_stop command after ``since_s``."""
    return wait_until(
        lambda: first(rig.timeline.commands, lambda c: c.seen_s > since_s and c.mode == SAFE_STOP),
        "a safe_stop command",
    )


def logged_stop(rig: Rig, since_s: float) -> tuple[float, str]:
    """When the edge runtime went into safe stop by its log, and why."""
    mode = wait_until(
        lambda: first(rig.timeline.modes, lambda m: m.seen_s > since_s and m.mode == SAFE_STOP),
        "safe_stop in the log",
    )
    return mode.seen_s, mode.reason


def drive_after_s(rig: Rig, since_s: float) -> float:
    """When the first drive command after ``since_s`` came."""
    return wait_until(
        lambda: first(
            # By its sending: what a link held up was driven before.
            rig.timeline.commands,
            lambda c: c.sent_s > since_s and c.mode == DRIVE,
        ),
        "a drive command",
    ).seen_s


def last_state_s(rig: Rig, before_s: float) -> float:
    """When the probe saw the newest state before ``before_s``."""
    return max(s for s in list(rig.timeline.states.values()) if s < before_s)


def last_answered_s(rig: Rig, before_s: float) -> float:
    """When the probe saw the newest state that a drive command answered before ``before_s``."""
    answered = (c.place for c in rig.timeline.commands if c.mode == DRIVE and c.seen_s < before_s)
    return max(rig.timeline.states[place] for place in answered if place in rig.timeline.states)


def must_stop_first(rig: Rig, since_s: float) -> list[str]:
    """Wrong where the first command after a silence is a drive."""
    command = first(rig.timeline.commands, lambda c: c.sent_s > since_s)
    if command is not None and command.mode == DRIVE:
        return ["drove on without a safe stop"]
    return []
