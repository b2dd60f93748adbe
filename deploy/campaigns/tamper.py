"""``python -m deploy.campaigns.tamper``: a bundle with any one byte changed is refused.

Each try changes one byte at a random place of the whole archive, headers and padding included, and
runs the real installer on it: on an empty board, which must stay empty, and in turn on one with a
release, of which no file may change. At the end the unchanged bundle must be taken.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

from deploy.campaigns.rig import Board, Kit, kit_of, make_kit
from deploy.installer.verify import BLOCK
from edge_runtime.cli import ArgumentParser, UserError, examples, run_cli
from edge_runtime.files import check_writable, write_json
from edge_runtime.option_types import not_negative, positive

REFUSED = 2


def main(argv: list[str]) -> int:
    """Run the campaign; status 1 where a changed bundle was taken."""
    arguments = _parse(argv)
    if arguments.out:
        check_writable(arguments.out)
    with tempfile.TemporaryDirectory() as place:
        report = campaign(_kit(arguments, Path(place)), Path(place), arguments)
    if arguments.out:
        write_json(arguments.out, report)
    print(f"refused {report['refused']} of {report['tries']} bundles with one byte changed")
    return 0 if report["refused"] == report["tries"] and report["unchanged_is_taken"] else 1


def campaign(kit: Kit, folder: Path, arguments: argparse.Namespace) -> dict:
    """Change one byte `tries` times; the report."""
    choice = random.Random(arguments.seed)
    empty, full = Board(folder / "empty", kit), Board(folder / "full", kit)
    status, said = _install(full, kit.bundles[0])
    if status != 0:
        raise UserError(f"{kit.bundles[0]} does not install here: {said}")
    changed = folder / "changed.tar"
    shutil.copyfile(kit.bundles[-1], changed)
    size, before = changed.stat().st_size, _fingerprint(full.root)
    faults: list[str] = []
    words: Counter[str] = Counter()
    with open(changed, "r+b", buffering=0) as stream:
        for number in range(arguments.tries):
            place, flip = choice.randrange(size), choice.randrange(1, 256)
            was = os.pread(stream.fileno(), 1, place)
            os.pwrite(stream.fileno(), bytes([was[0] ^ flip]), place)
            board = (empty, full)[number % 2]
            status, said = _install(board, changed)
            untouched = not empty.root.exists() and _fingerprint(full.root) == before
            if status != REFUSED or "is refused" not in said or not untouched:
                faults.append(f"byte {place} of {size}, block {place // BLOCK}: {said}")
            words[" ".join(said.split("is refused: ")[-1].split())] += 1
            os.pwrite(stream.fileno(), was, place)
    status, _ = _install(empty, changed)
    return {
        "tries": arguments.tries,
        "seed": arguments.seed,
        "bundle_bytes": size,
        "refused": arguments.tries - len(faults),
        "faults": faults,
        "unchanged_is_taken": status == 0,
        "because": dict(words.most_common()),
    }


def _install(board: Board, bundle: Path) -> tuple[int, str]:
    status, said = board.run("install", bundle, "--trust", board.kit.trust, "--service", "none")
    return status, said.strip()


def _fingerprint(root: Path) -> dict[str, tuple[int, int]]:
    """Size and time of everything below a folder, itself included."""
    paths = [root, *root.rglob("*")]
    stats = {str(path): path.lstat() for path in paths}
    return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in stats.items()}


def _kit(arguments: argparse.Namespace, folder: Path) -> Kit:
    if arguments.bundle is None:
        return make_kit(folder)
    bundle = Path(arguments.bundle)
    return kit_of([bundle], Path(arguments.trust), arguments.python, folder)


def _parse(argv: list[str]) -> argparse.Namespace:
    parser = ArgumentParser(
        prog="python -m deploy.campaigns.tamper",
        description=__doc__,
        epilog=examples("python -m deploy.campaigns.tamper --tries 100 --out runs/tamper.json"),
    )
    parser.add_argument("--tries", metavar="N", type=positive, default=1000, help="changed bundles")
    parser.add_argument("--seed", metavar="N", type=not_negative, default=1, help="of the places")
    parser.add_argument("--out", metavar="FILE.json", help="write the report here")
    parser.add_argument(
        "--bundle",
        metavar="BUNDLE.tar",
        help="of `deploy bundle`; without it, a light one for this computer is made",
    )
    parser.add_argument("--trust", metavar="KEY.pub", default="keys/policy.pub")
    parser.add_argument("--python", metavar="PYTHON", default="python3.8", help="installs it")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(run_cli(main))
