"""``python -m deploy.campaigns.times BUNDLE.tar``: how long an installation takes, without network.

Each try begins with an empty board and ends when the service is healthy; no process of it has a
network but the loopback inside its own namespace, where that is permitted.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

from deploy.campaigns.rig import Board, kit_of
from edge_runtime.cli import ArgumentParser, examples, positive, run_cli
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.util import UserError


def main(argv: list[str]) -> int:
    """Install, measure, uninstall; the report."""
    arguments = _parse(argv)
    if arguments.out:
        check_writable(arguments.out)
    bundle = Path(arguments.bundle)
    with tempfile.TemporaryDirectory() as place:
        kit = kit_of([bundle], Path(arguments.trust), arguments.python, Path(place))
        board = Board(Path(place) / "board", kit)
        seconds, installed_bytes = [], 0
        for _ in range(arguments.tries):
            seconds.append(_install_s(board))
            installed_bytes = _size(board.root)
            board.run("uninstall")
    report = {
        "bundle": bundle.name,
        "bundle_bytes": bundle.stat().st_size,
        "installed_bytes": installed_bytes,
        "without_network": bool(_alone()),
        "install_to_healthy_s": [round(s, 2) for s in seconds],
        "median_s": round(statistics.median(seconds), 2),
        "processors": os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 1),
    }
    write_json_out(arguments.out, report)
    print(f"{bundle.name}: {report['median_s']} s to a healthy service (median of {len(seconds)})")
    return 0


def _install_s(board: Board) -> float:
    begin_s = time.monotonic()
    trust = ("--trust", board.kit.trust)
    status, said = board.run(
        "install", board.kit.bundles[0], *trust, "--service", "process", prefix=_alone()
    )
    if status != 0:
        board.run("uninstall")
        raise UserError(f"{board.kit.bundles[0]} does not install here: {said}")
    return time.monotonic() - begin_s


def _alone() -> list[str]:
    """A command prefix that takes the network away; empty where it cannot be."""
    return ["unshare", "--net"] if os.geteuid() == 0 and shutil.which("unshare") else []


def _size(root: Path) -> int:
    return sum(path.lstat().st_size for path in root.rglob("*") if path.is_file())


def _parse(argv: list[str]) -> argparse.Namespace:
    parser = ArgumentParser(
        prog="python -m deploy.campaigns.times",
        description=__doc__,
        epilog=examples(
            "python -m deploy.campaigns.times phil-jetpack5-1.tar --out runs/times.json"
        ),
    )
    parser.add_argument("bundle", metavar="BUNDLE.tar", help="of `deploy bundle`, for this machine")
    parser.add_argument("--tries", metavar="N", type=positive, default=3, help="installations")
    parser.add_argument("--out", metavar="FILE.json", help="write the report here")
    parser.add_argument("--trust", metavar="KEY.pub", default="keys/policy.pub")
    parser.add_argument("--python", metavar="PYTHON", default="python3.8", help="installs it")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(run_cli(main))
