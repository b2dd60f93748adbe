"""Drawing by weight, and writing back, on an accelerator: no shape depends on a value."""

from __future__ import annotations

import torch
from torch import Tensor


def pick(weights: Tensor, masses: Tensor) -> tuple[Tensor, Tensor]:
    """For each row of weights [n, m], the part in whose share of the row's sum a mass [n] falls.

    Never a part of weight zero, unless all of them are. Row by row, since summing up a single row
    is done in no fixed order on CUDA.

    Returns:
        The parts [n], and what is left of each mass within its part [n].
    """
    # A part without weight ends where the one before it does, whatever rounding makes of the sum.
    ends = torch.where(weights > 0, weights.cumsum(dim=1), 0.0).cummax(dim=1).values
    last = ends[:, -1]
    masses = torch.minimum(masses, torch.nextafter(last, torch.zeros_like(last)))[:, None]
    parts = torch.searchsorted(ends, masses, right=True).clamp(max=weights.shape[1] - 1)
    starts = torch.where(parts > 0, ends.gather(1, (parts - 1).clamp(min=0)), 0.0)
    return parts[:, 0], (masses - starts)[:, 0]


def last_for_all(indices: Tensor, values: Tensor) -> Tensor:
    """Values [n] in which all rows with the same index have what the last of them had.

    To write values that differ to one place is to leave the outcome to an accelerator's mood.
    """
    rows = torch.arange(len(indices), device=indices.device)
    return values[torch.where(indices[:, None] == indices, rows, 0).amax(dim=1)]
