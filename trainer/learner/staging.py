"""Small records on their way from the processor to an accelerator."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

ROWS = 8
"""Records that may be under way at once. Three are written between two actions, which wait for
all; a tight loop without actions waits for the eighth."""


class Staging:
    """One record on the device, always at the same place, and the pinned rows it is sent from.

    Args:
        layout: a structured dtype; its fields become tensors. Wider numbers come first, so that
            all of them are aligned.
        device: where the record goes.
    """

    def __init__(self, layout: np.dtype[np.void], device: torch.device) -> None:
        on_cuda = device.type == "cuda"
        self._rows = torch.zeros(ROWS, layout.itemsize, dtype=torch.uint8, pin_memory=on_cuda)
        self._host = self._rows.numpy().view(layout)[:, 0]
        self._record = torch.zeros(layout.itemsize, dtype=torch.uint8, device=device)
        self._sent = [torch.cuda.Event() for _ in range(ROWS)] if on_cuda else []
        self._next = 0
        self.fields = {name: self._field(layout, name) for name in layout.names or ()}
        """The record's fields on the device, by name."""

    def row(self) -> Any:
        """The row to fill before ``send``: a numpy record."""
        if self._sent:
            # The copy from it may still be under way; an event never recorded is no wait.
            self._sent[self._next].synchronize()
        return self._host[self._next]

    def send(self) -> None:
        """Send the row to the record, in the order of the current stream."""
        self._record.copy_(self._rows[self._next], non_blocking=True)
        if self._sent:
            self._sent[self._next].record()
        self._next = (self._next + 1) % ROWS

    def _field(self, layout: np.dtype[np.void], name: str) -> Tensor:
        assert layout.fields is not None
        kind, offset = layout.fields[name][:2]
        dtype = torch.from_numpy(np.empty(0, kind.base)).dtype
        return self._record[offset : offset + kind.itemsize].view(dtype).view(kind.shape)
