"""``python -m deploy.lock TARGET``: new hashes in a target's lock after a change of versions."""

from __future__ import annotations

import hashlib
import sys
import tempfile
from pathlib import Path

from deploy.targets import TARGETS, find_target, lock_path
from deploy.wheelhouse import download
from edge_runtime.cli import ArgumentParser, examples, run_cli
from edge_runtime.files import write_atomic
from edge_runtime.util import read_bytes


def main(argv: list[str]) -> int:
    """Download each `NAME==VERSION` of the lock and write the hash of what came beside it."""
    parser = ArgumentParser(
        prog="python -m deploy.lock",
        description=__doc__,
        epilog=examples("python -m deploy.lock jetpack5"),
    )
    parser.add_argument("target", metavar="|".join(TARGETS))
    target = find_target(parser.parse_args(argv).target)
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
