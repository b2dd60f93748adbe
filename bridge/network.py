"""The injected network: what becomes of a message between two ends, drawn from a seed.

Pure: no clock, no socket, no global. The caller passes the time in and gets the times at which the
message comes out at the other end: none if it is lost, two if it is duplicated. The same model
serves lock-step and training (virtual time), real time (timers), and the relay.

A specification (`LatencySpec`) says what the network does in each direction; `parse_spec` reads
one as a person writes it. The way of a message (`LatencyModel`): queue and line, outage, loss, time
under way, held back or not, duplicated or not, and in order if order is kept.
"""

from __future__ import annotations

import heapq
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from edge_runtime.util import UserError

DIRECTIONS = ("up", "down")
"""State to edge runtime, and command to simulator."""
TAILS = ("normal", "lognormal", "pareto")
ORDERS = ("free", "kept")


@dataclass(frozen=True)
class Outage:
    """A window in which nothing gets through, once or again and again.

    Time 0 is the episode's start (at the relay: the first state).
    """

    length_s: float
    start_s: float
    """When the (first) window begins."""
    period_s: float | None = None
    """From one window's begin to the next; None: there is only one."""

    def covers(self, now_s: float) -> bool:
        """Whether a message sent at ``now_s`` falls into a window (its end is outside)."""
        since_s = now_s - self.start_s
        if since_s < 0:
            return False
        return (since_s % self.period_s if self.period_s else since_s) < self.length_s


@dataclass(frozen=True)
class DirectionSpec:
    """One direction of the link. Raises UserError for a burst that cannot be.

    Messages are treated one by one, as datagrams are, unless ``order`` is kept.
    """

    delay_ms: float = 0.0
    """Mean time under way."""
    jitter_ms: float = 0.0
    """Standard deviation of the time under way; what falls below zero becomes zero."""
    loss_percent: float = 0.0
    """Share of the messages that never arrive, in percent, over all states of the burst model."""
    tail: str = "normal"
    """Distribution of the time under way (`SHAPES`); mean and standard deviation stay."""
    burst_messages: float = 0.0
    """Mean length of a bad stretch in messages (`BurstLoss`); 0: losses are
    independent."""
    burst_loss_percent: float = 100.0
    """Loss inside a bad stretch."""
    clear_loss_percent: float = 0.0
    """Loss outside bad stretches."""
    reorder_percent: float = 0.0
    """Share of the messages that are held back, so that later ones can overtake them."""
    reorder_by_ms: float = 150.0
    """How long they are held back; the default lets one state of the control loop pass."""
    order: str = "free"
    """``kept``: nobody overtakes, so a late message holds up all behind it, as TCP does."""
    duplicate_percent: float = 0.0
    """Share of the messages that arrive twice; the copy's time under way is drawn anew."""
    rate_kbps: float = 0.0
    """Bandwidth in 1000 bit/s; 0: no limit."""
    queue_ms: float = 200.0
    """Longest wait for the line; a message that would wait longer is dropped."""
    outages: tuple[Outage, ...] = ()
    """Windows in which whatever leaves the sender is lost."""

    def __post_init__(self) -> None:
        if self.burst_messages:
            _check_burst(self)


def bad_share(spec: DirectionSpec) -> float:
    """The share of the messages that meet the bad state, so that the overall loss is the asked."""
    return (spec.loss_percent - spec.clear_loss_percent) / (
        spec.burst_loss_percent - spec.clear_loss_percent
    )


def _check_burst(spec: DirectionSpec) -> None:
    clear, loss, burst = spec.clear_loss_percent, spec.loss_percent, spec.burst_loss_percent
    if not (clear <= loss and clear < burst):
        raise UserError(
            f"loss {loss:g}% in bursts of {burst:g}% is impossible with {clear:g}% outside of"
            " them: clear_loss is at most loss, and below burst_loss"
        )
    # Good stretches last one message at least, so bad ones cannot fill more than this.
    most = spec.burst_messages / (spec.burst_messages + 1.0)
    if bad_share(spec) > most:
        raise UserError(
            f"loss {loss:g}% is too much for bursts of {spec.burst_messages:g} messages: at most"
            f" {clear + most * (burst - clear):.4g}%, or longer bursts"
        )


@dataclass(frozen=True)
class LatencySpec:
    """Both directions; ``parse_spec(str(spec)) == spec``."""

    up: DirectionSpec = DirectionSpec()
    down: DirectionSpec = DirectionSpec()

    def __str__(self) -> str:
        """Canonical form: defaults are left out, prefixes only where needed."""
        return format_spec(self)


MAX_DELAY_MS = 60_000.0
MAX_TIME_S = 1e6

_SECONDS_PER_UNIT = {"us": 1e-6, "ms": 1e-3, "s": 1.0}
_MS_PER_UNIT = {"us": 1e-3, "ms": 1.0, "s": 1e3}
_KBPS_PER_UNIT = {"bit/s": 1e-3, "kbit/s": 1.0, "Mbit/s": 1e3, "Gbit/s": 1e6}
_NUMBER = r"\d+(?:\.\d+)?(?:e[+-]?\d+)?"
_TIME = rf"{_NUMBER}(?:us|ms|s)"
_SHORT = re.compile(rf"({_TIME})(?:(?:\+-|±)({_TIME}))?")
_OUTAGE = re.compile(rf"({_TIME})(?:/({_TIME}))?(?:@({_TIME}))?")


class Setting(NamedTuple):
    """One row of SETTINGS. ``read`` returns None for a value that it does not understand."""

    name: str
    field: str
    read: Callable[[str], Any]
    write: Callable[[Any], str]
    example: str


def _number(value: float) -> str:
    """The shortest text that reads back as the same number."""
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") else text


def _measure(text: str, units: dict[str, float]) -> float | None:
    match = re.fullmatch(rf"({_NUMBER})([A-Za-z/%]*)", text)
    if match is None or match[2] not in units:
        return None
    return float(match[1]) * units[match[2]]


def _read_ms(text: str) -> float | None:
    value_ms = _measure(text, _MS_PER_UNIT)
    if value_ms is not None and value_ms > MAX_DELAY_MS:
        raise UserError(f"latency of {text} is more than {MAX_DELAY_MS / 1e3:g}s")
    return value_ms


def _measured(units: dict[str, float], fits: Callable[[float], bool]) -> Callable[[str], Any]:
    """Return a reader of numbers with a unit that fit; it returns None for any other text."""

    def read(text: str) -> float | None:
        value = _measure(text, units)
        return value if value is not None and fits(value) else None

    return read


_PERCENT = _measured({"%": 1.0}, lambda percent: percent <= 100.0)
_COUNT = _measured({"": 1.0}, lambda count: 1.0 <= count <= 1e6)
_RATE = _measured(_KBPS_PER_UNIT, lambda rate_kbps: 0.0 < rate_kbps <= 1e9)


def _choice(choices: tuple[str, ...]) -> Callable[[str], str | None]:
    return lambda text: text if text in choices else None


def _read_outages(text: str) -> tuple[Outage, ...] | None:
    # A plus also stands inside an exponent, where it is followed by a bare number.
    windows = [_read_outage(part) for part in re.split(r"(?<!e)\+", text)]
    return None if None in windows else tuple(window for window in windows if window is not None)


def _read_outage(text: str) -> Outage | None:
    match = _OUTAGE.fullmatch(text)
    if match is None or not (match[2] or match[3]):
        return None
    length_s, period_s, start_s = (
        None if part is None else _measure(part, _SECONDS_PER_UNIT) for part in match.groups()
    )
    assert length_s is not None
    if start_s is None:
        start_s = period_s
    assert start_s is not None
    if max(length_s, start_s, period_s or 0.0) > MAX_TIME_S:
        return None
    if period_s is not None and length_s >= period_s:
        raise UserError(f"outage {text!r} never ends: the length comes first, then the period")
    return Outage(length_s, start_s, period_s)


def _write_outages(outages: tuple[Outage, ...]) -> str:
    return "+".join(_write_outage(outage) for outage in outages)


def _write_outage(outage: Outage) -> str:
    text = f"{_number(outage.length_s)}s"
    if outage.period_s is not None:
        text += f"/{_number(outage.period_s)}s"
    return text if outage.start_s == outage.period_s else f"{text}@{_number(outage.start_s)}s"


def _ms(name: str, field: str, example: str) -> Setting:
    return Setting(name, field, _read_ms, lambda value: f"{_number(value)}ms", example)


def _percent(name: str, field: str, example: str) -> Setting:
    return Setting(name, field, _PERCENT, lambda value: f"{_number(value)}%", example)


SETTINGS: tuple[Setting, ...] = (
    _ms("delay", "delay_ms", "50ms"),
    _ms("jitter", "jitter_ms", "10ms"),
    _percent("loss", "loss_percent", "1%"),
    Setting("tail", "tail", _choice(TAILS), str, "|".join(TAILS)),
    Setting("burst", "burst_messages", _COUNT, _number, "5"),
    _percent("burst_loss", "burst_loss_percent", "80%"),
    _percent("clear_loss", "clear_loss_percent", "0.1%"),
    _percent("reorder", "reorder_percent", "1%"),
    _ms("reorder_by", "reorder_by_ms", "300ms"),
    Setting("order", "order", _choice(ORDERS), str, "|".join(ORDERS)),
    _percent("duplicate", "duplicate_percent", "1%"),
    Setting("rate", "rate_kbps", _RATE, lambda v: f"{_number(v)}kbit/s", "1Mbit/s"),
    _ms("queue", "queue_ms", "100ms"),
    Setting("outage", "outages", _read_outages, _write_outages, "0.5s@2s+0.2s/10s"),
)
_BY_NAME = {row.name: row for row in SETTINGS}
_DEFAULTS = {field.name: field.default for field in fields(DirectionSpec)}

GRAMMAR = (
    "none, 50ms+-10ms, or settings "
    + ",".join(f"{row.name}={row.example}" for row in SETTINGS)
    + ", each also with up. or down. before it"
)


def format_spec(spec: LatencySpec) -> str:
    """Canonical form: defaults are left out, prefixes only where needed."""
    if spec.up == spec.down:
        return ",".join(_written(spec.up)) or "none"
    return ",".join(_written(spec.up, "up.") + _written(spec.down, "down.")) or "none"


def _written(direction: DirectionSpec, prefix: str = "") -> list[str]:
    values = ((row, getattr(direction, row.field)) for row in SETTINGS)
    return [
        f"{prefix}{row.name}={row.write(value)}"
        for row, value in values
        if value != _DEFAULTS[row.field]
    ]


def parse_spec(text: str) -> LatencySpec:
    """Read a specification; raise UserError naming the part that is wrong.

    Settings are separated by commas and hold each way; ``up.`` (state to edge) or ``down.``
    (command to simulator) before one is for that way alone and outranks the same one without, in
    any order::

        delay=50ms,jitter=10ms,loss=1%
        50ms+-10ms                          the same delay and jitter, short
        up.delay=30ms,down.loss=2%
        outage=0.5s@2s+0.2s/10s             0.5 s at second 2, and 0.2 s every 10 s (from 10 s on)
        none                                a perfect link
    """
    if text.strip() in ("", "none"):
        return LatencySpec()
    both: dict[str, Any] = {}
    single: dict[str, dict[str, Any]] = {name: {} for name in DIRECTIONS}
    for raw_part in text.split(","):
        part = raw_part.strip()
        prefix, dot, rest = part.partition(".")
        prefixed = bool(dot) and prefix in DIRECTIONS
        target = single[prefix] if prefixed else both
        for row, value in _parse_part(rest if prefixed else part, text):
            if row.field in target:
                raise UserError(f"latency {text!r} sets {row.name} twice")
            target[row.field] = value
    try:
        up, down = (DirectionSpec(**{**both, **single[name]}) for name in DIRECTIONS)
    except UserError as error:
        raise UserError(f"latency {text!r}: {error}") from None
    return LatencySpec(up, down)


def _parse_part(part: str, text: str) -> list[tuple[Setting, Any]]:
    short = _SHORT.fullmatch(part)
    if short:
        names = ("delay", "jitter")
        given = [
            (_BY_NAME[name], value)
            for name, value in zip(names, short.groups(), strict=True)
            if value
        ]
        return [(row, row.read(value)) for row, value in given]
    name, _, written = part.partition("=")
    row = _BY_NAME.get(name)
    if row is None:
        raise UserError(f"latency {text!r}: {part!r} is not understood; write {GRAMMAR}")
    value = row.read(written)
    if value is None:
        raise UserError(
            f"latency {text!r}: {part!r} is not understood; write it like {name}={row.example}"
        )
    return [(row, value)]


LOGNORMAL_SIGMA = 1.0
PARETO_ALPHA = 3.0
"""As netem's pareto table. Variance is finite above 2; the third moment is not at 3."""

_LOGNORMAL_MEAN = math.exp(LOGNORMAL_SIGMA**2 / 2)
_LOGNORMAL_STD = _LOGNORMAL_MEAN * math.sqrt(math.expm1(LOGNORMAL_SIGMA**2))
_PARETO_MEAN = PARETO_ALPHA / (PARETO_ALPHA - 1)
_PARETO_STD = _PARETO_MEAN / math.sqrt(PARETO_ALPHA * (PARETO_ALPHA - 2))


def _normal(draw: float) -> float:
    return draw


def _lognormal(draw: float) -> float:
    return (math.exp(LOGNORMAL_SIGMA * draw) - _LOGNORMAL_MEAN) / _LOGNORMAL_STD


def _pareto(draw: float) -> float:
    upper_tail = 0.5 * math.erfc(draw / math.sqrt(2.0))
    return (upper_tail ** (-1.0 / PARETO_ALPHA) - _PARETO_MEAN) / _PARETO_STD


SHAPES: dict[str, Callable[[float], float]] = {
    "normal": _normal,
    "lognormal": _lognormal,
    "pareto": _pareto,
}
"""How long a message is under way: shapes with mean 0 and standard deviation 1.

The delay is ``delay + jitter * shape``, so rows with the same delay and jitter compare whatever
their tail; netem's distribution tables are used the same way. All shapes are increasing functions
of one standard normal draw: the same seed delays the same messages, and only how far differs.

A long-tailed link has a floor (propagation) little below its mean and rare, very late messages:
at least ``delay - 0.76 jitter`` with ``lognormal`` and ``delay - 0.58 jitter`` with ``pareto``.
"""


class IndependentLoss:
    """Every message has the same chance."""

    def __init__(self, spec: DirectionSpec) -> None:
        self._percent = spec.loss_percent

    def percent(self) -> float:
        """Chance of the next message to be lost, in percent."""
        return self._percent


class BurstLoss:
    """Losses in bursts: a Markov chain with a good and a bad state, and a loss in each.

    The model is that of Gilbert (1960, Capacity of a burst-noise channel) as Elliott (1963,
    Estimates of error rates for codes on burst-noise channels) extended it. The chain begins in its
    stationary state and steps once per message (not with time: an idle link does not recover). With
    netem's ``loss gemodel p r 1-h 1-k``::

        r   = 1 / burst                     bad to good; a bad stretch has 1/r messages on average
        p   = r s / (1 - s)                 good to bad
        1-h = burst_loss, 1-k = clear_loss  loss in the bad and in the good state
        s   = (loss - clear_loss) / (burst_loss - clear_loss)     share of messages in the bad state

    so that ``loss`` stays the overall rate and rows with and without bursts compare.
    """

    def __init__(self, spec: DirectionSpec, rng: np.random.Generator) -> None:
        share = bad_share(spec)
        self._loss_percent = {True: spec.burst_loss_percent, False: spec.clear_loss_percent}
        self._to_good = 1.0 / spec.burst_messages
        self._to_bad = self._to_good * share / (1.0 - share)
        self._rng = rng
        self._bad = bool(rng.random() < share)

    def percent(self) -> float:
        """Chance of the next message to be lost, in percent; the chain goes on by one step."""
        percent = self._loss_percent[self._bad]
        leave = self._to_good if self._bad else self._to_bad
        if self._rng.random() < leave:
            self._bad = not self._bad
        return percent


class Line:
    """A line of limited bandwidth with a queue that is bounded by the wait that it stands for."""

    def __init__(self, spec: DirectionSpec) -> None:
        self._rate_bytes_per_s = spec.rate_kbps * 1e3 / 8
        self._longest_wait_s = spec.queue_ms * 1e-3
        self._free_s = float("-inf")

    def send(self, now_s: float, size_bytes: int) -> float | None:
        """When the message's last byte has left; None if the queue is full. No rate: at once."""
        if not self._rate_bytes_per_s:
            return now_s
        begin_s = max(now_s, self._free_s)
        if begin_s - now_s > self._longest_wait_s:
            return None
        self._free_s = begin_s + size_bytes / self._rate_bytes_per_s
        return self._free_s


class LatencyModel:
    """One direction of the link. Not thread-safe; time must not run backwards.

    Each feature draws from a stream of its own, for every message, so that two specifications with
    the same seed meet the same luck and differ only in what was specified.
    """

    def __init__(self, spec: DirectionSpec, seed: np.random.SeedSequence) -> None:
        self.spec = spec
        bursts, reorder, duplicate = seed.spawn(3)
        self._rng = np.random.default_rng(seed)
        self._reorder_rng = np.random.default_rng(reorder)
        self._duplicate_rng = np.random.default_rng(duplicate)
        self._loss = (
            BurstLoss(spec, np.random.default_rng(bursts))
            if spec.burst_messages
            else IndependentLoss(spec)
        )
        self._shape = SHAPES[spec.tail]
        self._line = Line(spec)
        self._newest_arrival_s = float("-inf")

    def arrivals(self, now_s: float, size_bytes: int) -> tuple[float, ...]:
        """When a message handed over at ``now_s`` arrives (s, same clock), earliest first.

        Empty if it is lost, two times if it is duplicated. ``size_bytes`` matters with a rate.
        """
        lost = self._rng.random() * 100.0 < self._loss.percent()
        draws = [self._rng.standard_normal()]
        held_back = self._reorder_rng.random() * 100.0 < self.spec.reorder_percent
        duplicated = self._duplicate_rng.random() * 100.0 < self.spec.duplicate_percent
        second_draw = self._duplicate_rng.standard_normal()
        if duplicated:
            draws.append(second_draw)
        left_s = self._line.send(now_s, size_bytes)
        if left_s is None or lost or any(outage.covers(left_s) for outage in self.spec.outages):
            return ()
        extra_s = self.spec.reorder_by_ms * 1e-3 if held_back else 0.0
        times = sorted(left_s + self._under_way_s(draw) + extra_s for draw in draws)
        return self._in_order(times) if self.spec.order == "kept" else tuple(times)

    def _under_way_s(self, draw: float) -> float:
        under_way_ms = self.spec.delay_ms + self.spec.jitter_ms * self._shape(draw)
        return max(0.0, under_way_ms) * 1e-3

    def _in_order(self, times: list[float]) -> tuple[float, ...]:
        """Nobody overtakes: what would arrive before an earlier message arrives with it."""
        kept = tuple(max(arrival_s, self._newest_arrival_s) for arrival_s in times)
        self._newest_arrival_s = kept[-1]
        return kept


@dataclass(frozen=True)
class Link:
    """The two directions of one episode."""

    up: LatencyModel
    down: LatencyModel


def make_link(spec: LatencySpec, seed: int) -> Link:
    """Make both directions, each with its own stream of the seed."""
    up, down = np.random.SeedSequence(seed).spawn(2)
    return Link(LatencyModel(spec.up, up), LatencyModel(spec.down, down))


Message = TypeVar("Message")


class EventHeap(Generic[Message]):
    """Messages under way, by arrival time; those with the same time keep their order."""

    def __init__(self) -> None:
        self._entries: list[tuple[float, int, Message]] = []
        self._pushed = 0

    def push(self, arrival_s: float, message: Message) -> None:
        """Add a message that arrives at ``arrival_s``."""
        heapq.heappush(self._entries, (arrival_s, self._pushed, message))
        self._pushed += 1

    def pop_due(self, now_s: float) -> tuple[float, Message] | None:
        """Take the earliest message that has arrived by ``now_s``, with its time; None if none."""
        if not self._entries or self._entries[0][0] > now_s:
            return None
        arrival_s, _, message = heapq.heappop(self._entries)
        return arrival_s, message

    def next_arrival_s(self) -> float | None:
        """Return when the earliest message arrives; None if nothing is under way."""
        return self._entries[0][0] if self._entries else None

    def clear(self) -> None:
        """Forget everything under way (an episode has ended)."""
        self._entries.clear()
