"""``python -m hil_tests doctor``: what this machine can and cannot do, and how to mend it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.util import UserError
from hil_tests.doctor.check import Finding, examine
from hil_tests.doctor.table import CHECKS

NOT_READY = 1
"""Exit status where a basic is missing."""
EXAMPLE = examples(
    "python -m hil_tests doctor",
    "python -m hil_tests doctor --only basics vehicle",
    "python -m hil_tests doctor --json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--only", metavar="GROUP", nargs="+", default=list(CHECKS), help=f"of {', '.join(CHECKS)}"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")


def run(arguments: argparse.Namespace) -> int:
    """Make the checks and print them; 0 where the basics work.

    Raises:
        UserError: a group that is not there.
    """
    for group in arguments.only:
        if group not in CHECKS:
            raise UserError(f"no group {group!r}: choose from {', '.join(CHECKS)}")
    found: list[Finding] = []
    for finding in examine_all(arguments.only):
        if not arguments.json:
            if not found or found[-1].group != finding.group:
                print(f"\n{finding.group}")
            print("\n".join(lines(finding)), flush=True)
        found.append(finding)
    if arguments.json:
        print(json.dumps({"basics": basics_work(found), "checks": [f.as_dict() for f in found]}))
    else:
        print("\n" + summary(found))
    return 0 if basics_work(found) else NOT_READY


def examine_all(groups: list[str]) -> Iterator[Finding]:
    """Each check of these groups, as soon as it is made."""
    for group in groups:
        for check in CHECKS[group]:
            yield examine(group, check)


def basics_work(found: list[Finding]) -> bool:
    """Whether nothing basic is missing."""
    return all(finding.ok for finding in found if finding.basic)


def lines(finding: Finding) -> list[str]:
    """A line where it is there; what it is for and how to get it where it is not."""
    said = f"{finding.name}: {finding.detail}"
    if finding.ok:
        return [f"  ok       {said}"]
    return [
        f"  missing  {said}",
        f"           without it: {finding.without}",
        f"           get it: {finding.remedy}",
    ]


def summary(found: list[Finding]) -> str:
    """The last line."""
    missing = [finding.name for finding in found if not finding.ok]
    if not basics_work(found):
        basics = ", ".join(finding.name for finding in found if finding.basic and not finding.ok)
        return f"The basics do not work here: {basics}."
    basics = "The basics work. " if any(finding.basic for finding in found) else ""
    if missing:
        return f"{basics}Missing{' besides' if basics else ''}: {', '.join(missing)}."
    return f"{basics}Nothing is missing."
