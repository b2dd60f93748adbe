"""The driver's seat: which page has it, and what is believed of what that page says.

Pure but for its lock: pages are numbers, and time is passed in. The server's thread sits pages down
and hears them, the loop's thread polls.
"""

from __future__ import annotations

import threading

from trainer.person.interface import LET_GO, Moving, Reading, Wish
from trainer.person.web.messages import Input

SILENCE_S = 0.5
"""A driver who is not heard for this long has let go."""


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
        """Whether somebody is there who can act."""
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
            self._hands_were_off |= _hands_are_off(said)
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


def _hands_are_off(said: Input) -> bool:
    """Whether nothing is held, nor a wheel that takes over by moving away from its rest."""
    resting = not said.by_moving or abs(said.action) <= Moving.rest
    return resting and not said.engaged
