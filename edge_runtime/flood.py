"""How often the same thing is worth a line in the log. Pure: time is passed in."""

from __future__ import annotations

from typing import Dict, NamedTuple, Optional

PERIOD_S = 1.0


class _Said(NamedTuple):
    at_s: float
    unsaid: int


class Flood:
    """Lets the first of each kind through, then one a second. Kinds must be few: all are kept."""

    def __init__(self) -> None:
        self._said: Dict[str, _Said] = {}

    def admit(self, kind: str, now_s: float) -> Optional[int]:
        """How many of this kind went unsaid since the last line, or None: so does this one."""
        said = self._said.get(kind)
        if said is None:
            self._said[kind] = _Said(now_s, 0)
            return 0
        if now_s - said.at_s < PERIOD_S:
            self._said[kind] = said._replace(unsaid=said.unsaid + 1)
            return None
        self._said[kind] = _Said(now_s, 0)
        return said.unsaid
