"""Our CDR against rosbags, against bytes written by hand, and against hostile bytes."""

from __future__ import annotations

import struct
from dataclasses import asdict
from threading import Thread

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime.messages import Reason, Rejection
from edge_runtime.ros2 import cdr
from edge_runtime.ros2 import messages as ros
from edge_runtime.ros2.tests import second
from edge_runtime.ros2.tests.strategies import KINDS, MESSAGES

TWIST = ros.Twist(ros.Vector3(1.5, 0.0, -0.25), ros.Vector3(0.0, 0.0, 0.5))
DRIVE = ros.AckermannDriveStamped(
    ros.Header(ros.Time(7, 9), "abc"), ros.AckermannDrive(0.5, 0.0, 1.25)
)


def type_name(kind):
    return kind.__idl_typename__


def test_a_twist_is_a_header_and_six_doubles():
    assert cdr.encode(TWIST) == b"\x00\x01\x00\x00" + struct.pack(
        "<6d", 1.5, 0.0, -0.25, 0.0, 0.0, 0.5
    )


def test_a_stamped_drive_aligns_after_its_text():
    # sec, nanosec, 4 bytes with the ending zero, no padding; then five floats.
    by_hand = struct.pack("<iII4s5f", 7, 9, 4, b"abc\0", 0.5, 0.0, 1.25, 0.0, 0.0)
    assert cdr.encode(DRIVE) == b"\x00\x01\x00\x00" + by_hand
    longer = ros.AckermannDriveStamped(ros.Header(ros.Time(), "abcd"), DRIVE.drive)
    by_hand = struct.pack("<iII8s5f", 0, 0, 5, b"abcd", 0.5, 0.0, 1.25, 0.0, 0.0)
    assert cdr.encode(longer) == b"\x00\x01\x00\x00" + by_hand


@given(MESSAGES)
def test_the_second_library_reads_what_we_write(message):
    read = second.deserialize(type_name(type(message)), cdr.encode(message))
    assert read == asdict(message)


@given(MESSAGES)
def test_we_read_what_the_second_library_writes(message):
    name, fields = type_name(type(message)), asdict(message)
    assert cdr.decode(second.serialize(name, fields), type(message)) == message
    assert cdr.decode(second.serialize_big_endian(name, fields), type(message)) == message


@given(MESSAGES)
def test_both_write_the_same_bytes(message):
    ours = cdr.encode(message)
    theirs = second.serialize(type_name(type(message)), asdict(message))
    # rosbags fills the message up to 4 bytes, as a DDS writer does.
    assert theirs.rstrip(b"\0") == ours.rstrip(b"\0")
    assert 0 <= len(theirs) - len(ours) < 4


@settings(max_examples=500)
@given(st.binary(max_size=1200), KINDS)
def test_random_bytes_never_raise(payload, kind):
    assert isinstance(cdr.decode(payload, kind), (kind, Rejection))


@settings(max_examples=500)
@given(st.sampled_from([b"\0\0\0\0", b"\0\1\0\0"]), st.binary(max_size=1200), KINDS)
def test_random_bytes_after_a_good_header_never_raise(header, body, kind):
    assert isinstance(cdr.decode(header + body, kind), (kind, Rejection))


@settings(max_examples=300)
@given(MESSAGES, st.data())
def test_a_message_that_is_cut_off_or_damaged_never_raises(message, data):
    payload = bytearray(cdr.encode(message))
    kind = type(message)
    cut = data.draw(st.integers(0, len(payload) - 1))
    assert isinstance(cdr.decode(bytes(payload[:cut]), kind), Rejection)
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    assert isinstance(cdr.decode(bytes(payload), kind), (kind, Rejection))


@pytest.mark.parametrize(
    ("payload", "kind", "reason"),
    [
        (b"", ros.Twist, Reason.MALFORMED),
        (b"\0\1\0", ros.Twist, Reason.MALFORMED),
        (b"\0\7\0\0" + bytes(48), ros.Twist, Reason.SCHEMA),  # XCDR version 2
        (cdr.encode(TWIST), ros.Odometry, Reason.MALFORMED),
        (cdr.encode(ros.Odometry()), ros.Twist, Reason.MALFORMED),
        (b"\0\1\0\0" + struct.pack("<6d", *[0.0] * 5, float("nan")), ros.Twist, Reason.NOT_FINITE),
        (b"\0\1\0\0" + struct.pack("<6d", float("inf"), *[0.0] * 5), ros.Twist, Reason.NOT_FINITE),
        (b"\0\1\0\0" + bytes(cdr.MAX_PAYLOAD_BYTES), ros.Image, Reason.OVERSIZED),
        (b"\0\1\0\0" + struct.pack("<iII", 0, 0, 2**32 - 1), ros.Odometry, Reason.MALFORMED),
        (b"\0\1\0\0" + struct.pack("<iII2s", 0, 0, 3, b"\xff\xff"), ros.Odometry, Reason.MALFORMED),
    ],
)
def test_what_is_no_message_says_why(payload, kind, reason):
    rejection = cdr.decode(payload, kind)
    assert isinstance(rejection, Rejection)
    assert rejection.reason == reason


def test_a_nan_in_a_covariance_is_not_finite():
    odometry = ros.Odometry()
    odometry.twist.covariance[3] = float("nan")
    assert cdr.decode(cdr.encode(odometry), ros.Odometry) == Rejection(
        Reason.NOT_FINITE, "twist.covariance is nan"
    )


def test_an_image_of_the_policy_goes_through_whole():
    pixels = bytes(range(256)) * 14 + bytes(16)
    image = ros.Image(ros.Header(), 45, 80, "mono8", 0, 80, pixels)
    assert second.deserialize(type_name(ros.Image), cdr.encode(image))["data"] == pixels


def test_a_message_that_dds_has_filled_up_is_read():
    """As Cyclone DDS writes it: up to 4 bytes, and how many were added in the header."""
    image = ros.Image(height=1, width=3, step=3, data=b"abc")
    plain = cdr.encode(image)
    padding = -len(plain) % 4
    assert padding == 1
    assert cdr.decode(b"\0\1\0\1" + plain[4:] + b"\0", ros.Image) == image
    too_much = cdr.decode(plain + bytes(4), ros.Image)
    assert isinstance(too_much, Rejection)


def test_threads_do_not_share_a_buffer():
    """pycdr2's own buffer, one for each type, would mix their bytes."""
    wrong: list[int] = []

    def go(number):
        message = ros.Image(data=bytes([number]) * 3000)
        expected = cdr.encode(message)
        wrong.extend(1 for _ in range(300) if cdr.encode(message) != expected)

    threads = [Thread(target=go, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
