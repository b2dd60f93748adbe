"""Where a message stands in time. Pure.

Each episode's steps begin at 0; laid over one another they could not be told apart. So episodes
are put end to end on the timelines ``sim_time`` and ``step``, and each has its own besides,
``episode_0`` and so on, that begins at 0.
"""

from __future__ import annotations

from typing import NamedTuple

from edge_runtime.wire import CONTROL_PERIOD_S


class Moment(NamedTuple):
    """One place on all timelines."""

    episode: int
    step: int
    """Within the episode."""
    total_step: int
    """Episodes end to end."""

    @property
    def sim_time_s(self) -> float:
        """Simulated time with the episodes end to end, in seconds."""
        return self.total_step * CONTROL_PERIOD_S

    @property
    def episode_time_s(self) -> float:
        """Simulated time within the episode, in seconds."""
        return self.step * CONTROL_PERIOD_S


class Timeline:
    """Learns where each episode begins from what is seen, so that a viewer may come late."""

    def __init__(self) -> None:
        self.now = Moment(0, 0, 0)
        self._starts: dict[int, int] = {}
        self._end_step = 0

    def place(self, episode: int, step: int) -> Moment:
        """Return the moment of a step and move ``now`` there if that is forward."""
        # A viewer that comes late begins at zero as well: its first step is the first it saw.
        start = self._starts.setdefault(episode, self._end_step)
        moment = Moment(episode, step, start + step)
        self._end_step = max(self._end_step, moment.total_step + 1)
        if moment.total_step > self.now.total_step:
            self.now = moment
        return moment
