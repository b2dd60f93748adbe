"""What the injected network does in each direction: plain numbers, checked. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional, Tuple

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
    period_s: Optional[float] = None
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
    """Distribution of the time under way (delay.py); mean and standard deviation stay."""
    burst_messages: float = 0.0
    """Mean length of a bad stretch in messages (Gilbert-Elliott, loss.py); 0: losses are
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
    outages: Tuple[Outage, ...] = ()
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
        from edge_runtime.latency.grammar import format_spec  # The grammar knows the spec.

        return format_spec(self)
