"""ROS 2 messages as bytes: CDR behind a header of four bytes, as on the DDS wire.

The header says plain CDR (XCDR version 1), little-endian: `00 01 00 00`; a big-endian one is read,
too. Pure, and safe with several threads: pycdr2's own buffer, one for each type, is not used.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Iterator, Tuple, Type, TypeVar, Union

from edge_runtime.messages import Reason, Rejection
from edge_runtime.ros2.library import Buffer, Endianness
from edge_runtime.ros2.messages import (
    AckermannDriveStamped,
    Image,
    Odometry,
    Twist,
)

HEADER_BYTES = 4
CDR_BIG_ENDIAN, CDR_LITTLE_ENDIAN = 0, 1
MAX_PAYLOAD_BYTES = 1024 * 1024
_ALIGNMENT = 4  # DDS fills a message up to this.
# What hostile bytes make pycdr2 raise: the end too early, bad UTF-8, absurd lengths.
_DECODE_ERRORS = (struct.error, ValueError, OverflowError, MemoryError, IndexError)

RosMessage = Union[AckermannDriveStamped, Twist, Odometry, Image]
_M = TypeVar("_M", AckermannDriveStamped, Twist, Odometry, Image)


def encode(message: RosMessage) -> bytes:
    """The header and the message in little-endian CDR.

    Raises struct.error for a number that its field cannot hold.
    """
    return bytes(message.serialize(buffer=Buffer(), endianness=Endianness.Little))


def decode(payload: bytes, kind: Type[_M]) -> Union[_M, Rejection]:
    """A message of that kind, all of whose numbers are finite, or why not. Never raises."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        detail = f"{len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are read"
        return Rejection(Reason.OVERSIZED, detail)
    if len(payload) < HEADER_BYTES:
        return Rejection(Reason.MALFORMED, f"{len(payload)} bytes are no CDR")
    (representation,) = struct.unpack_from(">H", payload)
    if representation not in (CDR_BIG_ENDIAN, CDR_LITTLE_ENDIAN):
        return Rejection(Reason.SCHEMA, f"CDR of kind {representation:#06x}, not plain CDR")
    buffer = Buffer(payload, align_offset=HEADER_BYTES)
    try:
        # A buffer of our own in place of the bytes, to see where the message ends.
        message: _M = kind.deserialize(buffer)  # type: ignore[arg-type]
    except _DECODE_ERRORS as error:
        return Rejection(Reason.MALFORMED, str(error))
    # pycdr2 takes a text or data that is cut off for a short one; and the type is not in the
    # payload: what is left over is the mark of another one.
    if not 0 <= len(payload) - buffer.tell() < _ALIGNMENT:
        detail = f"{len(payload)} bytes, the {kind.__name__} ends at {buffer.tell()}"
        return Rejection(Reason.MALFORMED, detail)
    return _finite(message)


def _finite(message: _M) -> Union[_M, Rejection]:
    for name, value in _leaves(message, ""):
        if isinstance(value, float) and not math.isfinite(value):
            return Rejection(Reason.NOT_FINITE, f"{name} is {value}")
    return message


def _leaves(value: Any, name: str) -> Iterator[Tuple[str, Any]]:
    if isinstance(value, (list, tuple)):
        for number in value:
            yield name, number
    elif hasattr(value, "__dataclass_fields__"):
        for part in value.__dataclass_fields__:
            yield from _leaves(getattr(value, part), f"{name}.{part}" if name else part)
    else:
        yield name, value
