"""The simulated network: when a message between two ends arrives, drawn from a seed.

Pure: the caller passes the time in. The same model serves lock-step and training (virtual time),
and real time (timers). The way of a message (`LatencyModel`): queue and line, outage, loss, time
under way, held back or not, duplicated or not, and in order if order is kept.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from edge_runtime.util import UserError

DIRECTIONS = ("up", "down")  # State to edge runtime, and command to simulator
TAILS = ("normal", "lognormal", "pareto")
ORDERS = ("free", "kept")


class Kind(NamedTuple):
    """How the value of a setting is read (None where it does not fit) and written."""

    read: Callable[[str], Any]
    write: Callable[[Any], str] = str


def _measure(units: Mapping[str, float], most: float, least: float = 0.0) -> Kind:
    """Make the kind of a number with a unit; values are kept in the first, whose factor is 1."""
    first = next(iter(units))

    def read(text: str) -> float | None:
        match = re.fullmatch(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)([A-Za-z/%]*)", text)
        if match is None or match[2] not in units:
            return None
        value = float(match[1]) * units[match[2]]
        return value if least <= value <= most else None

    # Reads back as the same
    return Kind(read, lambda value: repr(float(value)).removesuffix(".0") + first)


def _choice(words: Sequence[str]) -> Kind:
    return Kind(lambda text: text if text in words else None)


MS = _measure({"ms": 1.0, "us": 1e-3, "s": 1e3}, most=60_000.0)
SECONDS = _measure({"s": 1.0, "ms": 1e-3, "us": 1e-6}, most=1e6)
PERCENT = _measure({"%": 1.0}, most=100.0)
COUNT = _measure({"": 1.0}, most=1e6, least=1.0)
_RATES = {"kbit/s": 1.0, "bit/s": 1e-3, "Mbit/s": 1e3, "Gbit/s": 1e6}
RATE = _measure(_RATES, most=1e9, least=math.ulp(0.0))


@dataclass(frozen=True)
class Outage:
    """A window in which nothing gets through, once or again and again; the episode begins at 0."""

    length_s: float
    start_s: float  # When the (first) window begins
    period_s: float | None = None  # From one window's begin to the next; None: there is only one

    def covers(self, now_s: float) -> bool:
        since_s = now_s - self.start_s
        if since_s < 0:
            return False
        return (since_s % self.period_s if self.period_s else since_s) < self.length_s


def _read_outages(text: str) -> tuple[Outage, ...] | None:
    """Read windows with a plus between: LENGTH@START, LENGTH/PERIOD or LENGTH/PERIOD@START."""
    windows = []
    # A plus also stands inside an exponent, where it is followed by a bare number.
    for part in re.split(r"(?<!e)\+", text):
        match = re.fullmatch(r"([^/@]+)(?:/([^/@]+))?(?:@([^/@]+))?", part)
        times_s = [SECONDS.read(word) for word in match.groups() if word] if match else []
        if match is None or len(times_s) < 2 or None in times_s:
            return None
        length_s, period_s = times_s[0], times_s[1] if match[2] else None
        if period_s is not None and length_s >= period_s:
            return None
        windows.append(Outage(length_s, times_s[-1], period_s))
    return tuple(windows)


def _write_outages(outages: tuple[Outage, ...]) -> str:
    """Write the windows; a start that is the period is left out."""
    return "+".join(
        SECONDS.write(outage.length_s)
        + ("" if outage.period_s is None else "/" + SECONDS.write(outage.period_s))
        + ("" if outage.start_s == outage.period_s else "@" + SECONDS.write(outage.start_s))
        for outage in outages
    )


OUTAGES = Kind(_read_outages, _write_outages)


def _setting(default: Any, name: str, kind: Kind, example: str) -> Any:
    return field(default=default, metadata={"name": name, "kind": kind, "example": example})


@dataclass(frozen=True)
class DirectionSpec:
    """One direction of the network: the table of settings. UserError for impossible bursts."""

    delay_ms: float = _setting(0.0, "delay", MS, "50ms")  # Mean time under way
    jitter_ms: float = _setting(0.0, "jitter", MS, "10ms")
    """Standard deviation of the time under way; what falls below zero becomes zero."""
    loss_percent: float = _setting(0.0, "loss", PERCENT, "1%")
    """Share of the messages that never arrive, in percent, over all states of the burst model."""
    tail: str = _setting("normal", "tail", _choice(TAILS), "|".join(TAILS))
    """Distribution of the time under way (`SHAPES`); mean and standard deviation stay."""
    burst_messages: float = _setting(0.0, "burst", COUNT, "5")
    """Mean length of a bad stretch in messages (`loss_percents`); 0: losses are independent."""
    burst_loss_percent: float = _setting(100.0, "burst_loss", PERCENT, "80%")
    """Loss inside a bad stretch."""
    clear_loss_percent: float = _setting(0.0, "clear_loss", PERCENT, "0.1%")
    """Loss outside bad stretches."""
    reorder_percent: float = _setting(0.0, "reorder", PERCENT, "1%")
    """Share of the messages that are held back, so that later ones can overtake them."""
    reorder_by_ms: float = _setting(150.0, "reorder_by", MS, "300ms")
    """How long they are held back; the default lets one state of the control loop pass."""
    order: str = _setting("free", "order", _choice(ORDERS), "|".join(ORDERS))
    """``kept``: no message overtakes, so a late message holds up all behind it, as TCP does."""
    duplicate_percent: float = _setting(0.0, "duplicate", PERCENT, "1%")
    """Share of the messages that arrive twice; the copy's time under way is drawn anew."""
    rate_kbps: float = _setting(0.0, "rate", RATE, "1Mbit/s")
    """Bandwidth in 1000 bit/s; 0: no limit."""
    queue_ms: float = _setting(200.0, "queue", MS, "100ms")
    """Longest wait for the line; a message that would wait longer is dropped."""
    outages: tuple[Outage, ...] = _setting((), "outage", OUTAGES, "0.5s@2s+0.2s/10s")
    """Windows in which whatever leaves the sender is lost."""

    def __post_init__(self) -> None:
        if not self.burst_messages:
            return
        clear, loss, burst = self.clear_loss_percent, self.loss_percent, self.burst_loss_percent
        # Good stretches last one message at least, so bad ones cannot fill more than this.
        most = self.burst_messages / (self.burst_messages + 1.0)
        if not (clear <= loss and clear < burst and self.bad_share <= most):
            raise UserError(
                f"loss {loss:g}% is impossible in bursts of {self.burst_messages:g} messages with"
                f" {burst:g}% inside and {clear:g}% outside of them"
            )

    @property
    def bad_share(self) -> float:
        """Share of messages in the bad state that makes the overall loss the asked one."""
        return (self.loss_percent - self.clear_loss_percent) / (
            self.burst_loss_percent - self.clear_loss_percent
        )

    def written(self, prefix: str = "") -> list[str]:
        return [
            f"{prefix}{row.metadata['name']}={row.metadata['kind'].write(value)}"
            for row in fields(self)
            if (value := getattr(self, row.name)) != row.default
        ]


SETTINGS = {row.metadata["name"]: row for row in fields(DirectionSpec)}
"""Name in a specification -> field, whose metadata hold how it is read, and an example."""
GRAMMAR = (
    "none, 50ms+-10ms, or settings such as "
    + ",".join(f"{name}={row.metadata['example']}" for name, row in SETTINGS.items())
    + ", each also with up. or down. before it"
)


@dataclass(frozen=True)
class LatencySpec:
    """Both directions; ``parse_spec(str(spec)) == spec``."""

    up: DirectionSpec = DirectionSpec()
    down: DirectionSpec = DirectionSpec()

    def __str__(self) -> str:
        """Canonical form: defaults are left out, prefixes only where needed."""
        if self.up == self.down:
            return ",".join(self.up.written()) or "none"
        return ",".join(self.up.written("up.") + self.down.written("down."))


def parse_spec(text: str) -> LatencySpec:
    """Read a specification; raise UserError naming the part that is wrong.

    Settings are separated by commas and hold each way; ``up.`` (state to edge) or ``down.``
    (command to simulator) before one is for that way alone and outranks the same one without, in
    any order. GRAMMAR has them all.
    """
    if text.strip() in ("", "none"):
        return LatencySpec()
    given: dict[str, dict[str, Any]] = {"": {}, "up": {}, "down": {}}
    try:
        for part in map(str.strip, text.split(",")):
            prefix, dot, rest = part.partition(".")
            if not dot or prefix not in DIRECTIONS:
                prefix, rest = "", part
            for name, value in _parse_part(rest):
                if name in given[prefix]:
                    raise UserError(f"{name} is set twice")
                given[prefix][name] = value
        return LatencySpec(*(DirectionSpec(**given[""] | given[way]) for way in DIRECTIONS))
    except UserError as error:
        raise UserError(f"latency {text!r}: {error}") from None


def _parse_part(part: str) -> Iterator[tuple[str, Any]]:
    """Yield field and value of a setting, or of delay and jitter in their short form."""
    name, is_named, word = part.partition("=")
    pairs = [(name, word)]
    if not is_named and (match := re.fullmatch(r"(\d.*?)(?:(?:\+-|±)(.*))?", part)):
        pairs = [("delay", match[1])] + ([] if match[2] is None else [("jitter", match[2])])
    for name, word in pairs:
        if name not in SETTINGS:
            raise UserError(f"{part!r} is not understood; write {GRAMMAR}")
        row = SETTINGS[name]
        if (value := row.metadata["kind"].read(word)) is None:
            example = row.metadata["example"]
            raise UserError(f"{part!r} is not understood; write it like {name}={example}")
        yield row.name, value


LOGNORMAL_SIGMA = 1.0
PARETO_ALPHA = 3.0
"""As netem's pareto table. Variance is finite above 2; the third moment is not at 3."""

_LOGNORMAL_MEAN = math.exp(LOGNORMAL_SIGMA**2 / 2)
_LOGNORMAL_STD = _LOGNORMAL_MEAN * math.sqrt(math.expm1(LOGNORMAL_SIGMA**2))
_PARETO_MEAN = PARETO_ALPHA / (PARETO_ALPHA - 1)
_PARETO_STD = _PARETO_MEAN / math.sqrt(PARETO_ALPHA * (PARETO_ALPHA - 2))


def _pareto(draw: float) -> float:
    upper_tail = 0.5 * math.erfc(draw / math.sqrt(2.0))
    return (upper_tail ** (-1.0 / PARETO_ALPHA) - _PARETO_MEAN) / _PARETO_STD


SHAPES: dict[str, Callable[[float], float]] = {
    "normal": lambda draw: draw,
    "lognormal": lambda draw: (math.exp(LOGNORMAL_SIGMA * draw) - _LOGNORMAL_MEAN) / _LOGNORMAL_STD,
    "pareto": _pareto,
}
"""How long a message is under way: shapes with mean 0 and standard deviation 1.

The delay is ``delay + jitter * shape``, so rows with the same delay and jitter compare whatever
their tail; netem's distribution tables are used the same way. All shapes are increasing functions
of one standard normal draw: the same seed delays the same messages, and only how far differs.

A long-tailed network has a floor (propagation) little below its mean and rare, very late messages:
at least ``delay - 0.76 jitter`` with ``lognormal`` and ``delay - 0.58 jitter`` with ``pareto``.
"""


def loss_percents(spec: DirectionSpec, rng: np.random.Generator) -> Iterator[float]:
    """Yield each message's chance to be lost, in percent.

    Losses in bursts are a Markov chain with a good and a bad state, and a loss in each: the model
    of Gilbert (1960, Capacity of a burst-noise channel) as Elliott (1963, Estimates of error rates
    for codes on burst-noise channels) extended it. The chain begins in its stationary state and
    steps once per message (not with time: an idle link does not recover). With netem's
    ``loss gemodel p r 1-h 1-k``::

        r   = 1 / burst                     bad to good; a bad stretch has 1/r messages on average
        p   = r s / (1 - s)                 good to bad
        1-h = burst_loss, 1-k = clear_loss  loss in the bad and in the good state
        s   = (loss - clear_loss) / (burst_loss - clear_loss)     share of messages in the bad state

    so that ``loss`` stays the overall rate and rows with and without bursts compare.
    """
    if not spec.burst_messages:
        yield from itertools.repeat(spec.loss_percent)
    share, to_good = spec.bad_share, 1.0 / spec.burst_messages
    to_bad = to_good * share / (1.0 - share)
    bad = rng.random() < share
    while True:
        yield spec.burst_loss_percent if bad else spec.clear_loss_percent
        if rng.random() < (to_good if bad else to_bad):
            bad = not bad


class LatencyModel:
    """One direction of the network. Not thread-safe; time must not run backwards.

    Each feature draws from a stream of its own, for every message, so that two specifications with
    the same seed meet the same luck and differ only in what was specified.
    """

    def __init__(self, spec: DirectionSpec, seed: np.random.SeedSequence) -> None:
        self.spec = spec
        self._rng = np.random.default_rng(seed)
        bursts, reorder, duplicate = map(np.random.default_rng, seed.spawn(3))
        self._reorder_rng, self._duplicate_rng = reorder, duplicate
        self._loss_percents = loss_percents(spec, bursts)
        self._shape = SHAPES[spec.tail]
        self._line_free_s = self._newest_arrival_s = float("-inf")

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
        times = sorted(left_s + max(0.0, delay_ms) * 1e-3 + extra_s for delay_ms in delays_ms)
        if self.spec.order == "kept":
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
    """The two directions of one episode."""

    up: LatencyModel
    down: LatencyModel


def make_network(spec: LatencySpec, seed: int) -> Network:
    """Make both directions, each with its own stream of the seed."""
    up, down = np.random.SeedSequence(seed).spawn(2)
    return Network(LatencyModel(spec.up, up), LatencyModel(spec.down, down))
