"""Films: pictures as H.264 in an MP4, which every player shows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from edge_runtime.util import UserError

try:
    import av
except ImportError:
    raise UserError("a film needs av: pip install 'phil-hil[lerobot]'") from None


def pixel_format(height: int, width: int) -> str:
    """Return colours of half the size, as players like them; they need even sizes."""
    return "yuv444p" if height % 2 or width % 2 else "yuv420p"


@contextmanager
def film(
    path: Path, rate: Fraction, options: dict[str, str] | None = None
) -> Iterator[Callable[[np.ndarray], None]]:
    """Write a film of ``rate`` pictures a second; yield what adds one, uint8 [height, width, 3]."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=rate, options=options)
        numbers = count()

        def add(picture: np.ndarray) -> None:
            number, (height, width) = next(numbers), picture.shape[:2]
            if not number:
                stream.height, stream.width = height, width
                stream.pix_fmt = pixel_format(height, width)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode(None))
