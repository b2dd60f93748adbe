"""The driver's seat: which page has it, what pages say, and what of that counts.

Pure but for its lock: pages are numbers, and time is passed in. The server's thread sits pages down
and hears them, the loop's thread polls.
"""

from __future__ import annotations

import threading
from typing import Annotated, Any

import msgspec
import numpy as np

from trainer.person.interface import LET_GO, WISHES, Moving, Reading, View, Wish
from trainer.scenarios.picture import HEIGHT_M, VIEW, WIDTH_M

SILENCE_S = 0.5
"""A driver who is not heard for this long has let go."""
MAX_INPUT_BYTES = 1024
"""A page's message is not longer; the longest honest one is a fifth of this."""
Share = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
_ENCODER = msgspec.json.Encoder(
    enc_hook=lambda value: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
)
END = _ENCODER.encode({"kind": "end"}).decode()
"""The sitting is over; a page does not come back."""


class Seat:
    """One driver, the page that has been here longest; the others watch.

    A hold, or a wheel that is turned, counts only after the page was heard with its hands off, and
    after a silence it must be heard so again: a connection that comes back does not take over by
    itself.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pages: list[int] = []
        self._said = LET_GO
        self._tap: Reading | None = None
        """Pressed since the last poll: a tap shorter than a control period counts for one."""
        self._heard_s = float("-inf")
        self._hands_were_off = False
        self._wishes: set[Wish] = set()

    def sit_down(self, page: int) -> None:
        """A page has come."""
        with self._lock:
            self._pages.append(page)

    def get_up(self, page: int) -> None:
        """A page is gone; what its driver wished for still stands."""
        with self._lock:
            if self._pages and self._pages[0] == page:
                self._let_go()
            self._pages = [other for other in self._pages if other != page]

    def is_driver(self, page: int) -> bool:
        """Whether ``page`` has the wheel."""
        with self._lock:
            return self._pages[:1] == [page]

    def is_heard(self, now_s: float) -> bool:
        """Whether the driver can act."""
        with self._lock:
            return now_s - self._heard_s <= SILENCE_S

    def hear(self, page: int, said: Input, now_s: float) -> bool:
        """Take note of what ``page`` says; whether that counts."""
        with self._lock:
            if self._pages[:1] != [page]:
                return False
            if now_s - self._heard_s > SILENCE_S:
                self._let_go()
            self._heard_s = now_s
            self._wishes |= set(said.wishes)
            # Nothing is held, and a wheel that takes over by moving is at rest.
            resting = not said.by_moving or abs(said.action) <= Moving.rest
            self._hands_were_off |= resting and not said.engaged
            if not self._hands_were_off:
                self._said = LET_GO
                return False
            pressed = said.engaged and not self._said.engaged
            self._said = Reading(said.action, said.engaged, by_moving=said.by_moving)
            if pressed:
                self._tap = self._said
            return True

    def poll(self, now_s: float) -> Reading:
        """What the driver does at ``now_s``; each wish once."""
        with self._lock:
            wishes = frozenset(self._wishes)
            self._wishes.clear()
            said = self._said if now_s - self._heard_s <= SILENCE_S else LET_GO
            if said is not LET_GO and not said.engaged and self._tap is not None:
                said = self._tap
            self._tap = None
            return Reading(said.action, said.engaged, wishes, said.by_moving)

    def _let_go(self) -> None:
        self._said, self._tap = LET_GO, None
        self._hands_were_off = False
        self._heard_s = float("-inf")


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


INPUT = msgspec.json.Decoder(Input)
"""Decodes a page's message; raises msgspec.MsgspecError where it is none."""


def encode_view(view: View, number: int, shown_s: float) -> str:
    """View ``number``, from 1, which the loop gave at ``shown_s`` (``time.monotonic``).

    ``frames`` are base64 of [2, 45, 80] bytes; ``ground`` is the part to show.
    """
    left_m, top_m = view.scene.get("view", VIEW)
    fields: dict[str, Any] = {name: getattr(view, name) for name in view.__dataclass_fields__}
    fields["frames"] = np.ascontiguousarray(view.frames, dtype=np.uint8).tobytes()
    ground = {"left_m": left_m, "top_m": top_m, "width_m": WIDTH_M, "height_m": HEIGHT_M}
    place = {"kind": "view", "number": number, "shown_s": shown_s, "ground": ground}
    return _ENCODER.encode({**place, **fields}).decode()


def encode_echo(at_ms: float, driving: bool, refused: bool) -> str:
    """The answer to an input: its own clock, whether this page has the wheel (others watch), and
    whether its hold is refused because the hands must be off once.
    """
    echo = {"kind": "echo", "at_ms": at_ms, "driving": driving, "refused": refused}
    return _ENCODER.encode(echo).decode()
