"""How long a release may take to be healthy, and how long it must stay so."""

from __future__ import annotations

import time
from typing import Callable, NamedTuple

from deploy.installer.errors import UnhealthyError

_LOOK_S = 0.05


class Limits(NamedTuple):
    """Both in seconds."""

    within_s: float = 10.0
    settle_s: float = 3.0


def settle(looks_well: Callable[[], bool], limits: Limits, what: str) -> None:
    """Look again and again until it was well for `settle_s` on end.

    `looks_well` raises UnhealthyError itself where there is no hope. Raises UnhealthyError where
    it is not well within `within_s`, or not any more after that.
    """
    end_s = time.monotonic() + limits.within_s
    since_s = None
    while since_s is None or time.monotonic() - since_s < limits.settle_s:
        now_s = time.monotonic()
        if not looks_well():
            since_s = None
            if now_s > end_s:
                raise UnhealthyError(f"{what} is not healthy within {limits.within_s:g} s")
        elif since_s is None:
            since_s = now_s
        time.sleep(_LOOK_S)
