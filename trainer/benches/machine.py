"""Which machine and which source made the figures."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import torch

from trainer.revision import source_revision


def about() -> dict[str, Any]:
    """Machine, threads and versions; no date, so that equal runs write equal words."""
    return {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "source_revision": source_revision(),
    }


def processor_model() -> str:
    """The processor's name; on Linux ``platform`` knows no more than its instruction set."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()
