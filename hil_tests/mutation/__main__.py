"""`python -m hil_tests.mutation`: change the core in every small way and see a test fail each time.

Runs cosmic-ray on copies of edge_runtime, so that a run that is killed changes no source.
"""

from __future__ import annotations

import sys
from pathlib import Path

from edge_runtime.cli import ArgumentParser, examples, positive, run_cli
from edge_runtime.files import make_directory, write_atomic, write_json
from edge_runtime.util import UserError
from hil_tests.mutation.report import judge, read_accepted, render
from hil_tests.mutation.session import TARGETS, run_targets


def main(argv: list[str]) -> int:
    """Exit status 0 where every mutant is killed or accepted with a reason, else 1."""
    parser = ArgumentParser(
        prog="python -m hil_tests.mutation",
        description=__doc__,
        epilog=examples("python -m hil_tests.mutation --only safety --out runs/mutation"),
    )
    parser.add_argument(
        "--out", metavar="DIR", default="results/mutation", help="report.md and report.json"
    )
    parser.add_argument(
        "--only", metavar="MODULE", action="append", help=f"of {', '.join(TARGETS)} (default: all)"
    )
    parser.add_argument("--jobs", type=positive, default=2, help="modules at a time")
    arguments = parser.parse_args(argv)
    names = arguments.only or list(TARGETS)
    for name in names:
        if name not in TARGETS:
            raise UserError(f"module {name!r} is not known; choose from {', '.join(TARGETS)}")
    out = Path(arguments.out)
    make_directory(out)
    mutants = run_targets(names, arguments.jobs)
    report = judge(mutants, read_accepted())
    write_json(out / "report.json", report)
    write_atomic(out / "report.md", render(report).encode())
    print(render(report))
    return 0 if not report["survived"] else 1


if __name__ == "__main__":
    sys.exit(run_cli(main))
