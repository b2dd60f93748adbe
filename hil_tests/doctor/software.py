"""Probes: Python, packages, compiler, GPU. Heavy libraries are tried in a process of their own."""

from __future__ import annotations

import functools
import json
import platform
import re
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from hil_tests.doctor.check import MissingError, output_of_python

ROOT = Path(__file__).parents[2]
LOCK = ROOT / "requirements" / "workstation.txt"
OLDEST = (3, 11)
_TORCH = """
import json, logging, os, sys
import torch
from trainer.learner import kernel
why = []
kernel._LOGGER.addHandler(logging.Handler())
logging.Handler.emit = lambda self, record: why.append(record.getMessage())
built = kernel.load("trunk") is not None
gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else ""
print(json.dumps({"torch": torch.__version__, "kernel": built, "why": why, "gpu": gpu}))
"""


def python() -> str:
    """The interpreter that runs this."""
    number = tuple(map(int, platform.python_version_tuple()[:2]))
    if number < OLDEST:
        raise MissingError(f"this is Python {platform.python_version()}")
    return f"{platform.python_version()}, {sys.executable}"


def packages() -> str:
    """Every library that pyproject.toml asks for is there."""
    import tomllib  # An older Python has none, and is to say so in the check before.

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [re.split(r"[^\w.-]", line)[0] for line in project["dependencies"]]
    absent = [name for name in wanted if _installed(name) is None]
    if absent:
        raise MissingError(f"not installed: {', '.join(absent)}")
    return f"all {len(wanted)} that pyproject.toml asks for"


def versions() -> str:
    """What is installed is what the lock names."""
    locked = dict(line.split("==") for line in LOCK.read_text().splitlines() if "==" in line)
    found = {name: version for name in locked if (version := _installed(name)) is not None}
    other = [
        f"{name} {version} (locked: {locked[name]})"
        for name, version in found.items()
        # torch says +cpu or +cu130 behind its version.
        if version.split("+")[0] != locked[name]
    ]
    if other:
        raise MissingError(f"other versions: {', '.join(other)}")
    return f"{len(found)} packages as in {LOCK.name}"


def kernel() -> str:
    """The learner's C++ kernel builds and loads."""
    facts = _torch_facts()
    if not facts["kernel"]:
        raise MissingError("; ".join(facts["why"]) or "turned off by PHIL_KERNEL=0")
    return "the learner's kernel is built and loaded"


def gpu() -> str:
    """Torch sees a CUDA device."""
    facts = _torch_facts()
    if not facts["gpu"]:
        raise MissingError(f"torch {facts['torch']} sees no CUDA device")
    return str(facts["gpu"])


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


@functools.lru_cache(maxsize=None)  # noqa: UP033
def _torch_facts() -> dict[str, Any]:
    # A driver that does not fit may end the process that asks for it.
    facts: dict[str, Any] = json.loads(output_of_python(_TORCH).splitlines()[-1])
    return facts
