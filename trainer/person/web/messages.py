"""What page and trainer say to each other over the WebSocket: JSON, one message a frame."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from trainer.person.interface import WISHES, View, Wish
from trainer.scenarios.scene import HEIGHT_M, VIEW, WIDTH_M

MAX_INPUT_BYTES = 1024
"""Of a message from a page; the longest honest one is a fifth of this."""
Share = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]


class Input(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a page says, at least every 100 ms; saying nothing is letting go."""

    at_ms: Annotated[float, msgspec.Meta(ge=0.0, le=1e15)]
    """The page's clock, sent back at once, so that the page knows the round trip."""
    action: Share
    engaged: bool
    by_moving: bool = False
    """Whether moving ``action`` takes over, too: a steering wheel."""
    wishes: Annotated[tuple[Wish, ...], msgspec.Meta(max_length=len(WISHES))] = ()
    seen: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Number of the newest view that was drawn."""


_DECODER = msgspec.json.Decoder(Input)
_ENCODER = msgspec.json.Encoder(
    enc_hook=lambda value: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
)


def decode_input(text: str) -> Input:
    """A page's message.

    Raises:
        msgspec.MsgspecError: it is none.
    """
    return _DECODER.decode(text)


def encode_view(view: View, number: int, shown_s: float) -> str:
    """One view. ``frames`` are base64 of [2, 45, 80] bytes; ``ground`` is the part to show.

    Args:
        view: what is seen.
        number: of the view, from 1.
        shown_s: ``time.monotonic`` when the loop gave it.
    """
    left_m, top_m = view.scene.get("view", VIEW)
    fields: dict[str, Any] = {name: getattr(view, name) for name in view.__dataclass_fields__}
    fields["frames"] = np.ascontiguousarray(view.frames, dtype=np.uint8).tobytes()
    ground = {"left_m": left_m, "top_m": top_m, "width_m": WIDTH_M, "height_m": HEIGHT_M}
    place = {"kind": "view", "number": number, "shown_s": shown_s, "ground": ground}
    return _ENCODER.encode({**place, **fields}).decode()


def encode_echo(at_ms: float, driving: bool, refused: bool) -> str:
    """The answer to an input: its own clock, and what came of it.

    Args:
        at_ms: the page's clock in the input.
        driving: whether this page has the wheel; others watch.
        refused: the driver's hold does not count: the hands must be off once.
    """
    echo = {"kind": "echo", "at_ms": at_ms, "driving": driving, "refused": refused}
    return _ENCODER.encode(echo).decode()


END = _ENCODER.encode({"kind": "end"}).decode()
"""The sitting is over; a page does not come back."""
