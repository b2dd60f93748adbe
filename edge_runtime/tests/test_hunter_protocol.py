"""The Hunter's CAN frames and fault bits, as bytes and as numbers."""

import math
import struct
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.vehicles.hunter import protocol
from edge_runtime.vehicles.hunter.protocol import FRAMES, PROFILES, decode, encode, status_faults
from edge_runtime.vehicles.mapping import SPECS

HUNTER_2 = SPECS["2.0"]
OK = protocol.SystemStatus(0, 1, 24.0, 0, 0, 0)


def test_golden_vectors():
    for speed_mps, inner_rad, golden in (
        (0.15, 0.0, "00 96 00 00 00 00 00 00"),
        (0.0, 0.2, "00 00 00 00 00 00 00 C8"),
        (-0.15, -0.2, "FF 6A 00 00 00 00 FF 38"),
    ):
        assert protocol.motion(speed_mps, inner_rad, HUNTER_2).data == bytes.fromhex(golden)
    assert encode(protocol.MODE_COMMAND, (protocol.CAN_CONTROL,)) == b"\x01"
    assert [frame.can_id for frame in protocol.COMMANDS] == [0x111, 0x131, 0x421, 0x441]


def test_feedback_by_hand():
    status = decode(0x211, bytes.fromhex("02 01 00 F5 02 C1 01 FF"))
    assert status == pytest.approx((2, 1, 24.5, 0x02C1, 1, 255))
    moving = decode(0x221, bytes.fromhex("FF 6A 00 00 00 00 00 C8"))
    assert moving == pytest.approx((-0.15, 0.2))
    fast = decode(0x253, bytes.fromhex("FF FF 00 0A FF FF FF FE"))
    assert fast == pytest.approx((-1, 1.0, -2))
    slow = decode(0x262, bytes.fromhex("00 F0 FF F6 E7 41 00 00"))
    assert slow == pytest.approx((24.0, -10, -25, 0x41))


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@given(speed=st.floats(-1e308, 1e308), angle=st.floats(-1e308, 1e308))
def test_no_command_leaves_the_models_limits(spec, speed, angle):
    told = decode(0x111, protocol.motion(speed, angle, spec).data)
    for value, wanted, most in zip(
        told, (speed, angle), (spec.max_speed_mps, spec.max_inner_steering_rad)
    ):
        assert abs(value) <= most + 1e-12
        assert value == pytest.approx(min(max(wanted, -most), most), abs=0.0005 + 1e-12)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_never_a_count_and_what_is_too_much_is_clamped(value):
    for message in (protocol.WheelMotion(value, 0.0), protocol.WheelMotion(0.0, value)):
        with pytest.raises(ValueError, match="no number for the bus"):
            encode(protocol.MOTION_COMMAND, message)
    with pytest.raises(ValueError, match="no number for the bus"):
        protocol.motion(math.nan, 0.0, HUNTER_2)
    data = protocol.encode(protocol.MOTION_COMMAND, protocol.WheelMotion(1e6, -1e6))
    assert struct.unpack(">h4xh", data) == (2**15 - 1, -(2**15))


@pytest.mark.parametrize("frame", FRAMES.values(), ids=lambda frame: hex(frame.can_id))
@given(data=st.data())
def test_every_count_survives_decoding_and_encoding(frame, data):
    """Every byte of every field takes every value; the bytes between are written as zero."""
    raw = data.draw(st.binary(min_size=frame.length, max_size=frame.length))
    message = decode(frame.can_id, raw)
    assert type(message) is frame.message
    assert len(message) == len(frame.worth) == len(struct.unpack(frame.layout, raw))
    zeroed = struct.pack(frame.layout, *struct.unpack(frame.layout, raw))
    assert encode(frame, message) == zeroed


def test_only_a_known_frame_of_the_right_length_is_read_and_nothing_raises():
    for can_id, length in product(range(0x800), range(9)):
        is_known = can_id in FRAMES and length == FRAMES[can_id].length
        assert (decode(can_id, b"\xa5" * length) is not None) == is_known


@pytest.mark.parametrize("profile", PROFILES)
def test_every_fault_bit_has_words(profile):
    assert status_faults(OK, profile) == []
    for bit in range(16):
        (words,) = status_faults(OK._replace(faults=1 << bit), profile)
        assert ("unknown to" in words) == (1 << bit not in PROFILES[profile])


def test_fault_bits_by_hand():
    for profile, faults, words in (
        ("manual", 0x0100, "motor driver"),
        ("v2", 0x0100, "unknown to v2: byte 4 bit 0"),
        ("v2", 0x0001, "battery undervoltage"),
        ("v2", 0x1000, protocol.LINK_LOST),
    ):
        assert status_faults(OK._replace(faults=faults), profile) == [words]
    slow = protocol.MotorSlow(24.0, 30, 30, 0b1100_0101)
    assert protocol.motor_faults(0x261, slow) == [
        "steering motor: supply voltage low",
        "steering motor: driver overcurrent",
    ]
