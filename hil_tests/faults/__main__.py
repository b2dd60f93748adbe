"""``python -m hil_tests.faults``: the fault campaign alone."""

from __future__ import annotations

import sys
from pathlib import Path

from edge_runtime.cli import ArgumentParser, add_public_key, examples, positive, run_cli
from edge_runtime.files import check_writable, write_json_out
from hil_tests.faults import render_faults, run_faults


def main(argv: list[str]) -> int:
    """Run rows of the table and print it; 0 where every limit was kept, else 1."""
    parser = ArgumentParser(
        prog="python -m hil_tests.faults",
        description="The fault campaign.",
        epilog=examples(
            "python -m hil_tests.faults --rows 'hunter_*' --tries 10 --out runs/faults.json"
        ),
    )
    parser.add_argument("--tries", type=positive, default=3, help="of each fault")
    parser.add_argument("--rows", help="names or patterns (hunter_*), commas between")
    parser.add_argument("--policy", type=Path, help="policy file (the left turn's if not given)")
    add_public_key(parser)
    parser.add_argument("--jobs", type=positive, default=2, help="rigs at once")
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")
    arguments = parser.parse_args(argv)
    if arguments.out is not None:
        check_writable(arguments.out)
    rows = arguments.rows.split(",") if arguments.rows else None
    report = run_faults(
        arguments.tries, rows, arguments.policy, _tell, arguments.jobs, arguments.public_key
    )
    write_json_out(arguments.out, report)
    print(render_faults(report))
    for row in report["rows"]:
        for name in ("wrong", "unsafe", "crashes"):
            for text in row[name][:5]:
                print(f"{row['name']}: {name}: {text}")
    return 0 if report["passed"] else 1


def _tell(row: str, done: int, total: int) -> None:
    print(f"\r{done}/{total} {row:<28}", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(run_cli(main))
