"""Torch files and small texts, whole or not at all."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge_runtime.files import write_atomic
from edge_runtime.util import UserError, open_regular


def save_torch(path: Path, state: Any) -> None:
    """Write ``state`` so that a kill at any moment leaves the old file or the new one."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomic(path, buffer.getbuffer())


def load_torch(path: Path) -> Any:
    """Read what ``save_torch`` wrote.

    Raises:
        UserError: not such a file. Only tensors and plain values are unpickled.
    """
    try:
        with open_regular(path) as stream:
            return torch.load(stream, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError) as error:
        raise UserError(f"{path} cannot be read as a checkpoint: {error}") from error
    except Exception as error:
        # torch raises its own unpickling errors for foreign files.
        raise UserError(f"{path} is not a checkpoint of this project") from error


def as_tensors(values: dict[str, Any]) -> dict[str, Any]:
    """The same with arrays as tensors: what ``load_torch`` reads without arbitrary unpickling."""
    return {
        name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
        for name, value in values.items()
    }


def as_arrays(values: dict[str, Any]) -> dict[str, Any]:
    """The inverse of ``as_tensors``."""
    return {
        name: value.numpy() if isinstance(value, torch.Tensor) else value
        for name, value in values.items()
    }
