"""The messages of one vehicle from an MCAP recording, as a listener would have heard them."""

from __future__ import annotations

from collections.abc import Iterator

from bridge.feed import Heard
from bridge.recording.reader import Recording, Stored
from bridge.recording.writer import WIRE_ENCODING
from edge_runtime.util import UserError


def read_heard(recording: Recording, vehicle_id: str | None) -> Iterator[Heard]:
    """Every wire message of one vehicle, in order of arrival.

    Args:
        recording: it may be cut off or damaged, and says so afterwards.
        vehicle_id: which one; None: the only one in it.

    Raises:
        UserError: no recording, no such vehicle in it, or several and none is named.
    """
    chosen = _choose(recording, vehicle_id)
    for stored in recording.messages():
        vehicle, topic = _wire_topic(stored)
        if vehicle == chosen:
            message = stored.message
            key = stored.channel.topic
            yield Heard(key, topic, message.data, message.log_time, len(message.data))


def _choose(recording: Recording, vehicle_id: str | None) -> str:
    there = {vehicle for vehicle, _ in map(_wire_topic, recording.messages()) if vehicle}
    names = ", ".join(sorted(there)) or "none"
    if vehicle_id is not None and vehicle_id not in there:
        raise UserError(f"{recording.path} holds no vehicle {vehicle_id} (vehicles in it: {names})")
    if vehicle_id is None and len(there) != 1:
        raise UserError(f"{recording.path} holds vehicles {names}; name one with --vehicle-id")
    return vehicle_id or there.pop()


def _wire_topic(stored: Stored) -> tuple[str, str]:
    """The vehicle and the topic of a wire message; empty for a copy for viewers."""
    parts = stored.channel.topic.split("/")
    if stored.channel.message_encoding != WIRE_ENCODING or len(parts) != 3:
        return "", ""
    return parts[1], parts[2]
