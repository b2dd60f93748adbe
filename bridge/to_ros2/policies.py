"""Which policy gives the commands: asked of the edge runtime, for the wire has numbers only."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from bridge.to_ros2.translate import Policy
from edge_runtime.util import UserError
from edge_runtime.vehicles.mapping import CARS

RETRY_S = 2.0

Ask = Callable[[], dict[str, Any]]


class Policies:
    """Remembers what it was told; ``ask`` returns the edge's status, UserError if none answers.

    ``newest`` is what the last call of ``find`` returned.
    """

    def __init__(self, ask: Ask, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._ask, self._clock_s = ask, clock_s
        self._known: dict[str, Policy | None] = {}
        self._ask_again_s = -1.0
        self.newest: Policy | None = None

    def find(self, policy_id: str) -> Policy | None:
        """Return the policy of that id; None while nobody says, and for an unknown scenario.

        Waits for the edge's answer once for each new policy, and seldom where none comes.
        """
        if policy_id not in self._known and self._clock_s() >= self._ask_again_s:
            self._ask_again_s = self._clock_s() + RETRY_S
            self._learn()
        self.newest = self._known.get(policy_id)
        return self.newest

    def _learn(self) -> None:
        try:
            status = self._ask()
        except UserError:
            return  # The edge has just gone; its next command asks again.
        manifest = status["manifest"]
        scenario = manifest["scenario"]
        car = CARS.get(scenario)
        if car is None:
            known = ", ".join(sorted(CARS))
            print(
                f"commands are not shown: the car of scenario {scenario!r} is not known; it is for"
                f" {known}",
                file=sys.stderr,
            )
        names = [action["name"] for action in manifest["action"]]
        self._known[status["policy_id"]] = None if car is None else Policy(names, car)
