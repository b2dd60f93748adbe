"""One cell of the comparison: the left turn, driven once through one kind of network."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from bridge.network import LatencySpec
from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import read_json
from hil_tests.commands import BackgroundCommand
from hil_tests.network.kernel import MTU, kernel_network

JUMBO_MTU = 9000
"""A state (7.3 kB) is one packet."""
PORT = 7447
WAIT_EDGE_S = 20.0
"""What has not come alive by then does not: a handshake takes a few round trips."""
SECONDS_PER_EPISODE = 20.0


class Drive(NamedTuple):
    """What all cells have in common."""

    policy: Path
    public_key: Path
    episodes: int
    seed: int
    folder: Path
    """For the simulator's reports."""


class Cell(NamedTuple):
    """One way through one network."""

    row: str
    transport: str
    spec: LatencySpec


def run_cell(drive: Drive, cell: Cell) -> dict[str, Any]:
    """Drive, and return the numbers of the table.

    Raises:
        UserError: a process failed; it says which and why.
    """
    out = drive.folder / f"{cell.row}-{cell.transport}.json"
    TRANSPORTS[cell.transport](drive, cell, out)
    return summary(read_json(out, "report"))


def summary(report: dict[str, Any]) -> dict[str, Any]:
    """What the table shows of a simulator's report."""
    states = sum(episode["steps"] for episode in report["per_episode"])
    return {
        "states": states,
        "round_trip_ms": report["latency_ms"],
        "unanswered_percent": 100.0 * (1.0 - report["answered_states"] / states),
        "safe_stops": report["safe_stops"],
        "safe_stop_reasons": dict(Counter(e["reason"] for e in report["safe_stop_events"])),
        "success_rate": report["success_rate"],
        "tick_overruns": report["tick_overruns"],
        "rejected_by_edge": report["rejected_by_edge"],
        "rejected_by_simulator": report["rejected_by_simulator"],
    }


def _virtual(drive: Drive, cell: Cell, out: Path) -> None:
    endpoint = free_endpoint()
    with _edge(drive, endpoint):
        options = ("--clock", "lockstep", "--latency", str(cell.spec))
        _simulate(drive, endpoint, out, options)


def _relay(drive: Drive, cell: Cell, out: Path) -> None:
    simulator, listen = free_endpoint(), free_endpoint()
    relay = BackgroundCommand(
        "bridge", "relay", "--listen", listen, "--connect", simulator,
        "--latency", str(cell.spec), "--seed", str(drive.seed), ready="ready",
    )  # fmt: skip
    with relay, _edge(drive, listen):
        _simulate(drive, simulator, out, ("--clock", "realtime"))


def _kernel(protocol: str, mtu: int) -> Callable[[Drive, Cell, Path], None]:
    def run(drive: Drive, cell: Cell, out: Path) -> None:
        tag = f"{cell.row}-{protocol}{mtu}"
        with kernel_network(cell.spec, drive.seed, tag, mtu) as cable, ExitStack() as stack:
            endpoint = f"{protocol}/{cable.address}:{PORT}"
            stack.enter_context(_edge(drive, endpoint, cable.edge))
            _simulate(drive, endpoint, out, ("--clock", "realtime"), cable.simulator)

    return run


TRANSPORTS: dict[str, Callable[[Drive, Cell, Path], None]] = {
    "tcp": _kernel("tcp", MTU),
    "udp": _kernel("udp", MTU),
    "udp_jumbo": _kernel("udp", JUMBO_MTU),
    "relay": _relay,
    "virtual": _virtual,
}
KERNEL = ("tcp", "udp", "udp_jumbo")


def _edge(drive: Drive, endpoint: str, prefix: tuple[str, ...] = ()) -> BackgroundCommand:
    return BackgroundCommand(
        "edge_runtime", "run", "--policy", str(drive.policy),
        "--public-key", str(drive.public_key), "--connect", endpoint,
        ready="ready", prefix=prefix,
    )  # fmt: skip


def _simulate(
    drive: Drive,
    endpoint: str,
    out: Path,
    options: tuple[str, ...],
    prefix: tuple[str, ...] = (),
) -> None:
    run = BackgroundCommand(
        "bridge", "simulate", "--env", "left_turn", "--episodes", str(drive.episodes),
        "--seed", str(drive.seed), "--listen", endpoint, "--wait-edge-s", f"{WAIT_EDGE_S:g}",
        "--out", str(out), *options, prefix=prefix,
    )  # fmt: skip
    with run:
        run.wait(WAIT_EDGE_S + drive.episodes * SECONDS_PER_EPISODE)
