import math
from typing import Any, Dict, List, Optional, Union, get_type_hints

import msgspec
import pytest
from hil_tests.tests.shared.messages import HEALTH, make_command, make_state
from hil_tests.tests.shared.policies import SIZE, TASK
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime import wire
from edge_runtime.manifest import Entry, Layout
from edge_runtime.util import UserError
from edge_runtime.wire import Command, Feedback, Health, Reason, Rejection, State

LAYOUT = Layout(TASK)
decode_state = LAYOUT.decode
DECODERS: Dict[Any, Any] = {
    State: decode_state,
    Command: wire.decode_command,
    Feedback: wire.decode_feedback,
    Health: wire.decode_health,
}
counts = st.integers(0, 2**63 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
texts = st.text(max_size=64)
OF_TYPE: Dict[Any, Any] = {
    bool: st.booleans(),
    int: counts,
    float: finite,
    str: texts,
    Union[int, msgspec.UnsetType]: counts | st.just(msgspec.UNSET),
    Union[str, msgspec.UnsetType]: texts | st.just(msgspec.UNSET),
    Optional[float]: st.none() | finite,
    List[float]: st.lists(st.floats(-1, 1), min_size=1, max_size=4),
    Union[List[List[float]], msgspec.UnsetType]: st.just(msgspec.UNSET),
    List[str]: st.lists(texts, max_size=3),
    Dict[str, int]: st.dictionaries(texts, counts, max_size=3),
    Dict[str, float]: st.dictionaries(texts, finite, max_size=3),
    Dict[str, bytes]: st.binary(min_size=1, max_size=1).map(lambda byte: {"frames": byte * SIZE}),
}
OF_NAME = {"schema": st.just(wire.SCHEMA), "mode": st.sampled_from(wire.COMMAND_MODES)}


def messages(kind):
    hints = get_type_hints(kind)
    return st.builds(kind, **{name: OF_NAME.get(name, OF_TYPE[hints[name]]) for name in hints})


def as_map(message) -> dict:
    return msgspec.msgpack.decode(wire.encode(message))


@pytest.mark.parametrize("kind", DECODERS)
@given(data=st.data())
def test_round_trip_and_no_damage_raises(kind, data):
    message = data.draw(messages(kind))
    payload = bytearray(wire.encode(message))
    assert DECODERS[kind](bytes(payload)) == message
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    DECODERS[kind](bytes(payload))
    DECODERS[kind](bytes(payload[: data.draw(st.integers(0, len(payload)))]))


def test_state_and_command_have_exactly_the_contracts_fields():
    assert set(as_map(make_state(0))) == {
        "schema", "session", "episode", "step", "sim_time_s", "sent_ns",
        "observation", "speed_mps", "final",
    }  # fmt: skip
    assert set(as_map(make_command())) == {
        "schema", "session", "episode", "step", "mode", "action", "policy_id",
        "received_ns", "inference_ns", "sent_ns", "reason",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"schema": 1}, Reason.SCHEMA),
        ({"schema": 3}, Reason.SCHEMA),
        ({"schema": 9, "step": "nine"}, Reason.SCHEMA),  # though its fields differ
        ({"observation": {"frames": bytes(7199)}}, Reason.OBSERVATION),
        ({"observation": {"frames": bytes(7201)}}, Reason.OBSERVATION),
        ({"observation": {}}, Reason.OBSERVATION),
        ({"observation": {"pixels": bytes(7200)}}, Reason.OBSERVATION),
        ({"observation": {"frames": bytes(7200), "more": b""}}, Reason.OBSERVATION),
        ({"observation": {"frames": bytes(12_000)}}, Reason.OVERSIZED),
        ({"observation": {"frames": "text"}}, Reason.MALFORMED),
        ({"observation": bytes(7200)}, Reason.MALFORMED),
        ({"speed_mps": math.nan}, Reason.NOT_FINITE),
        ({"sim_time_s": math.inf}, Reason.NOT_FINITE),
        ({"step": -1}, Reason.MALFORMED),
        ({"final": None}, Reason.MALFORMED),
        ({"session": "x" * 257}, Reason.MALFORMED),
        ({"task": "x" * 257}, Reason.MALFORMED),
        ({"step": ...}, Reason.MALFORMED),  # it is missing; a further one is ignored: `padded_to`
    ],
)
def test_a_bad_state_is_rejected_by_reason(changes, reason):
    fields = {**as_map(make_state(0)), **changes}
    fields = {name: value for name, value in fields.items() if value is not ...}
    assert rejected(decode_state, fields).reason is reason


def rejected(decode, fields):
    rejection = decode(msgspec.msgpack.encode(fields))
    assert isinstance(rejection, Rejection)
    return rejection


@pytest.mark.parametrize(
    ("action", "mode", "found"),
    [
        ([-1.0, 0.0, 300.0], "drive", None),  # its range is the manifest's
        ([], "drive", (Reason.MALFORMED, "action is empty")),
        ([0.0, math.nan], "drive", (Reason.NOT_FINITE, "action.1 is nan")),
        ([0.0], "fly", (Reason.MALFORMED, "mode 'fly' is neither drive nor safe_stop")),
    ],
)
def test_a_bad_command_is_rejected_by_reason(action, mode, found):
    command = make_command(mode=mode, action=action)
    assert wire.decode_command(wire.encode(command)) == (found or command)


@pytest.mark.parametrize(
    ("plan", "reason"),
    [
        ([[0.1, 0.2]] * 10, None),
        ([], None),
        ([[0.1, 0.2]] * 11, Reason.MALFORMED),
        ([[0.1, 0.2], [0.1]], Reason.MALFORMED),
        ([[0.1, 0.2], [0.1, 0.2, 0.3]], Reason.MALFORMED),
        ([[]], Reason.MALFORMED),
        ([0.1], Reason.MALFORMED),
        ("long", Reason.MALFORMED),
        ([[0.1, 0.2], [0.1, math.inf]], Reason.NOT_FINITE),
    ],
)
def test_a_plan_holds_ten_whole_finite_actions_at_most(plan, reason):
    fields = {**as_map(make_command(action=[0.0, 0.0])), "plan": plan}
    found = wire.decode_command(msgspec.msgpack.encode(fields))
    assert (found.reason if isinstance(found, Rejection) else None) is reason
    assert isinstance(found, Rejection) or found.plan == plan


def test_a_stop_needs_no_action_and_has_no_plan():
    fields = {**as_map(make_command(mode="safe_stop", action=[])), "plan": [[0.5]]}
    found = wire.decode_command(msgspec.msgpack.encode(fields))
    assert isinstance(found, Command)
    assert (found.mode, found.action, found.plan) == ("safe_stop", [], msgspec.UNSET)


def test_the_health_of_an_earlier_version_is_understood_and_so_is_ours_by_it():
    later = {"command_ms", "temperature_c", "load_1min", "rss_mb", "rivals"}
    fields = as_map(HEALTH)
    health = wire.decode_health(
        msgspec.msgpack.encode({k: v for k, v in fields.items() if k not in later})
    )
    assert isinstance(health, Health)
    assert (health.command_ms, health.temperature_c) == ({}, None)
    assert (health.load_1min, health.rss_mb, health.rivals) == (0.0, 0.0, 0)
    old_kind = msgspec.defstruct("Old", [("vehicle_id", str), ("mode", str), ("sent_ns", int)])
    old = msgspec.msgpack.decode(wire.encode(HEALTH), type=old_kind)
    assert old.mode == "standby"  # type: ignore[attr-defined]


def test_keys_and_their_rates_and_hostile_bytes():
    assert (wire.FEEDBACK_HZ, wire.HEALTH_HZ) == (20.0, 2.0)
    assert wire.key("hunter01", "state") == "phil/hunter01/state"
    for bad in ("", "a/b", "*", "a" * 65, "a\n", "h\u00fcnter"):
        with pytest.raises(UserError):
            wire.key(bad, "state")
    for nested in (b"\x91" * 60_000, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff"):
        assert isinstance(decode_state(b"\x82\xa6schema\x01\xa1x" + nested), Rejection)


def padded_to(size: int) -> bytes:
    """A valid state that is so many bytes long, by a field that nobody knows."""
    tried = 3000
    overhead = len(msgspec.msgpack.encode({**as_map(make_state(0)), "more": bytes(tried)})) - tried
    return msgspec.msgpack.encode({**as_map(make_state(0)), "more": bytes(size - overhead)})


def test_a_state_of_many_entries_fits_whatever_their_names_take():
    entries = {
        f"{number:03d}_" + 30 * "x": Entry(dtype="float32", shape=[]) for number in range(300)
    }
    task = msgspec.structs.replace(TASK, observation=entries)
    state = make_state(0, observation=dict.fromkeys(entries, bytes(4)), task=task.text)
    assert isinstance(Layout(task).decode(wire.encode(state)), State)


def test_what_is_just_in_bounds_is_accepted_and_one_more_is_not():
    most = 7200 + 4096  # the manifest's observation, and 4 KiB
    assert len(padded_to(most)) == most
    assert isinstance(decode_state(padded_to(most)), State)
    too_long = (Reason.OVERSIZED, "11297 bytes, at most 11296 are read")
    assert decode_state(padded_to(most + 1)) == too_long
    assert isinstance(wire.decode_state(padded_to(most + 1)), State)  # whoever has no manifest
    for huge in (wire.decode_state(bytes(2**22 + 1)), wire.decode_command(bytes(2**16 + 1))):
        assert isinstance(huge, Rejection)
        assert huge.reason is Reason.OVERSIZED
    for whole in (wire.decode_state(bytes(2**22)), wire.decode_command(bytes(2**16))):
        assert isinstance(whole, Rejection)
        assert whole.reason is Reason.MALFORMED  # it was read
    for count in (256, 257):
        state = decode_state(wire.encode(make_state(0, session="x" * count)))
        assert isinstance(state, State) == (count == 256)


def test_only_feedback_may_say_that_no_command_came_yet():
    feedback = Feedback(
        vehicle="mock", session="", episode=-1, step=-1, mode="standby", action=[0.0],
        speed_mps=0.0, self_braking=True, faults=[], sent_ns=0,
    )  # fmt: skip
    assert wire.decode_feedback(wire.encode(feedback)) == feedback
    for name in ("episode", "step"):
        bad = rejected(wire.decode_feedback, {**as_map(feedback), name: -2})
        assert bad.detail == f"{name} is -2, below the least value"
    negative = {**as_map(HEALTH), "rejected": {"stale": -1}}
    words = "rejected.stale is -1, below the least value"
    assert rejected(wire.decode_health, negative).detail == words
