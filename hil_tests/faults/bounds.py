"""Faults against the operator's bounds: speed cap, leash, and the re-arm of each episode.

A mock Hunter is driven; its 0x221 is taken as the truth, because this mock does not lie.
"""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

from edge_runtime.safety import Event
from hil_tests.faults.hunter import QUIET_S, STANDS_WITHIN_S, speed_mps
from hil_tests.faults.inside import BRIGHT
from hil_tests.faults.observe import SET_POINT, SPEED
from hil_tests.faults.rig import Rig
from hil_tests.faults.rows import LASTS_S, Row, Try, drives_on
from hil_tests.mock_hunter import FAST_S, MODELS

CAP_MPS, OVER = 0.5, 1.03
LEASH_M = 1.0
_HUNTER = MODELS["hunter-2.0"]


def at_the_cap(rig: Rig) -> Try:
    """Judge that it drives as fast as its cap, and no faster, after it has braked."""
    rig.switch(BRIGHT, None)
    time.sleep(LASTS_S)
    rig.switch(BRIGHT, "")
    begin_s = time.monotonic()
    time.sleep(2.0)
    driven_mps, asked_mps = (
        max(speed_mps(data) for _, data in rig.monitor.of(can_id, begin_s))
        for can_id in (SPEED, SET_POINT)
    )
    wrong = [f"{driven_mps:.3f} m/s"] * (not 0.9 * CAP_MPS < driven_mps < OVER * CAP_MPS)
    return Try(wrong=wrong + [f"asked for {asked_mps:.3f} m/s"] * (asked_mps > CAP_MPS + 1e-9))


def leash(rig: Rig) -> Try:
    """Judge the distance of one re-arm, and that neither time nor a restart adds to it."""
    rig.stop_command(time.monotonic())
    rig.chassis.stands_s(time.monotonic(), STANDS_WITHIN_S)
    rig.rearm()
    rig.wait_until_driving(lambda: rig.chassis.moves)
    begun_s = rig.chassis.truth[-1][0] - FAST_S  # it was re-armed at a stand
    stop = rig.stop_command(time.monotonic())
    stands_s = rig.chassis.stands_s(stop.seen_s, STANDS_WITHIN_S)
    heard = [(s, abs(speed_mps(data))) for s, data in rig.monitor.of(SPEED, begun_s)]
    way = pairwise((s, mps) for s, mps in heard if s < stands_s)
    gone_m = sum(0.5 * (before + after) * (t - s) for (s, before), (t, after) in way)
    fastest_mps = max(mps for _, mps in heard)
    stopping_m = fastest_mps * (_HUNTER.dead_time_s + FAST_S)
    stopping_m += fastest_mps**2 / (2 * _HUNTER.braking_mps2)
    # On a busy machine it may stop before, for another reason.
    least_m = 0.8 * LEASH_M * (stop.reason == Event.LEASH.value)
    wrong = [f"{gone_m:.2f} m"] * (not least_m <= gone_m < LEASH_M + stopping_m)
    time.sleep(QUIET_S)
    if rig.number % 2:
        rig.edge.kill()
        rig.edge = rig.start_edge()
        rig.edge.wait_for_line("ready")
        time.sleep(LASTS_S)
    wrong += rig.timeline.drives_between(stop.seen_s)
    wrong += ["moved without a re-arm"] * rig.chassis.moved_between(stands_s, time.monotonic())
    return Try(None, rig.drive_again(lambda: rig.chassis.moves), stop.reason, wrong)


def new_episode(rig: Rig) -> Try:
    """Judge that no new episode starts it, with or without a final state or a new number."""
    sender, kind = rig.sender, rig.number % 3
    rig.wait_until_driving(lambda: rig.chassis.moves)  # otherwise it might begin to move below
    sender.running.clear()
    if kind != 2:
        sender.send_next(final=True)
    sender.episode += kind > 0
    wrong = ["was re-armed before its first state"] * rig.try_rearm()
    time.sleep(3 * rig.period_s if kind else 0.0)
    begin_s = time.monotonic()
    sender.running.set()
    stop = rig.stop_command(begin_s)
    stands_s = rig.chassis.stands_s(stop.seen_s, STANDS_WITHIN_S)
    time.sleep(LASTS_S)
    wrong += rig.timeline.drives_between(begin_s)
    wrong += ["moved without a re-arm"] * rig.chassis.moved_between(stands_s, time.monotonic())
    reasons = {c.reason for c in rig.timeline.commands if c.seen_s > begin_s}
    wrong += [f"stopped for {reasons}"] * (Event.EPISODE.value not in reasons)
    return Try(None, rig.drive_again(lambda: rig.chassis.moves), stop.reason, wrong)


def _rig(settings: str, **options: Any) -> dict[str, Any]:
    return {"vehicle": "hunter", "settings": f"[vehicle]\n{settings}", **options}


_CAP = f"max_speed_mps = {CAP_MPS}"
_WRONG_SCALE = f"{_CAP}\n[vehicle.hunter]\nscale = 1.0"
_HELD = "drives on, at most 3 % above its cap"
_STILL: Any = {"reaction_limit_s": None, "policy": "steady"}
ROWS = [
    drives_on("cap_full_throttle", "Hunter with a speed cap: full throttle", at_the_cap,
              _HELD, rig=_rig(_CAP), policy="mean"),
    drives_on("cap_wrong_scale", "Hunter with a speed cap: `scale` is four times as large",
              at_the_cap, _HELD, rig=_rig(_WRONG_SCALE), policy="mean"),
    drives_on("cap_integrating", "Hunter with a speed cap: a small pedal that adds up",
              at_the_cap, _HELD, rig=_rig(_CAP), policy="steady"),
    Row("leash", "Hunter with a leash of 1 m, and a SIGKILL to the edge runtime",
        "stops within the leash, leash; stands until re-armed", leash, **_STILL,
        flows=True, rig=_rig(f"leash_m = {LEASH_M}")),
    Row("episode_unasked", "A new episode, after the end of the last one or without it",
        "edge sends safe_stop: episode; stands until re-armed", new_episode, **_STILL,
        rig=_rig('rearm = "each_episode"', sender=True)),
]  # fmt: skip
