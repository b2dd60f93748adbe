"""Delay, jitter and loss of the link, each way: shown and logged, never a reason to stop. Pure.

Each state says when it left, how many commands the simulator has heard, which one last and when.
With the edge's own stamps these are NTP's four (RFC 5905, section 8):

    up   = arrived_ns - sent_ns       = delay + offset      of a state
    down = heard_ns - heard_sent_ns   = delay - offset      of a command

`offset` is the edge's clock less the simulator's. No delay is negative, so the offset lies between
-min(down) and min(up); its middle is wrong by at most half the least round trip (the clock filter
of section 10; each way has its own least time, for a command is paired with no one state).
"""

from __future__ import annotations

from collections import deque
from typing import Any, Deque, Dict, Mapping, Tuple

import msgspec
import numpy as np

from edge_runtime.wire import State

# Windows in messages: 300 follow a change of the delay in 30 s at 10 Hz, and a share of 5 % needs
# 1,200 to be good to half a point.
TIMES, MESSAGES = 300, 1200
KNOWN = 50  # Messages each way before anything is said
FLOOR = 0.05  # The quantile that is the floor of the times: the least alone is luck
FIELDS = ("up_ms", "down_ms", "error_ms", "up_jitter_ms", "down_jitter_ms",
          "up_lost_percent", "down_lost_percent")  # fmt: skip
MOST_PERIODS, MOST_LOST_PERCENT = 2.0, 5.0  # Delay and loss of one way from which a link is poor
GOOD_AGAIN = 0.8  # The share of both limits below which it no longer is


class _Way:
    """One way of the link; its messages are numbered in the order of their sending."""

    def __init__(self) -> None:
        self.times_ms: Deque[float] = deque(maxlen=TIMES)
        self.counts: Deque[Tuple[int, int]] = deque(maxlen=MESSAGES)
        """After each message that came: how many were sent up to the newest, how many came."""
        self.sent = self.came = 0
        self.newest = -1

    def note(self, number: int, came: int = 1) -> None:
        """Count `came` messages up to this number."""
        self.sent += number - self.newest
        self.came += came
        self.newest = number
        self.counts.append((self.sent, self.came))

    def lost_percent(self) -> float:
        """Share of the messages in the window that did not come."""
        (sent, came), (all_sent, all_came) = self.counts[0], self.counts[-1]
        return 100.0 * max(1.0 - (all_came - came) / max(all_sent - sent, 1), 0.0)


class LinkQuality:
    """Measures the link by each accepted state and each command that is sent."""

    def __init__(self) -> None:
        self._begin("")

    def _begin(self, session: str) -> None:
        self._session = session
        self.up, self.down = _Way(), _Way()
        self._episode = -1
        self._sent: Dict[int, Tuple[int, int]] = {}  # a command's number and episode by its stamp
        self._commands = self._heard = self._heard_ns = 0
        self._answered = -1  # the episode of the command that was heard last

    def note_command(self, episode: int, sent_ns: int) -> None:
        self._commands += 1
        self._sent[sent_ns] = (self._commands, episode)
        if len(self._sent) > TIMES:
            del self._sent[next(iter(self._sent))]

    def note_state(self, state: State, arrived_ns: int) -> None:
        is_first = state.session != self._session
        if is_first:  # another simulator: another clock, another network
            self._begin(state.session)
        if state.episode != self._episode:  # what was under way when one ended is no loss
            self._episode = state.episode
            self.up.newest = state.step - 1 if is_first else -1
        if state.final:  # no network carries it
            return
        self.up.note(state.step)
        self.up.times_ms.append((arrived_ns - state.sent_ns) * 1e-6)
        self._note_heard(state.heard, state.heard_sent_ns, state.heard_ns)

    def _note_heard(self, heard: Any, sent_ns: Any, heard_ns: Any) -> None:
        number, episode = self._sent.get(sent_ns, (0, -1))
        if not number or msgspec.UNSET in (heard, heard_ns) or heard_ns == self._heard_ns:
            return
        came, self._heard, self._heard_ns = heard - self._heard, heard, heard_ns
        if episode != self._answered:  # what was under way when the one before ended is forgotten
            self._answered, self.down.newest = episode, number
        elif came > 0:
            self.down.note(number, came)
        self.down.times_ms.append((heard_ns - sent_ns) * 1e-6)

    def measured(self) -> Dict[str, float]:
        """Return FIELDS: mean delays, the error of both, deviations, losses; empty if not known."""
        ways = self.up, self.down
        if min(len(each) for way in ways for each in (way.times_ms, way.counts)) < KNOWN:
            return {}
        up, down = (np.sort(way.times_ms) for way in ways)
        floors_ms = [times[int(FLOOR * len(times))] for times in (up, down)]
        offset_ms = min(max((floors_ms[0] - floors_ms[1]) / 2.0, -down[0]), up[0])
        error_ms = max(up[0] - offset_ms, down[0] + offset_ms)
        delays_ms = up.mean() - offset_ms, down.mean() + offset_ms
        times_ms = map(float, (*delays_ms, error_ms, up.std(), down.std()))
        return dict(zip(FIELDS, (*times_ms, *(way.lost_percent() for way in ways))))


def is_poor(link: Mapping[str, float], control_period_s: float, was_poor: bool = False) -> bool:
    """Return whether a way has a mean delay over 2 T or loses over 5 %; unknown: as it was."""
    if not link:
        return was_poor
    late = max(link["up_ms"], link["down_ms"]) / (MOST_PERIODS * control_period_s * 1e3)
    lost = max(link["up_lost_percent"], link["down_lost_percent"]) / MOST_LOST_PERCENT
    return max(late, lost) > (GOOD_AGAIN if was_poor else 1.0)


def link_words(link: Mapping[str, float]) -> str:
    """Render the link for a person; that of another version, with other fields, is not known."""
    if not link.keys() >= set(FIELDS):
        return "not known yet"
    ways = (
        f"{way} {link[f'{way}_ms']:.1f} ms, jitter {link[f'{way}_jitter_ms']:.1f},"
        f" {link[f'{way}_lost_percent']:.1f} % lost"
        for way in ("up", "down")
    )
    return f"{'; '.join(ways)}; delays +-{link['error_ms']:.1f} ms"
