"""Which messages are lost: independently, or in bursts. Pure.

Bursts follow the model of Gilbert (1960, Capacity of a burst-noise channel) as Elliott (1963,
Estimates of error rates for codes on burst-noise channels) extended it: a Markov chain with a good
and a bad state, which steps once per message (not with time: an idle link does not recover), and a
loss probability in each. With netem's ``loss gemodel p r 1-h 1-k``::

    r   = 1 / burst                         bad to good; a bad stretch has 1/r messages on average
    p   = r s / (1 - s)                     good to bad
    1-h = burst_loss, 1-k = clear_loss      loss in the bad and in the good state
    s   = (loss - clear_loss) / (burst_loss - clear_loss)     share of messages in the bad state

so that ``loss`` stays the overall rate and rows with and without bursts compare.
"""

from __future__ import annotations

import numpy as np

from edge_runtime.latency.spec import DirectionSpec, bad_share


class IndependentLoss:
    """Every message has the same chance."""

    def __init__(self, spec: DirectionSpec) -> None:
        self._percent = spec.loss_percent

    def percent(self) -> float:
        """Chance of the next message to be lost, in percent."""
        return self._percent


class BurstLoss:
    """The Gilbert-Elliott chain; it begins in its stationary state."""

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
