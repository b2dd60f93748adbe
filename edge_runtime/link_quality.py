"""How good the link is, and whether the policy's envelope allows it. Pure. Contract, section 4.

First the envelope: the networks in which the policy was shown to succeed. `hil_tests envelope`
measures it, `--envelope` puts it into the manifest, under the signature. Then the live link.

Each state says when it left, how many commands the simulator has heard, which one last and when.
With the edge's own stamps these are NTP's four (RFC 5905, section 8):

    up   = arrived_ns - sent_ns       = delay + offset      of a state
    down = heard_ns - heard_sent_ns   = delay - offset      of a command

`offset` is the edge's clock less the simulator's. No delay is negative, so the offset lies between
-min(down) and min(up); its middle is wrong by at most half the least round trip (the clock filter
of section 10; each way has its own least time, for a command is paired with no one state).

Half the mean round trip needs no offset. It is what the envelope was measured with: the same delay
each way. Two ways that differ count as the equal pair that does the same harm: delays add up, so do
variances, and two losses in a row come with the square of their share.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any, Deque, Dict, List, Tuple

import msgspec
import numpy as np

from edge_runtime.util import UserError

if TYPE_CHECKING:
    from edge_runtime.manifest import Manifest, Task
    from edge_runtime.wire import State

ENVELOPE_SCHEMA = 1


class LinkLimits(msgspec.Struct, frozen=True, kw_only=True):
    """How much of each alone the policy bears, each way: mean delay, standard deviation, share of
    messages lost one by one, mean run of lost messages, length of outages.
    """

    delay_ms: float
    jitter_ms: float
    loss_percent: float
    burst_messages: float
    outage_s: float


class LinkEnvelope(msgspec.Struct, frozen=True, kw_only=True):
    """The networks in which the policy succeeds with `promised_success`, as it was measured.

    A network is inside where every value / limit is at most 1 and their sum at most `joint`, and
    where every value / limit is at most `box`. `policy_id` names the file that was measured, before
    the envelope was in it; `network` is the SHA-256 of its graph, which stays the same.
    """

    policy_id: str
    env: str
    condition: str
    promised_success: float
    confidence: float
    control_period_s: float
    limits: LinkLimits
    joint: float
    box: float = 0.0
    network: str = ""
    schema: int = ENVELOPE_SCHEMA


def read_envelope(value: Any, task: Task) -> LinkEnvelope:
    """The envelope in a JSON value. Raises UserError where it is none, or none of this task's."""
    try:
        envelope = msgspec.convert(value, LinkEnvelope)
    except msgspec.ValidationError as error:
        raise UserError(f"the envelope is not valid: {error}") from None
    limits = [getattr(envelope.limits, name) for name in envelope.limits.__struct_fields__]
    if envelope.schema != ENVELOPE_SCHEMA:
        raise UserError(f"the envelope has schema {envelope.schema}, not {ENVELOPE_SCHEMA}")
    finite = all(0.0 <= value < math.inf for value in (*limits, envelope.joint, envelope.box))
    if not (finite and envelope.joint):
        raise UserError("the envelope's limits must be 0 or more, its joint above 0, all finite")
    if envelope.control_period_s != task.control_period_s:
        found = f"the envelope was measured every {envelope.control_period_s:g} s"
        raise UserError(f"{found}, the policy drives every {task.control_period_s:g} s")
    return envelope


# Windows in messages. A deviation of 300 is good to 4 %, and follows a change in 15 s at 10 Hz.
# A share of 5 % needs 1,200 each way to be good to half a point.
TIMES, MESSAGES = 300, 1200
KNOWN, TO_ARM = 20, 200  # Messages each way before anything is said; before a vehicle may be armed
OUTAGE_EVERY_S = 3.0  # The envelope's outages come so often: it turns a share into their length
LEAST = 600  # No drive stops for a share of fewer: one loss in 20 would be 5 %
EVERY = 5  # So many commands from one look to the next: a look takes a quarter of a millisecond
UNSEEN = 3  # So many losses may have been missed (rule of three): to arm, they count
FLOOR = 0.05  # The quantile that is the floor of the times: the least alone is luck
STOP_ABOVE, ARM_BELOW = 0.9, 0.8
"""Loads; 1 is the envelope's edge. What is known of a link lags behind it, so that one that gets
worse stops the vehicle before the edge. Below the lower one it is inside again."""
ACCURACY = {
    "delay_ms": 5.0, "jitter_ms": 5.0, "loss_percent": 1.0, "burst_messages": 1.0, "outage_s": 0.1
}  # fmt: skip
"""The axes. A smaller limit counts as this much: the machine itself disturbs as much."""


class _Way:
    """One way of the link; its messages are numbered in the order of their sending."""

    def __init__(self) -> None:
        self.times_ms: Deque[float] = deque(maxlen=TIMES)
        self.gaps: Deque[int] = deque(maxlen=MESSAGES)
        """For each message that came: how many just before it have not."""
        self.newest = -1

    def note(self, number: int, came: int = 1) -> None:
        """So many have come, the newest of them is this one; late ones fill the newest gaps."""
        missing = max(number - self.newest, 0) - came
        for place in range(len(self.gaps) - 1, -1, -1):
            if missing >= 0:
                break
            filled = min(self.gaps[place], -missing)
            self.gaps[place] -= filled
            missing += filled
        self.gaps.append(min(max(missing, 0), MESSAGES))
        self.gaps.extend([0] * min(came - 1, MESSAGES))
        self.newest = max(number, self.newest)

    def losses(self, unseen: int, least: int) -> Tuple[float, float, float]:
        """Share lost by chance; mean run of what chance cannot explain, and the share lost so.

        Runs of some length and longer are no chance where there are more of them than three
        deviations above what independent losses make; one alone is what the watchdog is for.
        Bursts of geometric length have no memory, so that their mean is told from the long ones.
        """
        runs = [gap for gap in self.gaps if gap]
        total, rate = len(self.gaps) + sum(runs), len(runs) / len(self.gaps)
        bursts: List[int] = []
        for least_run in range(2, max(runs, default=0) + 1):
            bursts = [run for run in runs if run >= least_run]
            by_chance = len(self.gaps) * rate**least_run
            excess = len(bursts) - by_chance - 3.0 * by_chance**0.5
            if excess > (0.0 if unseen or len(bursts) == 1 else 1.0):
                break
            bursts = []
        if len(bursts) == 1 and not unseen:
            runs.remove(bursts.pop())
            total = len(self.gaps) + sum(runs)
        share = min((sum(runs) - sum(bursts) + unseen) / max(total, least), 1.0)
        if not bursts:
            return share, 0.0, 0.0
        # Few runs tell little of their mean: nothing stops for what lies within one deviation.
        sure = 1.0 if unseen else 1.0 - len(bursts) ** -0.5
        mean = sum(bursts) / len(bursts) - least_run + 1.0
        return share, sure * mean, sum(bursts) / max(total, least)


class LinkQuality:
    """The live link beside the envelope; `outside` is why it must stop, empty inside.

    Note what comes and goes, then `judge`. A clock that is set anew reads as jitter, and stops.
    Raises UserError for a manifest without an envelope.
    """

    def __init__(self, manifest: Manifest) -> None:
        self._envelope = read_envelope(manifest.envelope, manifest)
        self._session = ""
        limits = self._envelope.limits
        self.limits = {n: float(max(getattr(limits, n), least)) for n, least in ACCURACY.items()}
        self._begin()

    def _begin(self) -> None:
        self.outside = ""
        self.up, self.down = _Way(), _Way()
        self._episode, self._first = -1, 0  # `_first`: the number of its step 0
        self._recent: Deque[int] = deque(maxlen=64)  # numbers of states: a copy is no message
        self._sent: Dict[int, Tuple[int, int]] = {}  # a command's number and episode by its stamp
        self._commands = self._heard = self._heard_ns = 0
        self._answered = -1  # the episode of the command that was heard last

    def note_command(self, episode: int, sent_ns: int) -> None:
        """A command has gone out."""
        self._commands += 1
        self._sent[sent_ns] = (self._commands, episode)
        if len(self._sent) > MESSAGES:
            del self._sent[next(iter(self._sent))]

    def note_state(self, state: State, arrived_ns: int, is_new: bool = True) -> None:
        """A state has come, a new one or one that was overtaken."""
        if state.session != self._session:  # another simulator: another clock, another network
            if not is_new:
                return  # it is the simulator before that is heard once more
            self._begin()
            self._session = state.session
            self.up.newest = state.step - 1  # what came before it was not ours to hear
        if state.episode > self._episode:
            self._first = 0 if self._episode < 0 else self.up.newest + 1
            self._episode = state.episode
        number = self._first + state.step
        if state.episode < self._episode or number in self._recent:
            return
        self._recent.append(number)
        if state.final:  # no network carries it, and what was under way is forgotten
            self.up.newest = max(number, self.up.newest)
            return
        self.up.note(number)
        self.up.times_ms.append((arrived_ns - state.sent_ns) * 1e-6)
        if number == self.up.newest:
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

    def values(self, unseen: int = 0, least: int = LEAST) -> Dict[str, float]:
        """Each axis of the envelope as it is now; empty while too little is known."""
        ways = self.up, self.down
        known = TO_ARM if unseen else KNOWN
        if min(len(each) for way in ways for each in (way.times_ms, way.gaps)) < known:
            return {}
        shares, bursts, runs = zip(*(way.losses(unseen, least) for way in ways))
        return {
            "delay_ms": float(sum(np.mean(way.times_ms) for way in ways)) / 2.0,
            "jitter_ms": math.hypot(*(np.std(way.times_ms) for way in ways)) / math.sqrt(2.0),
            "loss_percent": math.hypot(*shares) / math.sqrt(2.0) * 100.0,
            "burst_messages": max(bursts),
            "outage_s": max(runs) * OUTAGE_EVERY_S,
        }

    def health(self) -> Dict[str, Any]:
        """Two fields of the health message: `link` is `values` and the load, each way's delay with
        its error bound in ms, and all that is lost in percent; `envelope` its limits.
        """
        link = self.values(least=1)
        if link:
            up, down = self.up.times_ms, self.down.times_ms
            floors = [sorted(times)[int(FLOOR * len(times))] for times in (up, down)]
            offset_ms = min(max((floors[0] - floors[1]) / 2.0, -min(down)), min(up))
            gaps = [sum(way.gaps) / (sum(way.gaps) + len(way.gaps)) for way in (self.up, self.down)]
            link["lost_percent"] = math.hypot(*gaps) / math.sqrt(2.0) * 100.0
            link["load"] = self._load(link)[0]
            link["up_ms"] = float(np.mean(up)) - offset_ms
            link["down_ms"] = float(np.mean(down)) + offset_ms
            link["error_ms"] = max(min(up) - offset_ms, min(down) + offset_ms)
        return {"link": link, "envelope": self.limits}

    def judge(self) -> None:
        """Look at what is known, every fifth command, and keep `outside`."""
        if self._commands % EVERY == 0 and (values := self.values()):
            load, words = self._load(values)
            if load > STOP_ABOVE or load < ARM_BELOW:
                self.outside = words if load > STOP_ABOVE else ""

    def refusal(self) -> str:
        """Why a vehicle may not be armed; empty if it may."""
        if not (values := self.values(UNSEEN, 1)):
            if not self.down.times_ms and self._commands > TO_ARM:
                return "the link is not known: the simulator does not say that it hears commands"
            return f"the link is not known yet: that takes {TO_ARM} messages each way"
        load, words = self._load(values)
        return words if load >= ARM_BELOW else self.outside

    def _load(self, values: Dict[str, float]) -> Tuple[float, str]:
        """How full the envelope is (1: its edge), and what fills it most, in words."""
        limits = self.limits
        shares = {name: values[name] / limits[name] for name in limits}
        # Runs of losses are bursts by their length and outages by their share: they count once.
        once = min(shares["burst_messages"], shares["outage_s"])
        together = (sum(shares.values()) - once) / self._envelope.joint
        worst = max(shares, key=lambda name: shares[name])
        load, words = shares[worst], f"{worst} {values[worst]:.3g}, {limits[worst]:g} at most"
        if together > load:
            load, words = together, f"all axes add up to {together:.2f} of what they may"
        if self._envelope.box:
            load = min(load, shares[worst] / self._envelope.box)
        place = "outside" if load > 1.0 else "too near the edge of"
        return load, f"the link is {place} the policy's envelope: {words}"
