"""A rig: edge runtime, simulator and (in the loop with a vehicle) mock Hunter, as processes."""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import read_json
from hil_tests.commands import BackgroundCommand
from hil_tests.faults.chassis import free_bus
from hil_tests.operator import Operator
from hil_tests.options import trusting

VEHICLE_ID = "rig01"
POLICY, VEHICLE = LOOPS = ("policy", "vehicle")
LONGEST_EPISODE_S = 60.0
"""With the wait for a stand before it; the scenarios time out after 30 s."""


class Drive(NamedTuple):
    """What a rig is to drive. ``changes``: parameters of the mock."""

    policy: Path
    scenario: str
    condition: str
    loop: str
    first_seed: int
    episodes: int
    changes: Mapping[str, float]
    public_key: str | None = None


def run_rig(drive: Drive) -> dict[str, Any]:
    """Set the rig up, drive, and clear it away; the simulator's report, with its command.

    Raises:
        UserError: a command failed; it has said why.
    """
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory(prefix="phil-rig-") as folder, ExitStack() as stack:
        directory = Path(folder)
        edge = _start_vehicle(drive, directory, stack) if drive.loop == VEHICLE else ()
        stack.enter_context(
            BackgroundCommand(
                "edge_runtime", "run", *trusting(drive.policy, drive.public_key),
                "--connect", endpoint, "--vehicle-id", VEHICLE_ID, *edge, ready="ready", quiet=True,
            )
        )  # fmt: skip
        if drive.loop == VEHICLE:
            stack.enter_context(Operator(endpoint, VEHICLE_ID))
        return _simulate(drive, endpoint, directory / "report.json")


def _start_vehicle(drive: Drive, directory: Path, stack: ExitStack) -> tuple[str, ...]:
    """Start a mock Hunter on a bus of its own; the edge runtime's options to drive it."""
    bus = free_bus()
    settings = [f"--set={name}={value}" for name, value in drive.changes.items()]
    stack.enter_context(
        BackgroundCommand(
            "hil_tests", "mock_hunter", "--bus", bus, *settings, ready="ready", quiet=True
        )
    )
    config = directory / "edge.toml"
    config.write_text(f'bus = "{bus}"\n')
    return ("--vehicle", "hunter", "--config", str(config))


def _simulate(drive: Drive, endpoint: str, out: Path) -> dict[str, Any]:
    arguments = (
        "bridge", "simulate", "--env", drive.scenario, "--condition", drive.condition,
        "--clock", "realtime", "--loop", drive.loop, "--standing",
        "--episodes", str(drive.episodes), "--seed", str(drive.first_seed),
    )  # fmt: skip
    here = ("--listen", endpoint, "--vehicle-id", VEHICLE_ID, "--out", str(out))
    with BackgroundCommand(*arguments, *here, quiet=True) as simulator:
        simulator.wait(LONGEST_EPISODE_S * (1 + drive.episodes))
    report: dict[str, Any] = read_json(out, "report")
    return {**report, "command": f"python -m {shlex.join(arguments)}"}
