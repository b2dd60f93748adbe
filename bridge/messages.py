"""The messages on the wire that are drawn and recorded, by topic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from bridge.scene import Scene, decode_scene
from edge_runtime import wire


class Row(NamedTuple):
    """A topic's message. ``decode`` gives something else than a ``kind`` for what is not valid."""

    kind: type
    decode: Callable[[bytes], Any]


MESSAGES = {
    "state": Row(wire.State, wire.decode_state),
    "command": Row(wire.Command, wire.decode_command),
    "feedback": Row(wire.Feedback, wire.decode_feedback),
    "health": Row(wire.Health, wire.decode_health),
    "scene": Row(Scene, decode_scene),
}
