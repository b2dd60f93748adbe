"""Quantiles of two contenders' blocks, and how sure their ratio is. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

QUANTILES = (50, 90, 99)
_RESAMPLES = 2000
_INTERVAL = (2.5, 97.5)


def compare(
    ours: Sequence[np.ndarray], floor: Sequence[np.ndarray], seed: int = 0
) -> dict[str, Any]:
    """For each quantile: ours, the floor's, their ratio over all blocks, and its 95 % interval.

    Blocks are resampled in pairs (bootstrap): neighbours in time share the machine's noise.

    Args:
        ours: the latencies of each block, any unit.
        floor: the floor's, block by block beside ours.
        seed: of the resampling.

    Raises:
        ValueError: no blocks, or not as many of the one as of the other.
    """
    if not ours or len(ours) != len(floor):
        raise ValueError(f"{len(ours)} blocks of ours beside {len(floor)} of the floor")
    generator = np.random.default_rng(seed)
    draws = generator.integers(0, len(ours), (_RESAMPLES, len(ours)))
    resampled = np.array([_ratios(ours, floor, draw) for draw in draws])
    low, high = np.percentile(resampled, _INTERVAL, axis=0)
    ratios = _ratios(ours, floor, range(len(ours)))
    return {
        f"p{quantile}": {
            "ours": float(np.percentile(np.concatenate(ours), quantile)),
            "floor": float(np.percentile(np.concatenate(floor), quantile)),
            "ratio": float(ratios[index]),
            "interval": [float(low[index]), float(high[index])],
        }
        for index, quantile in enumerate(QUANTILES)
    }


def _ratios(
    ours: Sequence[np.ndarray], floor: Sequence[np.ndarray], draw: Sequence[int] | np.ndarray
) -> np.ndarray:
    mine = np.percentile(np.concatenate([ours[index] for index in draw]), QUANTILES)
    theirs = np.percentile(np.concatenate([floor[index] for index in draw]), QUANTILES)
    return np.asarray(mine / theirs)
