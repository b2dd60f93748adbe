"""The boards that bundles are made for, and the wheels of each.

A lock names every wheel of a board by version and hash. A folder keeps the wheels between runs, so
a bundle made from a full folder needs no network. After a change of versions in a lock,
``python -m deploy.wheels TARGET`` writes the new hashes.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from deploy.installer.verify import Target
from edge_runtime.cli import ArgumentParser, examples, run_cli
from edge_runtime.files import make_directory, write_atomic
from edge_runtime.util import UserError, read_bytes

ROOT = Path(__file__).parents[1]
LOCKS = ROOT / "requirements"
DEFAULT_FOLDER = "build/wheels"
TARGETS = {
    target.name: target
    for target in (
        # Jetson Xavier NX with JetPack 5: Ubuntu 20.04.
        Target(name="jetpack5", python="3.8", machine="aarch64", glibc="2.31"),
        # Debian bullseye.
        Target(name="linux-aarch64", python="3.9", machine="aarch64", glibc="2.31"),
        # The twin of jetpack5 on a workstation: the same versions of everything.
        Target(name="linux-x86_64", python="3.8", machine="x86_64", glibc="2.31"),
    )
}
_MANYLINUX = (5, 12, 17, 24, 26, 27, 28, 31)
"""The minor versions of glibc 2 that wheels are tagged with, up to the boards' own."""
_PATCH = 2
"""pip takes 3.9 for 3.9.0, which cryptography shuns; Debian bullseye has 3.9.2."""
_LINE = re.compile(r"([A-Za-z0-9._-]+)==([A-Za-z0-9._+!-]+) --hash=sha256:([0-9a-f]{64})")
_SETUPTOOLS = 75  # as edge_runtime/pyproject.toml asks
_EPOCH_S = 315532800
"""1980-01-01, the first day that a ZIP file knows: the built wheel's files bear it."""


class Pin(NamedTuple):
    """One line of a lock; `sha256` in hex, of the one wheel that fits the target."""

    name: str
    version: str
    sha256: str


def lock_path(target: Target) -> Path:
    """The file that names every wheel of a target by version and hash."""
    return LOCKS / f"bundle-{target.name}.txt"


def read_lock(path: Path) -> list[Pin]:
    """The pins of a lock: `NAME==VERSION --hash=sha256:HEX`, one wheel a line."""
    pins = []
    for line in read_bytes(path, "lock").decode().splitlines():
        if line.strip() and not line.startswith("#"):
            found = _LINE.fullmatch(line.strip())
            if found is None:
                raise UserError(f"lock {path}: not NAME==VERSION --hash=sha256:HEX: {line}")
            pins.append(Pin(*found.groups()))
    return pins


def gather(target: Target, lock: Path, folder: Path) -> list[Path]:
    """The lock's wheels in `folder`, in the lock's order; pip fetches what is missing."""
    pins = read_lock(lock)
    found = _by_hash(folder)
    if any(pin.sha256 not in found for pin in pins):
        download(target, ["--require-hashes", "--requirement", str(lock)], folder)
        found = _by_hash(folder)
    missing = [pin.name for pin in pins if pin.sha256 not in found]
    if missing:
        raise UserError(f"no wheel with the lock's hash in {folder} for {', '.join(missing)}")
    return [found[pin.sha256] for pin in pins]


def download(target: Target, wanted: list[str], folder: Path) -> None:
    """`pip download` of wheels for another computer. Raises UserError with pip's own line."""
    make_directory(folder)
    newest = int(target.glibc.split(".")[1])
    tags = [*(f"_2_{minor}" for minor in _MANYLINUX if minor <= newest), "1", "2010", "2014"]
    pip(
        "download", "--only-binary=:all:", "--no-deps",
        f"--python-version={target.python}.{_PATCH}",
        *(f"--platform=manylinux{tag}_{target.machine}" for tag in tags),
        "--dest", str(folder), *wanted,
    )  # fmt: skip


def build_edge_wheel(folder: Path) -> Path:
    """The edge runtime's wheel, the same bytes from the same sources and the same setuptools."""
    with tempfile.TemporaryDirectory() as place:
        # Of a copy: building writes into its source folder.
        source = Path(place) / "edge_runtime"
        ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info", "tests")
        shutil.copytree(ROOT / "edge_runtime", source, ignore=ignored)
        for path in source.rglob("*"):
            path.chmod(0o755 if path.is_dir() else 0o644)  # the umask of whoever cloned it
        made = Path(place) / "made"
        # With the setuptools that is here, if it is new enough: no index is asked then.
        options = []
        with contextlib.suppress(importlib.metadata.PackageNotFoundError, ValueError):
            if int(importlib.metadata.version("setuptools").split(".")[0]) >= _SETUPTOOLS:
                options = ["--no-build-isolation"]
        pip("wheel", "--no-deps", *options, "--wheel-dir", str(made), str(source))
        make_directory(folder)
        return Path(shutil.move(next(made.glob("*.whl")), folder))


def pip(*arguments: str) -> None:
    """Run pip. Raises UserError with the last line that begins with ERROR."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", *arguments]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": str(_EPOCH_S)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise UserError(f"pip {arguments[0]}: {(lines or ['failed'])[-1]}")


def _by_hash(folder: Path) -> dict[str, Path]:
    wheels = sorted(folder.glob("*.whl"))
    return {hashlib.sha256(path.read_bytes()).hexdigest(): path for path in wheels}


def main(argv: list[str]) -> int:
    """Download each `NAME==VERSION` of the lock and write the hash of what came beside it."""
    parser = ArgumentParser(
        prog="python -m deploy.wheels",
        description=__doc__,
        epilog=examples("python -m deploy.wheels jetpack5"),
    )
    parser.add_argument("target", choices=TARGETS)
    target = TARGETS[parser.parse_args(argv).target]
    path = lock_path(target)
    lines = []
    for line in read_bytes(path, "lock").decode().splitlines():
        if line.strip() and not line.startswith("#"):
            pin = line.split()[0]
            with tempfile.TemporaryDirectory() as place:
                download(target, [pin], Path(place))
                digest = hashlib.sha256(next(Path(place).glob("*.whl")).read_bytes()).hexdigest()
            line = f"{pin} --hash=sha256:{digest}"
        lines.append(line)
    write_atomic(path, ("\n".join(lines) + "\n").encode())
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
