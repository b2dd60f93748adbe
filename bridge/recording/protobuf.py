"""Protobuf messages for viewers, described at run time: no compiler, no generated file.

Foxglove and rerun both read protobuf by the descriptor that the recording carries along, and know
``foxglove.RawImage`` and ``foxglove.Log`` by name; field numbers of those two are Foxglove's
(foxglove-sdk, schemas/proto). All others mirror the structs of the wire.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

Field: Any = descriptor_pb2.FieldDescriptorProto
_SCALARS = {
    str: Field.TYPE_STRING,
    bool: Field.TYPE_BOOL,
    int: Field.TYPE_INT64,
    float: Field.TYPE_DOUBLE,
}
_TIMESTAMP = "google.protobuf.Timestamp"
IMAGE_FIELDS = {
    "timestamp": (1, _TIMESTAMP),
    "width": (2, Field.TYPE_FIXED32),
    "height": (3, Field.TYPE_FIXED32),
    "encoding": (4, Field.TYPE_STRING),
    "step": (5, Field.TYPE_FIXED32),
    "data": (6, Field.TYPE_BYTES),
    "frame_id": (7, Field.TYPE_STRING),
}
LOG_FIELDS = {
    "timestamp": (1, _TIMESTAMP),
    "level": (2, "foxglove.Log.Level"),
    "message": (3, Field.TYPE_STRING),
    "name": (4, Field.TYPE_STRING),
}
LOG_LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")


class Schema(NamedTuple):
    """A protobuf message type: its full name, its class, and its serialised FileDescriptorSet."""

    name: str
    make: Any
    descriptors: bytes


def schema_of(kind: type[msgspec.Struct]) -> Schema:
    """Mirror a struct of the wire as ``phil.<its name>``; bytes and unknown types are left out."""
    file = _file("phil", kind.__name__)
    _add_struct(file.message_type.add(), kind)
    return _build(file, f"phil.{kind.__name__}")


def raw_image() -> Schema:
    """Return ``foxglove.RawImage``."""
    file = _file("foxglove", "RawImage")
    _add_table(file.message_type.add(name="RawImage"), IMAGE_FIELDS)
    return _build(file, "foxglove.RawImage")


def log() -> Schema:
    """Return ``foxglove.Log``, of which we fill time, level, text and sender."""
    file = _file("foxglove", "Log")
    message = file.message_type.add(name="Log")
    levels = message.enum_type.add(name="Level")
    for number, name in enumerate(LOG_LEVELS):
        levels.value.add(name=name, number=number)
    _add_table(message, LOG_FIELDS)
    return _build(file, "foxglove.Log")


def fill(target: Any, values: msgspec.Struct) -> Any:
    """Copy the fields that both have into the protobuf message, and return it."""
    for descriptor in target.DESCRIPTOR.fields:
        value = getattr(values, descriptor.name)
        if isinstance(value, Mapping):
            getattr(target, descriptor.name).update(value)
        elif isinstance(value, list):
            _fill_list(getattr(target, descriptor.name), value)
        elif value is not None:
            setattr(target, descriptor.name, value)
    return target


def _fill_list(target: Any, values: list[Any]) -> None:
    if values and isinstance(values[0], msgspec.Struct):
        for value in values:
            fill(target.add(), value)
    else:
        target.extend(values)


def _file(package: str, name: str) -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{package}/{name}.proto", package=package, syntax="proto3"
    )
    if package == "foxglove":
        file.dependency.append("google/protobuf/timestamp.proto")
    return file


def _add_table(message: Any, table: Mapping[str, tuple[int, Any]]) -> None:
    for name, (number, kind) in table.items():
        field = message.field.add(name=name, number=number, label=Field.LABEL_OPTIONAL)
        if isinstance(kind, str):
            field.type = Field.TYPE_MESSAGE if kind == _TIMESTAMP else Field.TYPE_ENUM
            field.type_name = f".{kind}"
        else:
            field.type = kind


def _add_struct(message: Any, kind: type[msgspec.Struct], path: str = "phil") -> None:
    message.name = kind.__name__
    for number, (name, hint) in enumerate(typing.get_type_hints(kind).items(), start=1):
        field = Field(name=name, number=number, label=Field.LABEL_OPTIONAL)
        if _type_field(field, _without_none(hint), message, f"{path}.{kind.__name__}"):
            message.field.append(field)


def _type_field(field: Any, hint: Any, message: Any, path: str) -> bool:
    """Fill in the type; False where the viewers' copy goes without this field."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is dict:
        field.label, field.type = Field.LABEL_REPEATED, Field.TYPE_MESSAGE
        field.type_name = f".{path}.{_add_map_entry(message, field.name, inner)}"
    elif origin is list:
        field.label = Field.LABEL_REPEATED
        return typing.get_origin(inner[0]) is None and _type_field(field, inner[0], message, path)
    elif hint in _SCALARS:
        field.type = _SCALARS[hint]
    elif isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        _add_struct(message.nested_type.add(), hint, path)
        field.type, field.type_name = Field.TYPE_MESSAGE, f".{path}.{hint.__name__}"
    else:
        return False
    return True


def _add_map_entry(message: Any, name: str, inner: tuple[Any, ...]) -> str:
    """Protobuf's own form of a map: a nested message of key and value."""
    entry_name = "".join(part.title() for part in name.split("_")) + "Entry"
    entry = message.nested_type.add(name=entry_name)
    entry.options.map_entry = True
    for number, (label, kind) in enumerate(zip(("key", "value"), inner, strict=True), start=1):
        entry.field.add(name=label, number=number, label=Field.LABEL_OPTIONAL, type=_SCALARS[kind])
    return entry_name


def _without_none(hint: Any) -> Any:
    inner = [part for part in typing.get_args(hint) if part is not type(None)]
    is_optional = type(None) in typing.get_args(hint) and len(inner) == 1
    return inner[0] if is_optional else hint


def _build(file: descriptor_pb2.FileDescriptorProto, name: str) -> Schema:
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    files = [stamp, file] if file.dependency else [file]
    pool = descriptor_pool.DescriptorPool()
    for each in files:
        pool.Add(each)
    descriptors = descriptor_pb2.FileDescriptorSet(file=files).SerializeToString()
    make = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return Schema(name, make, descriptors)
