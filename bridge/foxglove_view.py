"""The wire, live in Foxglove: the copies that `bridge record` makes for viewers, as a WebSocket."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from bridge.messages import Heard
from bridge.record import Schema, ViewerCopies
from bridge.rerun import LOOPBACK
from edge_runtime.util import UserError

try:
    import foxglove
except ImportError:
    raise UserError("--foxglove needs its SDK: pip install 'phil-hil[foxglove]'") from None


@contextlib.contextmanager
def serve(port: int) -> Iterator[Callable[[Heard], None]]:
    """Yield what shows a message; UserError where nothing can be served at the port."""
    context, channels = foxglove.Context(), dict[str, Any]()

    def add(topic: str, schema: Schema, now_ns: int, data: bytes) -> None:
        if topic not in channels:
            told = foxglove.Schema(name=schema.name, encoding="protobuf", data=schema.descriptors)
            kind: Any = {"message_encoding": "protobuf", "schema": told, "context": context}
            channels[topic] = foxglove.Channel(topic, **kind)
        channels[topic].log(data, log_time=now_ns)

    try:
        server = foxglove.start_server(name="phil", host=LOOPBACK, port=port, context=context)
    except RuntimeError as error:
        raise UserError(f"cannot serve Foxglove at port {port}: {error}") from None
    try:
        print(f"open ws://{LOOPBACK}:{port} in Foxglove", flush=True)
        yield ViewerCopies(add).write
    finally:
        server.stop()
