"""``python -m hil_tests``: prove the loop without hardware."""

from __future__ import annotations

import sys

from edge_runtime.cli import program, run_cli

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("hil_tests.demo", "train, export and drive the left turn, end to end"),
    "accept": (
        "hil_tests.commands:accept",
        "check whether a policy may drive a vehicle over a network; write a one-page verdict",
    ),
    "campaign": (
        "hil_tests.commands:campaign",
        "inject every fault, test every simulated network, and write a report",
    ),
    "envelope": ("hil_tests.commands:envelope", "find the worst networks that a policy can bear"),
    "mock_hunter": ("hil_tests.mock_hunter", "run a mock Hunter on a CAN bus, with its faults"),
    "conformance": ("hil_tests.conformance", "test a vehicle's driver against the safety rules"),
}


main = program("python -m hil_tests", "Prove the loop.", COMMANDS, "python -m hil_tests demo")

if __name__ == "__main__":
    sys.exit(run_cli(main))
