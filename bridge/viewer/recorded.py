"""The messages of one vehicle from an MCAP recording, as a listener would have heard them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from bridge.feed import Heard
from bridge.recording.reader import Recording, Stored
from bridge.recording.writer import WIRE_ENCODING
from edge_runtime.errors import UserError


def read_heard(path: Path, vehicle_id: str | None) -> Iterator[Heard]:
    """Every wire message of one vehicle, in order of arrival.

    Args:
        path: the recording, which may be cut off.
        vehicle_id: which one; None: the only one in it.

    Raises:
        UserError: no recording, no such vehicle in it, or several and none is named.
    """
    chosen = _choose(path, vehicle_id)
    for stored in Recording(path).messages():
        vehicle, topic = _wire_topic(stored)
        if vehicle == chosen:
            message = stored.message
            key = stored.channel.topic
            yield Heard(key, topic, message.data, message.log_time, len(message.data))


def _choose(path: Path, vehicle_id: str | None) -> str:
    there = {vehicle for vehicle, _ in map(_wire_topic, Recording(path).messages()) if vehicle}
    names = ", ".join(sorted(there)) or "none"
    if vehicle_id is not None and vehicle_id not in there:
        raise UserError(f"{path} holds no vehicle {vehicle_id} (vehicles in it: {names})")
    if vehicle_id is None and len(there) != 1:
        raise UserError(f"{path} holds vehicles {names}; name one with --vehicle-id")
    return vehicle_id or there.pop()


def _wire_topic(stored: Stored) -> tuple[str, str]:
    """The vehicle and the topic of a wire message; empty for a copy for viewers."""
    parts = stored.channel.topic.split("/")
    if stored.channel.message_encoding != WIRE_ENCODING or len(parts) != 3:
        return "", ""
    return parts[1], parts[2]
