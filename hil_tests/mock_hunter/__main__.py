"""``python -m hil_tests.mock_hunter``: the command alone, started without all the others."""

from __future__ import annotations

import sys

from edge_runtime.cli import ArgumentParser, run_cli
from hil_tests.mock_hunter import command


def main(argv: list[str]) -> int:
    """Run it; the exit status."""
    parser = ArgumentParser(prog="python -m hil_tests.mock_hunter", description=command.__doc__)
    command.add_arguments(parser)
    return command.run(parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(run_cli(main))
