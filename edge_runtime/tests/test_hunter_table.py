"""The Hunter's driver in made-up time: each state and event, and whatever may happen."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import edge_runtime
from edge_runtime.tests.hunter_bench import (
    OK,
    STREAM_S,
    Bench,
)
from edge_runtime.vehicles.hunter import core as rules
from edge_runtime.vehicles.hunter import frames
from edge_runtime.vehicles.hunter.states import TRANSITIONS, Event, State, render_table

OURS = {Event.ENABLE: State.ENABLING, Event.CLOSE: State.DISABLED}
STOP_ENABLING = {
    Event.BRAKE, Event.NOT_CONFIRMED, Event.REMOTE, Event.ESTOP, Event.BUS, Event.FOREIGN
}  # fmt: skip
STOP_DRIVING = set(Event) - set(OURS) - {Event.CONFIRMED, Event.NOT_CONFIRMED}


def expected(state, event):
    if event in OURS:
        return OURS[event]
    if state is State.ENABLING and event is Event.CONFIRMED:
        return State.ENABLED
    stops = {State.ENABLING: STOP_ENABLING, State.ENABLED: STOP_DRIVING}
    return State.STOPPED if event in stops.get(state, ()) else state


def test_every_pair_of_state_and_event():
    assert {
        (state, event): expected(state, event) for state in State for event in Event
    } == TRANSITIONS
    assert render_table().count("\n") == len(Event) + 1


def test_the_readme_shows_the_table():
    readme = Path(edge_runtime.__file__).with_name("README.md").read_text(encoding="utf-8")
    assert render_table() in readme


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("event", Event)
def test_the_core_goes_where_the_table_says(state, event):
    bench = Bench()
    core = bench.core
    core.state = state
    core.set_point.speed_mps = 1.0
    core._wish = core_wish = rules.wish_of({"pedal": 1.0}, None)
    core._apply(rules.Finding(event, "why"), bench.now_s)
    after = TRANSITIONS[state, event]
    assert core.state is after
    if after is State.STOPPED and state is not State.STOPPED:
        assert (core.cause, core.words) == (event, "why")
        assert core.set_point.speed_mps == 0
        assert core._wish is None
    elif after is state:
        assert core._wish is core_wish


def test_a_hundred_thousand_random_frames_never_move_the_vehicle():
    source = random.Random(7)
    bench = Bench()
    core = bench.core
    known = list(frames.FRAMES)
    for number in range(100_000):
        if number % 10_000 == 1_000:
            core.enable(bench.now_s)
        can_id = source.choice(known) if source.random() < 0.8 else source.randrange(0x800)
        data = source.getrandbits(64).to_bytes(8, "big")
        if source.random() < 0.1:
            data = data[: source.randrange(9)]
        core.hear(can_id, data, bench.now_s)
        if number % 10 == 0:
            bench.now_s += STREAM_S
            for frame, sent in core.tick(bench.now_s):
                assert frame in frames.COMMANDS
                if frame is frames.MOTION_COMMAND:
                    assert sent == bytes(8)
            core.report(bench.now_s)


_HAPPENS = st.sampled_from(
    ["tick", "tick", "tick", "command", "enable", "brake", "hold", "status", "remote", "silent"]
)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(_HAPPENS, st.floats(-1, 1)), max_size=120))
def test_it_only_moves_enabled_on_a_fresh_command(happenings):
    bench = Bench()
    core, commanded_s, allowed = bench.core, -1e9, False
    for what, number in happenings:
        if what == "tick":
            before = len(bench.sent)
            bench.step()
            for motion in bench.motions(before):
                if motion.speed_mps != 0:
                    assert allowed
                    assert core.state is State.ENABLED
                    assert bench.now_s - commanded_s <= 0.25 + STREAM_S
        elif what == "command":
            core.command({"pedal": abs(number)}, bench.now_s)
            commanded_s = bench.now_s
        elif what == "enable":
            core.enable(bench.now_s)
            allowed = True
        elif what in ("brake", "hold"):
            core.brake(bench.now_s, latch=what == "brake")
            if what == "brake":
                allowed = False
        elif what == "silent":
            bench.hears = number > 0
        else:
            mode = frames.REMOTE_CONTROL if what == "remote" else frames.CAN_CONTROL
            bench.status = OK._replace(mode=mode)
