"""``python -m bridge bisect``: the policy of a training from which on a recorded drive changes.

Each policy that is tried drives on from the same place of the same drive (`fork.py`): the scene and
the network's luck are the same for all.
"""

from __future__ import annotations

import subprocess
import tempfile
from argparse import Namespace
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from bridge.fork import ForkedDrive, add_common, find_fork, trainer_command
from bridge.progress import ProgressBar
from bridge.report import GOAL, SNAPSHOTS, UNKNOWN
from edge_runtime import cli
from edge_runtime.files import write_json_out
from edge_runtime.policy import Policy, load_policy
from edge_runtime.util import UserError


def _add_arguments(parser: Any) -> None:
    add_common(parser)
    runs = "a training run with snapshots (--set snapshots=true), or a directory of policy files,"
    runs += " in the order of their names"
    parser.add_argument("--runs", metavar="RUN_DIR", required=True, help=runs)


def _run(asked: Namespace) -> int:
    """Find the policy from which on the drive ends in another way."""
    drive, fork = find_fork(asked.recording, asked)
    outcomes: dict[int, str] = {}
    with closing(drive.environment(asked.env)) as environment, tempfile.TemporaryDirectory() as tmp:
        names, load = _policies(Path(asked.runs), Path(tmp))
        with ProgressBar("policies tried", len(names).bit_length() + 3) as bar:

            def succeeds(number: int) -> bool:
                if number not in outcomes:
                    forked = ForkedDrive(drive, environment, fork, load(number))
                    outcomes[number] = forked.run().outcome
                    bar.advance({names[number]: outcomes[number]})
                if outcomes[number] == UNKNOWN:
                    raise UserError(f"{drive.origin.environment} does not say what a success is")
                return outcomes[number] == GOAL

            change, alone = first_change(len(names), succeeds)
    report = {
        "recording": asked.recording, "episode": drive.number,
        "at_s": round(fork * drive.task.control_period_s, 6), "policies": len(names),
        "tried": {names[number]: outcomes[number] for number in sorted(outcomes)},
        "changes_at": names[change] if change else None,
        "before": names[change - 1] if change else None,
        "one_change": alone,
    }  # fmt: skip
    write_json_out(asked.out, report)
    tried = f"{len(outcomes)} of {len(names)} policies tried"
    if change:
        was = f"{outcomes[change - 1]} with {names[change - 1]}"
        print(f"{outcomes[change]} from {names[change]} on, {was} before it; {tried}")
    else:
        ends = f"{outcomes[0]} with {names[0]}, {outcomes[len(names) - 1]} with {names[-1]}"
        print(f"no change between the first and the last: {ends}; {tried}")
    if not alone:
        print("what is beside it says that there is more than one change: this is one of them")
    return 0


def first_change(count: int, succeeds: Callable[[int], bool]) -> tuple[int, bool]:
    """By bisection, the first policy that ends as the last does; 0: the first does so itself.

    One change among the ``count`` policies is assumed, and tried beside the one that is found.

    Returns:
        The policy's number, and whether those beside it agree.
    """
    first, last, low, high = succeeds(0), succeeds(count - 1), 0, count - 1
    if first == last:
        return 0, True
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if succeeds(middle) == first else (low, middle)
    beside = [n for n in (low - 1, high + 1) if 0 <= n < count]
    return high, all(succeeds(n) == (first if n < high else last) for n in beside)


def _policies(place: Path, folder: Path) -> tuple[list[str], Callable[[int], Policy]]:
    """The names of the policies there, in their order, and what loads one by its number.

    A snapshot becomes a policy file in ``folder``. In a simulation none need be signed.
    """
    paths = sorted(place.glob("*.onnx")) or sorted((place / SNAPSHOTS).glob("*/"))
    if len(paths) < 2:
        many = "train with --set snapshots=true, or name a directory of policy files"
        raise UserError(f"{place} holds no two policies: {many}")

    def load(number: int) -> Policy:
        path = paths[number]
        if path.is_dir():
            path = folder / f"{path.name}.onnx"
            words = trainer_command("export", str(paths[number]), "--out", str(path))
            done = subprocess.run(words, capture_output=True, text=True)
            if done.returncode:
                why = (done.stderr.strip().splitlines() or [""])[-1]
                raise UserError(f"{paths[number]} cannot be exported: {why}")
        return load_policy(path, None, allow_unsigned=True)

    return [path.name for path in paths], load


BISECT = cli.Command(
    cli.examples("python -m bridge bisect drive.mcap --runs runs/phil_1 --at 2s"),
    _add_arguments,
    _run,
)
