"""The simulated network: arrival times of messages between two ends, drawn from a seed.

Pure: the caller passes the time in. `LatencyModel` serves virtual time (`VirtualLink`, in lock-step
and in training) and real time (timers). A message passes queue and line, outages, loss, delay,
reordering, duplication and, if order is kept, waits for those before it.
"""

from __future__ import annotations

import bisect
import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from operator import itemgetter
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
import numpy as np

from bridge.inbound import ROUNDING_S, CommandHold, Decision
from edge_runtime import safety
from edge_runtime.latest import Freshness
from edge_runtime.util import UserError
from edge_runtime.wire import SAFE_STOP, Command

DIRECTIONS = ("up", "down")  # State to edge runtime, and command to simulator
COMMAND_WINDOW = 0.25  # Of T: a command that arrives this soon after a tick still acts in it
STATE_BYTES, COMMAND_BYTES = 122, 217  # A state without its observation
FREE, KEPT = ORDERS = ("free", "kept")
NORMAL, PARETO = TAILS = ("normal", "pareto")
PARETO_ALPHA = 3.0  # As netem's pareto table: variance is finite above 2


@dataclass(frozen=True)
class Outage:
    """A window in which nothing gets through, once or periodic; the episode begins at 0."""

    length_s: float
    start_s: float  # When the (first) window begins
    period_s: float | None = None  # From one window's begin to the next; None: there is only one

    def covers(self, now_s: float) -> bool:
        since_s = now_s - self.start_s
        if since_s < 0:
            return False
        return (since_s % self.period_s if self.period_s else since_s) < self.length_s


_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
_MS = {"ms": 1.0, "us": 1e-3, "s": 1e3}
_KBPS = {"kbit/s": 1.0, "bit/s": 1e-3, "Mbit/s": 1e3, "Gbit/s": 1e6}


def _quantity(
    text: str, units: Mapping[str, float], most: float = 60_000.0, least: float = 0.0
) -> float:
    """Read a number with its unit; ``units`` has the factor of each."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)([A-Za-z/%]*)", text)
    value = float(match[1]) * units.get(match[2], math.nan) if match else math.nan
    if not least <= value <= most:
        raise ValueError(text)
    return value


def _read_outages(text: str) -> tuple[Outage, ...]:
    """Read windows with a plus between: LENGTH@START, LENGTH/PERIOD or LENGTH/PERIOD@START."""
    windows = []
    # A plus also stands inside an exponent, where it is followed by a bare number.
    for part in re.split(r"(?<!e)\+", text):
        match = re.fullmatch(r"([^/@]+)(?:/([^/@]+))?(?:@([^/@]+))?", part)
        words = match.groups() if match else ()
        times_s = [_quantity(word, _S, most=1e6) for word in words if word]
        if len(times_s) < 2 or (words[1] and times_s[0] >= times_s[1]):
            raise ValueError(text)
        windows.append(Outage(times_s[0], times_s[-1], times_s[1] if words[1] else None))
    return tuple(windows)


_ms, _percent = partial(_quantity, units=_MS), partial(_quantity, units={"%": 1.0}, most=100.0)
_messages = partial(_quantity, units={"": 1.0}, most=1e6, least=1.0)
_kbps = partial(_quantity, units=_KBPS, most=1e9, least=math.ulp(0.0))


def _setting(default: Any, name: str, example: str, read: Callable[[str], Any]) -> Any:
    """Make a field that a specification sets as NAME=EXAMPLE; ``read`` raises ValueError."""
    return field(default=default, metadata={"name": name, "example": example, "read": read})


@dataclass(frozen=True)
class DirectionSpec:
    """One direction of the network. UserError for impossible bursts."""

    # Mean delay
    delay_ms: float = _setting(0.0, "delay", "50ms", _ms)
    # Standard deviation of the delay; a negative draw becomes zero
    jitter_ms: float = _setting(0.0, "jitter", "10ms", _ms)
    # Share of messages that never arrive, over good and bad stretches
    loss_percent: float = _setting(0.0, "loss", "1%", _percent)
    # Distribution of the delay (`SHAPES`), with the same mean and standard deviation
    tail: str = _setting(NORMAL, "tail", PARETO, lambda word: TAILS[TAILS.index(word)])
    # Mean length of a bad stretch, in which every message is lost; 0: losses are independent
    burst_messages: float = _setting(0.0, "burst", "5", _messages)
    # Loss outside of bad stretches
    clear_loss_percent: float = _setting(0.0, "clear_loss", "0.1%", _percent)
    # Share of messages held back, so that later ones can overtake; the default lets one state pass
    reorder_percent: float = _setting(0.0, "reorder", "1%", _percent)
    reorder_by_ms: float = _setting(150.0, "reorder_by", "300ms", _ms)
    # ``kept``: no message overtakes, so a late message holds up all behind it, as TCP does
    order: str = _setting(FREE, "order", KEPT, lambda word: ORDERS[ORDERS.index(word)])
    # Share of messages that arrive twice; the copy's delay is drawn anew
    duplicate_percent: float = _setting(0.0, "duplicate", "1%", _percent)
    # Bandwidth in 1000 bit/s; 0: no limit
    rate_kbps: float = _setting(0.0, "rate", "1Mbit/s", _kbps)
    # Longest wait for the line; a message that would wait longer is dropped
    queue_ms: float = _setting(200.0, "queue", "100ms", _ms)
    outages: tuple[Outage, ...] = _setting((), "outage", "0.5s@2s+0.2s/10s", _read_outages)

    def __post_init__(self) -> None:
        if not self.burst_messages:
            return
        clear, loss = self.clear_loss_percent, self.loss_percent
        # Good stretches last one message at least, which limits the share of bad ones.
        most = self.burst_messages / (self.burst_messages + 1.0)
        if not (clear <= loss and clear < 100.0 and self.bad_share <= most):
            raise UserError(
                f"loss {loss:g}% is impossible in bursts of {self.burst_messages:g} messages with"
                f" {clear:g}% outside of them"
            )

    @property
    def bad_share(self) -> float:
        """Share of messages in bad stretches with which the overall loss is ``loss_percent``."""
        return (self.loss_percent - self.clear_loss_percent) / (100.0 - self.clear_loss_percent)


SETTINGS = {each.metadata["name"]: each for each in fields(DirectionSpec)}
"""Name in a specification -> field."""
SHORT_GRAMMAR = "50ms+-10ms or delay=50ms,loss=1% (all settings: bridge/README.md)"
GRAMMAR = (
    "none, 50ms+-10ms, or settings such as "
    + ",".join(f"{name}={row.metadata['example']}" for name, row in SETTINGS.items())
    + ", each also with up. or down. before it"
)


@dataclass(frozen=True)
class LatencySpec:
    """Both directions, and the text that they were read from."""

    up: DirectionSpec = DirectionSpec()
    down: DirectionSpec = DirectionSpec()
    text: str = field(default="none", compare=False)

    def __str__(self) -> str:
        return self.text


def parse_spec(text: str) -> LatencySpec:
    """Read a specification; raise UserError naming the part that is wrong.

    Settings are separated by commas and hold both ways. With the prefix ``up.`` (state to edge) or
    ``down.`` (command to simulator) a setting holds that way alone and outranks the same one
    without, in any order. GRAMMAR has them all.
    """
    settings: dict[str, dict[str, Any]] = {"": {}, "up": {}, "down": {}}
    parts = [part.strip() for part in text.split(",")] if text.strip() else ["none"]
    text = ",".join(parts)
    try:
        for part in parts if text != "none" else ():
            prefix, dot, rest = part.partition(".")
            if not dot or prefix not in DIRECTIONS:
                prefix, rest = "", part
            name, _, word = rest.partition("=")
            pairs = [(name, word)]
            if short := re.fullmatch(r"(\d[^=]*?)(?:(?:\+-|±)(.*))?", rest):
                pairs = [("delay", short[1])] + ([] if short[2] is None else [("jitter", short[2])])
            for name, word in pairs:
                if name not in SETTINGS:
                    raise UserError(f"{part!r} is not understood; write {GRAMMAR}")
                row, about = SETTINGS[name].name, SETTINGS[name].metadata
                if row in settings[prefix]:
                    raise UserError(f"{name} is set twice")
                try:
                    settings[prefix][row] = about["read"](word)
                except ValueError:
                    raise UserError(f"{part!r}: write it like {name}={about['example']}") from None
        up, down = (DirectionSpec(**settings[""] | settings[way]) for way in DIRECTIONS)
        return LatencySpec(up, down, text)
    except UserError as error:
        raise UserError(f"latency {text!r}: {error}") from None


def _pareto(draw: float) -> float:
    mean, upper_tail = PARETO_ALPHA / (PARETO_ALPHA - 1), 0.5 * math.erfc(draw / math.sqrt(2.0))
    std = mean / math.sqrt(PARETO_ALPHA * (PARETO_ALPHA - 2))
    return (upper_tail ** (-1.0 / PARETO_ALPHA) - mean) / std


SHAPES: dict[str, Callable[[float], float]] = {NORMAL: lambda draw: draw, PARETO: _pareto}
"""Shapes of the delay's distribution, with mean 0 and standard deviation 1.

The delay is ``delay + jitter * shape``, as with netem's distribution tables. Both shapes are
increasing functions of one normal draw: the same seed delays the same messages. The Pareto shape
has a floor of ``delay - 0.58 jitter`` and rare, very late messages.
"""


def loss_percents(spec: DirectionSpec, rng: np.random.Generator) -> Iterator[float]:
    """Yield each message's chance to be lost, in percent.

    Bursts are a Markov chain with a good and a bad state, stepped once per message: the model of
    Gilbert (1960, Capacity of a burst-noise channel) as Elliott (1963, Estimates of error rates for
    codes on burst-noise channels) extended it. It goes from bad to good with 1 / burst, and from
    good to bad so that ``loss`` stays the overall rate.
    """
    if not spec.burst_messages:
        yield from itertools.repeat(spec.loss_percent)
    share, to_good = spec.bad_share, 1.0 / spec.burst_messages
    to_bad = to_good * share / (1.0 - share)
    bad = rng.random() < share
    while True:
        yield 100.0 if bad else spec.clear_loss_percent
        if rng.random() < (to_good if bad else to_bad):
            bad = not bad


class LatencyModel:
    """One direction of the network. Not thread-safe; time must not run backwards.

    Each feature draws from a random stream of its own, for every message: two specifications with
    the same seed differ only in the features that they set differently.
    """

    def __init__(self, spec: DirectionSpec, seed: np.random.SeedSequence) -> None:
        self.spec = spec
        self._rng = np.random.default_rng(seed)
        bursts, reorder, duplicate = map(np.random.default_rng, seed.spawn(3))
        self._reorder_rng, self._duplicate_rng = reorder, duplicate
        self._loss_percents = loss_percents(spec, bursts)
        self._shape = SHAPES[spec.tail]
        self._line_free_s = self._newest_arrival_s = -math.inf

    def arrivals(self, now_s: float, size_bytes: int) -> tuple[float, ...]:
        """Return when a message handed over at ``now_s`` arrives (s, same clock), earliest first.

        Empty if it is lost, two times if it is duplicated. ``size_bytes`` matters with a rate.
        """
        lost = self._rng.random() * 100.0 < next(self._loss_percents)
        draw = self._rng.standard_normal()
        held_back = self._reorder_rng.random() * 100.0 < self.spec.reorder_percent
        duplicated = self._duplicate_rng.random() * 100.0 < self.spec.duplicate_percent
        draws = (draw, self._duplicate_rng.standard_normal())[: 1 + duplicated]
        left_s = self._leave_s(now_s, size_bytes)
        if left_s is None or lost or any(outage.covers(left_s) for outage in self.spec.outages):
            return ()
        extra_s = self.spec.reorder_by_ms * 1e-3 if held_back else 0.0
        delays_ms = (self.spec.delay_ms + self.spec.jitter_ms * self._shape(d) for d in draws)
        times = sorted(left_s + max(0.0, ms) * 1e-3 + extra_s for ms in delays_ms)
        if self.spec.order == KEPT:
            times = [max(arrival_s, self._newest_arrival_s) for arrival_s in times]
            self._newest_arrival_s = times[-1]
        return tuple(times)

    def _leave_s(self, now_s: float, size_bytes: int) -> float | None:
        """Return when the message's last byte has left; None if the queue is full."""
        if not self.spec.rate_kbps:
            return now_s
        begin_s = max(now_s, self._line_free_s)
        if begin_s - now_s > self.spec.queue_ms * 1e-3:
            return None
        self._line_free_s = begin_s + size_bytes / (self.spec.rate_kbps * 1e3 / 8)
        return self._line_free_s


class Network(NamedTuple):
    up: LatencyModel
    down: LatencyModel


def make_network(spec: LatencySpec, seed: int) -> Network:
    up, down = np.random.SeedSequence(seed).spawn(2)
    return Network(LatencyModel(spec.up, up), LatencyModel(spec.down, down))


Message = TypeVar("Message")


@dataclass(frozen=True)
class Arrival(Generic[Message]):
    step: int
    arrived_s: float
    message: Message
    overtaken: bool  # A state as new came before: the edge runtime rejects this one unanswered.


class VirtualLink(Generic[Message]):
    """An episode's network in virtual time, and the command that the vehicle holds.

    For each tick: ``send_state``; ``next_at_edge`` and ``answer`` until None comes; ``decide``.
    Answers take no virtual time, so an edge runtime notices no gap. Therefore the link runs the
    safety machine itself, from standby at each episode's start, and turns an answer into a safe
    stop where that machine would not drive.

    ``latencies_ms`` holds each newer answer's latency, from state sent to command received;
    ``stale`` counts the other answers; ``observation_bytes`` is an observation's size.
    """

    def __init__(
        self, spec: LatencySpec, seed: int, period_s: float, observation_bytes: int
    ) -> None:
        self._period_s, self._state_bytes = period_s, STATE_BYTES + observation_bytes
        self.hold = CommandHold(0.0, period_s)
        self._link = make_network(spec, seed)
        self.latencies_ms: list[float] = []
        self.stale = 0
        # By arrival time; messages of the same time keep their order.
        self._under_way: list[tuple[float, Callable[[float], Arrival[Message] | None]]] = []
        self._newest_at_edge = -1
        self._safety = safety.Safety(period_s)
        self._freshness = Freshness(self._safety.answer_s)
        self._unanswered = -1  # The step of a state that came too late to be driven on
        self._step, self._window_end_s = 0, COMMAND_WINDOW * period_s
        self._admitted_s = 0.0

    def send_state(self, step: int, message: Message) -> None:
        tick_s = step * self._period_s
        self._step, self._window_end_s = step, tick_s + COMMAND_WINDOW * self._period_s
        for arrival_s in self._link.up.arrivals(tick_s, self._state_bytes):
            self._push(arrival_s, partial(self._arrive_at_edge, step, message))

    def next_at_edge(self) -> Arrival[Message] | None:
        """Let time run to the next state's arrival at the edge runtime; None at window end."""
        while self._under_way and self._under_way[0][0] <= self._window_end_s + ROUNDING_S:
            now_s, arrive = self._under_way.pop(0)
            if arrival := arrive(now_s):
                return arrival
        return None

    def answer(self, arrival: Arrival[Message], command: Command, computing_s: float = 0.0) -> None:
        """Send the answer to the newest state back; ``computing_s`` is reported only.

        An edge runtime that drives does not answer a state that lags too far behind.
        """
        if arrival.step == self._unanswered:
            return
        if self._safety.mode is safety.Mode.SAFE_STOP:
            command = msgspec.structs.replace(command, mode=SAFE_STOP, reason=self._safety.reason)
        if command.plan:  # extends the silence as in the edge runtime
            ride_s = len(command.plan) * self._period_s
            self._safety = self._safety._replace(ride_s=ride_s)
        for arrival_s in self._link.down.arrivals(arrival.arrived_s, COMMAND_BYTES):
            self._push(arrival_s, partial(self._arrive_at_vehicle, command, computing_s))

    def decide(self, edge_silent: bool = False) -> Decision:
        """Decide this tick; for ``edge_silent`` see ``CommandHold.decide``."""
        # Once its state is answered, the vehicle acts at once: nothing newer can come this tick.
        answered = self.hold.newest_step >= self._step
        return self.hold.decide(self._admitted_s if answered else self._window_end_s, edge_silent)

    def _push(self, arrival_s: float, arrive: Callable[[float], Arrival[Message] | None]) -> None:
        bisect.insort(self._under_way, (arrival_s, arrive), key=itemgetter(0))

    def _arrive_at_edge(self, step: int, message: Message, now_s: float) -> Arrival[Message]:
        overtaken = step <= self._newest_at_edge
        if not overtaken:
            self._newest_at_edge = step
            self._judge(step, now_s)
        return Arrival(step, now_s, message, overtaken)

    def _judge(self, step: int, now_s: float) -> None:
        """Let the edge runtime's safety machine judge the arrival of a newest state."""
        gap = safety.classify_arrival(self._safety, "", now_s - ROUNDING_S, needs_rearm=False)
        if gap is not None:
            self._safety = safety.advance(self._safety, gap)
        stands, sent_s = self._safety.mode is safety.Mode.SAFE_STOP, step * self._period_s
        lag_s = self._freshness.lag_s("", sent_s, now_s, None, stands)
        if lag_s > self._safety.answer_s + ROUNDING_S:
            self._safety = safety.advance(self._safety, safety.Event.LATE)
            self._unanswered = step if self._safety.mode is safety.Mode.DRIVE else -1
            return
        self._safety = safety.note_arrival(self._safety, "", now_s)
        fresh = safety.classify_fresh(self._safety, final=False, needs_rearm=False)
        self._safety = safety.advance(self._safety, fresh)

    def _arrive_at_vehicle(self, command: Command, computing_s: float, now_s: float) -> None:
        answered_step = self.hold.newest_step
        if not self.hold.admit(command, now_s):
            self.stale += 1
            return
        self._admitted_s = now_s
        if command.step > answered_step:
            latency_s = now_s - command.step * self._period_s + computing_s
            self.latencies_ms.append(latency_s * 1e3)
