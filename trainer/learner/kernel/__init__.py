"""CPU kernels in C++, built at first use by the system's compiler and kept in the user's cache.

Nothing is built at installation, so the package needs no compiler to be installed; without one,
callers take their torch path. ``PHIL_KERNEL=0`` in the environment does the same on purpose.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

_LOGGER = logging.getLogger(__name__)
_FLAGS = ("-std=c++17", "-O3", "-march=native", "-fPIC", "-shared")
_OPENMP = "-fopenmp"
_TIMEOUT_S = 120.0
"""For a build; it takes a few."""


class _BuildError(Exception):
    """Why there is no kernel."""


@functools.cache
def load(name: str) -> ctypes.CDLL | None:
    """The library built from ``<name>.cpp``, or None, with one warning, if there can be none.

    Import torch first: on Linux the kernel then shares the OpenMP threads that torch brought along.
    Two pools of threads would fight for the same cores.
    """
    if os.environ.get("PHIL_KERNEL") == "0":
        return None
    try:
        return _built(Path(__file__).with_name(f"{name}.cpp"))
    except (_BuildError, OSError, RuntimeError) as error:
        # RuntimeError: there is no home directory, hence no cache.
        _LOGGER.warning(
            "no compiled %s kernel (%s): torch does its work, several times slower",
            name,
            " ".join(str(error).split()),
        )
        return None


def _built(source: Path) -> ctypes.CDLL:
    """The library of this source, compiler and processor: from the cache, or built now."""
    compiler = _compiler()
    # Every header beside it, included or not: none can be forgotten.
    code = [file.read_bytes() for file in (source, *sorted(source.parent.glob("*.h")))]
    settings = "\0".join([*compiler, *_FLAGS, _OPENMP, _processor()]).encode()
    key = b"\0".join([settings, *code])
    library = _cache() / f"{source.stem}-{hashlib.sha256(key).hexdigest()[:16]}.so"
    if not library.exists():
        _build(compiler, source, library)
    return ctypes.CDLL(str(library))


def _build(compiler: list[str], source: Path, library: Path) -> None:
    """Compile under a name of its own, then rename: two processes may build at once."""
    library.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent, prefix="build-") as directory:
        target = Path(directory) / library.name
        # A compiler without OpenMP still gives a kernel of one thread.
        for openmp in ([_OPENMP], []):
            command = [*compiler, *_FLAGS, *openmp, "-o", str(target), str(source)]
            failure = _failure(command)
            if failure is None:
                os.replace(target, library)
                return
    raise _BuildError(failure)


def _failure(command: list[str]) -> str | None:
    """Run the compiler; the first line of its complaint, or None if it had none."""
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{command[0]} cannot be run: {error}"
    if done.returncode == 0:
        return None
    lines = done.stderr.splitlines()
    worst = next((line for line in lines if "error" in line), f"status {done.returncode}")
    return f"{command[0]} failed: {worst}"


def _compiler() -> list[str]:
    """The command of the C++ compiler: ``$CXX``, or the first that is installed."""
    chosen = shlex.split(os.environ.get("CXX", ""))
    if chosen:
        return chosen
    for candidate in ("c++", "g++", "clang++"):
        if shutil.which(candidate):
            return [candidate]
    raise _BuildError("there is no C++ compiler; a package such as g++ or clang brings one")


def _processor() -> str:
    """Names the instruction set: a cache on a shared home may meet several machines."""
    wanted = ("model name", "flags", "features", "cpu part")
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    known = dict.fromkeys(line for line in lines if line.lower().startswith(wanted))
    return "\n".join([platform.machine(), platform.processor(), *known])


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "phil-hil"
