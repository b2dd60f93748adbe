"""How a specification of the injected network is written: one table of settings.

Settings are separated by commas and hold each way; ``up.`` (state to edge) or ``down.`` (command
to simulator) before one is for that way alone and outranks the same one without, in any order::

    delay=50ms,jitter=10ms,loss=1%
    50ms+-10ms                              the same delay and jitter, short
    up.delay=30ms,down.loss=2%
    outage=0.5s@2s+0.2s/10s                 0.5 s at second 2, and 0.2 s every 10 s (from 10 s on)
    none                                    a perfect link
"""

from __future__ import annotations

import re
from dataclasses import fields
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

from edge_runtime.latency.spec import DIRECTIONS, ORDERS, TAILS, DirectionSpec, LatencySpec, Outage
from edge_runtime.util import UserError

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


def _measure(text: str, units: Dict[str, float]) -> Optional[float]:
    match = re.fullmatch(rf"({_NUMBER})([A-Za-z/%]*)", text)
    if match is None or match[2] not in units:
        return None
    return float(match[1]) * units[match[2]]


def _read_ms(text: str) -> Optional[float]:
    value_ms = _measure(text, _MS_PER_UNIT)
    if value_ms is not None and value_ms > MAX_DELAY_MS:
        raise UserError(f"latency of {text} is more than {MAX_DELAY_MS / 1e3:g}s")
    return value_ms


def _read_percent(text: str) -> Optional[float]:
    percent = _measure(text, {"%": 1.0})
    return percent if percent is not None and percent <= 100.0 else None


def _read_messages(text: str) -> Optional[float]:
    count = _measure(text, {"": 1.0})
    return count if count is not None and 1.0 <= count <= 1e6 else None


def _read_rate(text: str) -> Optional[float]:
    rate_kbps = _measure(text, _KBPS_PER_UNIT)
    return rate_kbps if rate_kbps is not None and 0.0 < rate_kbps <= 1e9 else None


def _choice(choices: Tuple[str, ...]) -> Callable[[str], Optional[str]]:
    return lambda text: text if text in choices else None


def _read_outages(text: str) -> Optional[Tuple[Outage, ...]]:
    # A plus also stands inside an exponent, where it is followed by a bare number.
    windows = [_read_outage(part) for part in re.split(r"(?<!e)\+", text)]
    return None if None in windows else tuple(window for window in windows if window is not None)


def _read_outage(text: str) -> Optional[Outage]:
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


def _write_outages(outages: Tuple[Outage, ...]) -> str:
    return "+".join(_write_outage(outage) for outage in outages)


def _write_outage(outage: Outage) -> str:
    text = f"{_number(outage.length_s)}s"
    if outage.period_s is not None:
        text += f"/{_number(outage.period_s)}s"
    return text if outage.start_s == outage.period_s else f"{text}@{_number(outage.start_s)}s"


def _ms(name: str, field: str, example: str) -> Setting:
    return Setting(name, field, _read_ms, lambda value: f"{_number(value)}ms", example)


def _percent(name: str, field: str, example: str) -> Setting:
    return Setting(name, field, _read_percent, lambda value: f"{_number(value)}%", example)


SETTINGS: Tuple[Setting, ...] = (
    _ms("delay", "delay_ms", "50ms"),
    _ms("jitter", "jitter_ms", "10ms"),
    _percent("loss", "loss_percent", "1%"),
    Setting("tail", "tail", _choice(TAILS), str, "|".join(TAILS)),
    Setting("burst", "burst_messages", _read_messages, _number, "5"),
    _percent("burst_loss", "burst_loss_percent", "80%"),
    _percent("clear_loss", "clear_loss_percent", "0.1%"),
    _percent("reorder", "reorder_percent", "1%"),
    _ms("reorder_by", "reorder_by_ms", "300ms"),
    Setting("order", "order", _choice(ORDERS), str, "|".join(ORDERS)),
    _percent("duplicate", "duplicate_percent", "1%"),
    Setting("rate", "rate_kbps", _read_rate, lambda v: f"{_number(v)}kbit/s", "1Mbit/s"),
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


def _written(direction: DirectionSpec, prefix: str = "") -> List[str]:
    values = ((row, getattr(direction, row.field)) for row in SETTINGS)
    return [
        f"{prefix}{row.name}={row.write(value)}"
        for row, value in values
        if value != _DEFAULTS[row.field]
    ]


def parse_spec(text: str) -> LatencySpec:
    """Read a specification in the grammar above; raise UserError naming the part that is wrong."""
    if text.strip() in ("", "none"):
        return LatencySpec()
    both: Dict[str, Any] = {}
    single: Dict[str, Dict[str, Any]] = {name: {} for name in DIRECTIONS}
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


def _parse_part(part: str, text: str) -> List[Tuple[Setting, Any]]:
    short = _SHORT.fullmatch(part)
    if short:
        names = ("delay", "jitter")
        given = [(_BY_NAME[name], value) for name, value in zip(names, short.groups()) if value]
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
