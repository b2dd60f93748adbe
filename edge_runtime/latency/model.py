"""The injected network: delay, jitter and loss, drawn from a seed.

Pure: no clock, no socket, no global. The caller passes the time in and gets the time at which the
message comes out at the other end, or ``None`` if it is lost. The same model serves lock-step (in
virtual time) and real time (through timers).

A specification is written on the command line as comma-separated settings::

    delay=50ms,jitter=10ms,loss=1%      each way
    50ms+-10ms                          the same delay and jitter, short
    up.delay=30ms,down.loss=2%          up is state to edge, down is command to simulator
    none                                a perfect link

A setting with a prefix outranks the same one without, whatever the order.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields

import numpy as np

from edge_runtime.cli import UserError

GRAMMAR = "delay=50ms,jitter=10ms,loss=1% or 50ms+-10ms, each also with up. or down. before it"
DIRECTIONS = ("up", "down")
MAX_DELAY_MS = 60_000.0

_MS_PER_UNIT = {"us": 1e-3, "ms": 1.0, "s": 1e3}
_NUMBER = r"\d+(?:\.\d+)?(?:e[+-]?\d+)?"
_DURATION = re.compile(rf"({_NUMBER})(us|ms|s)")
_PERCENT = re.compile(rf"({_NUMBER})%")
_SHORT = re.compile(rf"({_NUMBER}(?:us|ms|s))(?:(?:\+-|±)({_NUMBER}(?:us|ms|s)))?")


@dataclass(frozen=True)
class DirectionSpec:
    """One direction of the link; every message is treated on its own, so jitter can reorder."""

    delay_ms: float = 0.0
    """Mean time under way."""
    jitter_ms: float = 0.0
    """Standard deviation of the (normal) time under way; what falls below zero becomes zero."""
    loss_percent: float = 0.0
    """Probability that a message never arrives, in percent."""


@dataclass(frozen=True)
class LatencySpec:
    """Both directions; ``parse_spec(str(spec)) == spec``."""

    up: DirectionSpec = DirectionSpec()
    down: DirectionSpec = DirectionSpec()

    def __str__(self) -> str:
        """Canonical form: settings that are zero are left out, prefixes only where needed."""
        if self.up == self.down:
            return ",".join(_settings(self.up)) or "none"
        return ",".join(_settings(self.up, "up.") + _settings(self.down, "down."))


def _settings(direction: DirectionSpec, prefix: str = "") -> list[str]:
    units = {"delay_ms": "ms", "jitter_ms": "ms", "loss_percent": "%"}
    return [
        f"{prefix}{field.name.split('_')[0]}={_number(getattr(direction, field.name))}"
        f"{units[field.name]}"
        for field in fields(direction)
        if getattr(direction, field.name)
    ]


def _number(value: float) -> str:
    """The shortest text that reads back as the same number."""
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") else text


def parse_spec(text: str) -> LatencySpec:
    """Read a specification in the grammar above; raise UserError naming the part that is wrong."""
    if text.strip() in ("", "none"):
        return LatencySpec()
    both: dict[str, float] = {}
    single: dict[str, dict[str, float]] = {name: {} for name in DIRECTIONS}
    for raw_part in text.split(","):
        part = raw_part.strip()
        prefix, dot, rest = part.partition(".")
        prefixed = bool(dot) and prefix in DIRECTIONS
        target = single[prefix] if prefixed else both
        for name, value in _parse_part(rest if prefixed else part, text).items():
            if name in target:
                raise UserError(f"latency {text!r} sets {name.split('_')[0]} twice")
            target[name] = value
    return LatencySpec(**{name: DirectionSpec(**{**both, **single[name]}) for name in DIRECTIONS})


def _parse_part(part: str, text: str) -> dict[str, float]:
    short = _SHORT.fullmatch(part)
    if short:
        delay, jitter = short.groups()
        settings = {"delay_ms": _duration_ms(delay)}
        return {**settings, **({"jitter_ms": _duration_ms(jitter)} if jitter else {})}
    name, _, value = part.partition("=")
    if name in ("delay", "jitter") and _DURATION.fullmatch(value):
        return {f"{name}_ms": _duration_ms(value)}
    percent = _PERCENT.fullmatch(value)
    if name == "loss" and percent and float(percent[1]) <= 100.0:
        return {"loss_percent": float(percent[1])}
    raise UserError(f"latency {text!r}: {part!r} is not understood; write {GRAMMAR}")


def _duration_ms(text: str) -> float:
    match = _DURATION.fullmatch(text)
    assert match is not None
    duration_ms = float(match[1]) * _MS_PER_UNIT[match[2]]
    if duration_ms > MAX_DELAY_MS:
        raise UserError(f"latency of {text} is more than {MAX_DELAY_MS / 1e3:g}s")
    return duration_ms


class LatencyModel:
    """One direction of the link with its own random stream."""

    def __init__(self, spec: DirectionSpec, rng: np.random.Generator) -> None:
        self.spec = spec
        self._rng = rng

    def sample(self, now_s: float) -> float | None:
        """Return when a message handed over at ``now_s`` arrives (s, same clock), None if lost.

        Both numbers are drawn for every message, so that two specifications with the same seed
        meet the same luck and differ only in what was specified.
        """
        loss_draw = self._rng.random()
        jitter_draw = self._rng.standard_normal()
        if loss_draw * 100.0 < self.spec.loss_percent:
            return None
        under_way_ms = self.spec.delay_ms + self.spec.jitter_ms * jitter_draw
        return now_s + max(0.0, under_way_ms) * 1e-3


@dataclass(frozen=True)
class Link:
    """The two directions of one episode."""

    up: LatencyModel
    down: LatencyModel


def make_link(spec: LatencySpec, seed: int) -> Link:
    """Make both directions, each with its own stream of the seed."""
    up, down = np.random.SeedSequence(seed).spawn(2)
    return Link(
        LatencyModel(spec.up, np.random.default_rng(up)),
        LatencyModel(spec.down, np.random.default_rng(down)),
    )
