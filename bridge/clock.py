"""What the two clocks have in common: they carry one tick's state out and a decision back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from edge_runtime.latency.command_hold import Decision
from edge_runtime.wire import State

Publish = Callable[[bytes], None]
"""Sends an encoded state over the wire; must not block."""


class Clock(Protocol):
    """Drives the exchange of one episode at a time; ``begin``, ``exchange`` ..., ``finish``."""

    latencies_ms: list[float]
    """From state sent to command received, injected delays included; one per answered state."""
    tick_overruns: int
    """Ticks that began so late that the simulation slipped behind the wall clock."""
    missed_ticks: int
    """Whole ticks of the wall clock that went by without a state because of it."""
    wall_clock_stalls: int
    """States of lock-step that the edge runtime did not answer in wall time, or only with a safe
    stop because of it: it was gone, or got no processor. Always 0 in real time."""

    def begin(self, episode: int, seed: int) -> None:
        """Start an episode; ``seed`` decides the delays and losses of the link."""

    def receive(self, payload: bytes) -> None:
        """Take one command from the wire, on Zenoh's thread."""

    def exchange(self, state: State) -> Decision:
        """Send the state of one tick and decide what the vehicle does in it."""

    def newest_answer(self) -> tuple[int, float] | None:
        """The newest state of this episode that was answered, and its latency in ms."""

    def finish(self, state: State) -> None:
        """Send the final state. It says that the simulation has ended, which no radio link
        carries, so no delay or loss is injected; whatever is still under way is forgotten.
        """

    def close(self) -> None:
        """Stop any thread."""
