"""Bytes that no receiver should take: random ones, and valid messages gone wrong. Pure, by seed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import msgspec
import numpy as np

_LONGEST_RANDOM = 512
_SPLICED = 64


def mutated(valid: bytes, count: int, seed: int) -> Iterator[bytes]:
    """``count`` payloads; the n-th is the same for the same seed. Some may be valid still."""
    generator = np.random.default_rng(seed)
    for _ in range(count):
        yield _MUTATORS[int(generator.integers(len(_MUTATORS)))](valid, generator)


def with_fields(valid: bytes, **changes: object) -> bytes:
    """The same MessagePack map with fields replaced by values of any type."""
    return msgspec.msgpack.encode({**msgspec.msgpack.decode(valid), **changes})


def without(valid: bytes, name: str) -> bytes:
    """The same map without one of its fields."""
    fields = msgspec.msgpack.decode(valid)
    del fields[name]
    return msgspec.msgpack.encode(fields)


def _random(valid: bytes, generator: np.random.Generator) -> bytes:
    return generator.bytes(int(generator.integers(0, _LONGEST_RANDOM)))


def _flipped(valid: bytes, generator: np.random.Generator) -> bytes:
    data = bytearray(valid)
    for place in generator.integers(0, len(data), int(generator.integers(1, 5))):
        data[place] ^= 1 << int(generator.integers(8))
    return bytes(data)


def _truncated(valid: bytes, generator: np.random.Generator) -> bytes:
    return valid[: int(generator.integers(0, len(valid)))]


def _extended(valid: bytes, generator: np.random.Generator) -> bytes:
    return valid + generator.bytes(int(generator.integers(1, _SPLICED)))


def _spliced(valid: bytes, generator: np.random.Generator) -> bytes:
    """A stretch of it replaced by a random one of another length."""
    begin, end = sorted(int(place) for place in generator.integers(0, len(valid), 2))
    return valid[:begin] + generator.bytes(int(generator.integers(0, _SPLICED))) + valid[end:]


def _wrong_field(valid: bytes, generator: np.random.Generator) -> bytes:
    """One field of a wrong type or with an absurd value."""
    fields = msgspec.msgpack.decode(valid)
    name = sorted(fields)[int(generator.integers(len(fields)))]
    value = _ABSURD[int(generator.integers(len(_ABSURD)))]
    return msgspec.msgpack.encode({**fields, name: value})


def _missing_field(valid: bytes, generator: np.random.Generator) -> bytes:
    fields = msgspec.msgpack.decode(valid)
    del fields[sorted(fields)[int(generator.integers(len(fields)))]]
    return msgspec.msgpack.encode(fields)


_ABSURD: tuple[object, ...] = (
    None, True, -1, 2**63, -(2**63), float("nan"), float("inf"), 1e308, "", "x" * 300,
    b"", b"\xff" * 70_000, [], [float("nan")], [2.0], [[[[]]]], {}, {"a": {"b": {}}}, "drive",
)  # fmt: skip
_MUTATORS: tuple[Callable[[bytes, np.random.Generator], bytes], ...] = (
    _random, _flipped, _truncated, _extended, _spliced, _wrong_field, _missing_field,
)  # fmt: skip
