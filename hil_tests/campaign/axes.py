"""The latency table: along each axis one thing about the network gets worse, step by step."""

from __future__ import annotations

from dataclasses import dataclass

from bridge.network import parse_spec


@dataclass(frozen=True)
class Axis:
    """One line of the sweep; every setting holds each way, as in ``--latency``."""

    name: str
    title: str
    unit: str
    values: tuple[float, ...]
    """Ascending, beginning with 0: without it."""
    pattern: str
    """The specification; ``{}`` is the value."""
    base: str
    """The specification at 0."""
    limit: str
    """How the budget's sentence names the limit; ``{}`` is the value with its unit."""

    def spec(self, value: float) -> str:
        """The specification at a value, in canonical form."""
        return str(parse_spec(self.pattern.format(f"{value:g}") if value else self.base))


BASE_DELAY = "delay=100ms"
"""What jitter is measured on: without delay, half of it would be cut off at zero."""

AXES = (
    Axis(
        "delay",
        "delay each way",
        "ms",
        (0, 25, 50, 75, 100, 125, 150, 175, 200, 225, 250, 300, 400, 500, 750, 1000),
        "delay={}ms",
        "none",
        "{} of delay each way",
    ),
    Axis(
        "jitter",
        "normal jitter (standard deviation) on 100 ms each way",
        "ms",
        (0, 10, 20, 40, 60, 80, 100),
        "delay=100ms,jitter={}ms",
        BASE_DELAY,
        "{} of normal jitter on 100 ms",
    ),
    Axis(
        "tail",
        "long-tailed (Pareto) jitter on 100 ms each way",
        "ms",
        (0, 10, 20, 40, 60, 80, 100),
        "delay=100ms,jitter={}ms,tail=pareto",
        BASE_DELAY,
        "{} of long-tailed jitter on 100 ms",
    ),
    Axis(
        "loss",
        "independent loss each way",
        "%",
        (0, 1, 2, 5, 10, 15, 20, 25, 30, 40),
        "loss={}%",
        "none",
        "{} of independent loss each way",
    ),
    Axis(
        "burst",
        "loss in bursts of 5 messages each way",
        "%",
        (0, 1, 2, 5, 10, 15, 20, 30),
        "loss={}%,burst=5",
        "none",
        "{} of loss in bursts of 5 messages",
    ),
    Axis(
        "outage",
        "outage every 3 s, both ways",
        "s",
        (0, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0),
        "outage={}s/3s@1s",
        "none",
        "outages of {} every 3 s",
    ),
)
"""Delay runs from 0 to 500 ms there and back in steps of 50 ms, and on to where nobody drives."""
