"""Whether a device multiplies bfloat16 faster than float32; elsewhere it would be slower."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import torch

CPU_INFO = Path("/proc/cpuinfo")
_INSTRUCTIONS = re.compile(r"\b(avx512_bf16|amx_bf16|bf16)\b")
"""As Linux names them on x86-64 and on aarch64."""


@cache
def multiplies_bfloat16(device_type: str) -> bool:
    """Whether ``device_type`` (``cpu``, ``cuda``) has instructions for it."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    try:
        return _INSTRUCTIONS.search(CPU_INFO.read_text(errors="replace")) is not None
    except OSError:
        return False
