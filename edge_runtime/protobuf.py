"""The protobuf wire format, reading only: enough for an ONNX file, strict about truncation.

https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

from typing import Dict, Iterator, List, Set, Tuple, Union

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT_BYTES = 10
# Python would run out of stack first; a policy nests its graphs two or three deep.
_MAX_DEPTH = 64

Value = Union[int, memoryview]


class ProtobufError(Exception):
    """The bytes are not the message that was expected."""


class Fields:
    """The fields of one message by number; a field that is absent reads as protobuf's default."""

    def __init__(self, values: Dict[int, List[Value]], depth: int) -> None:
        self._values = values
        self._depth = depth

    def has(self, number: int) -> bool:
        """Whether the field is there at all."""
        return number in self._values

    def numbers(self) -> Set[int]:
        """Those of all fields that are there."""
        return set(self._values)

    def integer(self, number: int) -> int:
        """The last value of an integer field, as protobuf defines it; 0 where absent."""
        values = self.integers(number)
        return values[-1] if values else 0

    def integers(self, number: int) -> List[int]:
        """All values of a repeated integer field, packed or not."""
        found: List[int] = []
        for value in self._values.get(number, []):
            if isinstance(value, int):
                found.append(value)
            else:
                found.extend(_unpack(value))
        return found

    def blob(self, number: int) -> bytes:
        """The last value of a bytes field; empty where absent."""
        values = self._values.get(number)
        if not values:
            return b""
        return bytes(_as_bytes(number, values[-1]))

    def text(self, number: int) -> str:
        """The last value of a string field; empty where absent."""
        try:
            return self.blob(number).decode("utf-8")
        except UnicodeDecodeError:
            raise ProtobufError(f"field {number} is not UTF-8 text") from None

    def messages(self, number: int) -> Iterator[Fields]:
        """The nested messages of a repeated field."""
        for value in self._values.get(number, []):
            yield parse_fields(_as_bytes(number, value), self._depth + 1)

    def message(self, number: int) -> Fields:
        """The nested message of a field; an empty one where absent."""
        return next(iter(self.messages(number)), Fields({}, self._depth + 1))


def parse_fields(data: Union[bytes, memoryview], depth: int = 0) -> Fields:
    """Split one message into its fields; nested messages stay bytes until they are asked for.

    Raises ProtobufError when the bytes end within a field or are no protobuf.
    """
    if depth > _MAX_DEPTH:
        raise ProtobufError(f"messages nest deeper than {_MAX_DEPTH}")
    view = memoryview(data)
    values: Dict[int, List[Value]] = {}
    position = 0
    while position < len(view):
        tag, position = _varint(view, position)
        number, kind = tag >> 3, tag & 7
        if number == 0:
            raise ProtobufError("a field has number 0")
        value, position = _value(view, position, kind)
        values.setdefault(number, []).append(value)
    return Fields(values, depth)


def _value(view: memoryview, position: int, kind: int) -> Tuple[Value, int]:
    if kind == _VARINT:
        return _varint(view, position)
    if kind == _BYTES:
        length, position = _varint(view, position)
    elif kind in (_FIXED32, _FIXED64):
        length = 4 if kind == _FIXED32 else 8
    else:
        raise ProtobufError(f"unknown wire type {kind}")
    end = position + length
    if end > len(view):
        raise ProtobufError("it ends within a field")
    return view[position:end], end


def _varint(view: memoryview, position: int) -> Tuple[int, int]:
    result = 0
    for index in range(_MAX_VARINT_BYTES):
        if position + index >= len(view):
            raise ProtobufError("it ends within a number")
        byte = view[position + index]
        result |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return result, position + index + 1
    raise ProtobufError("a number is longer than 10 bytes")


def _unpack(view: memoryview) -> Iterator[int]:
    position = 0
    while position < len(view):
        value, position = _varint(view, position)
        yield value


def _as_bytes(number: int, value: Value) -> memoryview:
    if isinstance(value, int):
        raise ProtobufError(f"field {number} is a number where bytes were expected")
    return value
