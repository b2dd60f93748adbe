"""``python -m deploy.campaigns.kills``: the power fails at random moments of install and upgrade.

Each try starts the installer, kills it and everything on the board after a random part of the time
that a whole run takes, looks whether `current` names a whole release whose policy may drive, and
then lets the same command complete. Half of the tries install on an empty board, half upgrade.
A process's end loses nothing that was written; what an earlier fsync saves is not shown here.
"""

from __future__ import annotations

import argparse
import random
import sys
import tarfile
import tempfile
import time
from collections import Counter
from pathlib import Path

from deploy.campaigns.rig import Board, Kit, kit_of, make_kit, unless_busy
from deploy.installer.verify import MANIFEST, parse_manifest
from edge_runtime.cli import ArgumentParser, UserError, examples, run_cli, write_json_out
from edge_runtime.files import check_writable
from edge_runtime.option_types import not_negative, positive

SLACK = 1.1
"""Some tries come after the end: a whole run must survive a power cut, too."""


def main(argv: list[str]) -> int:
    """Run the campaign; status 1 where a board broke."""
    arguments = _parse(argv)
    if arguments.out:
        check_writable(arguments.out)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        kit = _kit(arguments, folder)
        report = campaign(
            Board(folder / "board", kit), arguments.tries, arguments.seed, arguments.out
        )
    print(
        f"{report['tries']} kills: {report['broken']} broken boards,"
        f" {report['not_completed']} that the same command did not complete"
    )
    return 1 if report["broken"] or report["not_completed"] else 0


def campaign(board: Board, tries: int, seed: int, out: str | None = None) -> dict:
    """Kill `tries` runs of the installer; the report, which also goes to `out` as it grows."""
    choice = random.Random(seed)
    tally = Tally(seed, {kind: _measure(board, kind) for kind in ("install", "upgrade")})
    for number in range(tries):
        kind = ("install", "upgrade")[number % 2]
        moment_s = choice.uniform(0.0, SLACK * tally.durations_s[kind])
        tally.add(kind, *_try(board, kind, moment_s))
        if (number + 1) % 10 == 0 or number + 1 == tries:
            write_json_out(out, tally.report())
            print(f"{number + 1} of {tries}", file=sys.stderr)
    board.run("uninstall")
    return tally.report()


class Tally:
    """What came of the tries."""

    def __init__(self, seed: int, durations_s: dict[str, float]) -> None:
        self.seed = seed
        self.durations_s = durations_s
        self.tries = 0
        self.broken: list[str] = []
        self.stuck: list[str] = []
        self.phases: Counter[str] = Counter()
        self.current: Counter[str] = Counter()

    def add(self, kind: str, phase: str, current: str, broken: str, stuck: str) -> None:
        """Count one try; `broken` and `stuck` are empty where all is well."""
        self.phases[f"{kind}: {phase}"] += 1
        self.current[f"{kind}: {current}"] += 1
        self.broken += [f"try {self.tries}, {kind}: {broken}"] if broken else []
        self.stuck += [f"try {self.tries}, {kind}: {stuck}"] if stuck else []
        self.tries += 1

    def report(self) -> dict:
        """All of it, for a JSON file."""
        return {
            "tries": self.tries,
            "seed": self.seed,
            "broken": len(self.broken),
            "not_completed": len(self.stuck),
            "faults": self.broken + self.stuck,
            "a_whole_run_s": {kind: round(s, 2) for kind, s in self.durations_s.items()},
            "killed_after_it_said": dict(sorted(self.phases.items())),
            "current_after_the_kill": dict(sorted(self.current.items())),
        }


def _try(board: Board, kind: str, moment_s: float) -> tuple[str, str, str, str]:
    """Kill one run: what it had said, what `current` named then, and what was broken or stuck."""
    if kind == "install":
        _clear(board)
    before = board.current()
    bundle = _next(board.kit.bundles, before)
    process = board.start_install(bundle)
    time.sleep(moment_s)
    phase = board.cut_power(process)
    current = board.current()
    fault = board.fault({before, _version(bundle)})
    if before and not current:
        fault = "the old release is gone"
    stuck = _complete(board, bundle)
    if not stuck and board.current() != _version(bundle):
        stuck = f"{board.current()} is current"
    return phase, _which(current, before), fault, stuck


def _next(bundles: list[Path], current: str) -> Path:
    """Upgrades go round: of three, the next is neither current nor previous, so it is unpacked."""
    versions = [_version(bundle) for bundle in bundles]
    return bundles[(versions.index(current) + 1) % len(bundles)] if current else bundles[0]


def _which(current: str, before: str) -> str:
    if not current:
        return "nothing yet"
    return "the old release" if current == before else "the new release"


def _clear(board: Board) -> None:
    if board.root.exists():
        status, said = board.run("uninstall")
        if status != 0:
            raise UserError(f"uninstall: {said}")


def _complete(board: Board, bundle: Path) -> str:
    """The same command again; what it complains of, empty where it is done."""

    def run() -> str:
        process = board.start_install(bundle)
        _, error = process.communicate()
        return error.strip() if process.returncode else ""

    return unless_busy(run)


def _measure(board: Board, kind: str) -> float:
    if kind == "install":
        _clear(board)
    begin_s = time.monotonic()
    said = _complete(board, _next(board.kit.bundles, board.current()))
    if said:
        raise UserError(f"the bundle does not install here: {said}")
    return time.monotonic() - begin_s


def _version(bundle: Path) -> str:
    with tarfile.open(bundle) as tar:
        member = tar.extractfile(MANIFEST)
        assert member is not None
        return parse_manifest(member.read()).version


def _kit(arguments: argparse.Namespace, folder: Path) -> Kit:
    if arguments.bundles is None:
        return make_kit(folder)
    bundles = [Path(bundle) for bundle in arguments.bundles]
    return kit_of(bundles, Path(arguments.trust), arguments.python, folder)


def _parse(argv: list[str]) -> argparse.Namespace:
    parser = ArgumentParser(
        prog="python -m deploy.campaigns.kills",
        description=__doc__,
        epilog=examples("python -m deploy.campaigns.kills --tries 20 --out runs/kills.json"),
    )
    parser.add_argument("--tries", metavar="N", type=positive, default=200, help="kills")
    parser.add_argument("--seed", metavar="N", type=not_negative, default=1, help="of the moments")
    parser.add_argument("--out", metavar="FILE.json", help="write the report here")
    parser.add_argument(
        "--bundles",
        nargs=3,
        metavar=("ONE.tar", "TWO.tar", "THREE.tar"),
        help="of `deploy bundle`; without them, light ones for this computer are made",
    )
    parser.add_argument("--trust", metavar="KEY.pub", default="keys/policy.pub")
    parser.add_argument("--python", metavar="PYTHON", default="python3.8", help="installs them")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(run_cli(main))
