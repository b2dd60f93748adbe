"""The one place that imports pycdr2: a board without ROS 2 need not have it."""

from __future__ import annotations

from edge_runtime.errors import UserError

try:
    from pycdr2 import IdlStruct

    # Private, but in the signature of `serialize`; the package is pinned, and a test would notice.
    from pycdr2._support import Buffer, Endianness
    from pycdr2.types import array, float32, float64, int32, uint8, uint32
except ImportError:
    raise UserError(
        "ROS 2 messages need the package pycdr2: pip install 'phil-edge-runtime[ros2]',"
        " or pip install pycdr2"
    ) from None

__all__ = [
    "Buffer",
    "Endianness",
    "IdlStruct",
    "array",
    "float32",
    "float64",
    "int32",
    "uint8",
    "uint32",
]
