"""``python -m hil_tests``: the loop, proven without hardware."""

from __future__ import annotations

import sys

from edge_runtime.cli import program, run_cli

COMMANDS: dict[str, tuple[str, str]] = {
    "doctor": ("hil_tests.doctor", "what this machine can and cannot do, and how to get the rest"),
    "demo": ("hil_tests.demo", "train, export and drive the left turn, end to end"),
    "campaign": ("hil_tests.commands:campaign", "every fault, every latency row, one report"),
    "envelope": ("hil_tests.commands:envelope", "the smallest networks that break a policy"),
    "mock_hunter": ("hil_tests.mock_hunter.process", "a Hunter on a CAN bus, with all its faults"),
    "conformance": ("hil_tests.conformance", "a vehicle's driver against the rules that stop it"),
    "bench": ("hil_tests.bench_loop", "the loop's latency beside a bare Zenoh callback"),
}


main = program(
    "python -m hil_tests", "Proves the loop.", COMMANDS,
    "python -m hil_tests doctor", "python -m hil_tests demo",
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(run_cli(main))
