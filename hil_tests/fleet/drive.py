"""One fleet: a router from its file, an edge runtime and a light simulator for each vehicle."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from deploy.__main__ import main as deploy
from edge_runtime import tls
from edge_runtime.link_probe import free_endpoint
from hil_tests.faults.campaign import POLICY, PUBLIC_KEY
from hil_tests.faults.processes import Process, wait_until
from hil_tests.fleet.usage import Carried, Usage, carried, usage, why_not_counted
from hil_tests.fleet.vehicle import Fleet, LightSimulator

_ALL_DRIVE_S = 60.0
_SILENT_S = 0.5
"""A vehicle without a command for this long has noticed that the router is gone."""


class Parts(NamedTuple):
    """A fleet that drives."""

    router_config: Path
    router: Process
    edges: list[Process]
    simulators: list[LightSimulator]
    port: int


class _Look(NamedTuple):
    at_s: float
    router: Usage
    edges: list[Usage]
    simulators_links: Carried
    edges_links: Carried


def measure(count: int, seconds: float, folder: Path, restart: bool = True) -> dict[str, Any]:
    """Drive a fleet for a while; a report for JSON.

    Args:
        count: vehicles.
        seconds: of the measurement, after all of them drive.
        folder: for certificates and the router's file.
        restart: kill the router afterwards, start another, and wait until all drive again.

    Raises:
        TimeoutError: a process did not come, or not every vehicle drives.
    """
    vehicle_ids = [f"vehicle{i:02d}" for i in range(count)]
    with contextlib.ExitStack() as stack:
        parts = _start(stack, vehicle_ids, folder)
        begun_s = time.monotonic()
        stack.enter_context(Fleet(parts.simulators))
        _wait_until_all_drive(parts)
        report: dict[str, Any] = {"vehicles": count, "all_drive_after_s": _since(begun_s)}
        for simulator in parts.simulators:
            simulator.begin()
        before = _look(parts)
        time.sleep(seconds)
        after = _look(parts)
        report |= _numbers(parts, before, after)
        if restart:
            report["router_restart_s"] = _restart_router(stack, parts)
        report["foreign_messages"] = sum(each.foreign for each in parts.simulators)
        return report


def write_certificates(vehicle_ids: list[str], folder: Path) -> Path:
    """Certificates of all parties, as a person would make them; their folder."""
    certificates = folder / "certs"
    _deploy(["certs", "--out", str(certificates), *_named(vehicle_ids)])
    return certificates


def write_router_config(vehicle_ids: list[str], endpoint: str, folder: Path) -> Path:
    """Certificates of all parties, and the router's file."""
    certificates, config = write_certificates(vehicle_ids, folder), folder / "router.json5"
    router = str(certificates / tls.ROUTER)
    _deploy(
        ["router", "--listen", endpoint, "--tls", router, "--out", str(config),
         *_named(vehicle_ids)]
    )  # fmt: skip
    return config


def _named(vehicle_ids: list[str]) -> list[str]:
    return [word for each in vehicle_ids for word in ("--vehicle-id", each)]


def _deploy(arguments: list[str]) -> None:
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        deploy(arguments)


def _start(stack: contextlib.ExitStack, vehicle_ids: list[str], folder: Path) -> Parts:
    endpoint = free_endpoint("tls")
    config = write_router_config(vehicle_ids, endpoint, folder)
    router = stack.enter_context(_process("bridge", "router", "--config", str(config)))
    router.wait_for_line("ready")
    edges = [
        stack.enter_context(
            _process(
                "edge_runtime",
                "run",
                "--policy",
                str(POLICY),
                "--public-key",
                str(PUBLIC_KEY),
                "--connect",
                endpoint,
                "--vehicle-id",
                each,
                "--tls",
                str(folder / "certs" / tls.common_name(tls.EDGE, each)),
            )
        )
        for each in vehicle_ids
    ]
    for edge in edges:
        edge.wait_for_line("ready")
    simulators = []
    for seed, each in enumerate(vehicle_ids):
        simulators.append(LightSimulator(each, endpoint, folder / "certs", seed))
        stack.callback(simulators[-1].close)
    return Parts(config, router, edges, simulators, int(endpoint.rpartition(":")[2]))


@contextlib.contextmanager
def _process(*arguments: str) -> Iterator[Process]:
    process = Process(*arguments)
    try:
        yield process
    finally:
        process.end()


def _wait_until_all_drive(parts: Parts, since_s: float = 0.0) -> None:
    wait_until(
        lambda: all(each.latency_s and each.last_command_s > since_s for each in parts.simulators),
        f"all drive: {[len(each.latency_s) for each in parts.simulators]}",
        _ALL_DRIVE_S,
    )


def _restart_router(stack: contextlib.ExitStack, parts: Parts) -> float:
    """SIGKILL, silence, a new one; seconds from its ready line until every vehicle drives again."""
    parts.router.kill()
    killed_s = time.monotonic()
    wait_until(lambda: _since(killed_s) > _SILENT_S, "silence")
    for simulator in parts.simulators:
        simulator.begin()
    router = stack.enter_context(_process("bridge", "router", "--config", str(parts.router_config)))
    ready_s = router.wait_for_line("ready")
    _wait_until_all_drive(parts, ready_s)
    return _since(ready_s)


def _look(parts: Parts) -> _Look:
    pids = [each.pid for each in parts.edges]
    own = os.getpid()
    links = {} if why_not_counted() else carried([*pids, own], parts.port)
    edges = [links.get(pid, Carried(0, 0)) for pid in pids]
    return _Look(
        time.monotonic(),
        usage(parts.router.pid),
        [usage(pid) for pid in pids],
        links.get(own, Carried(0, 0)),
        Carried(sum(each.sent for each in edges), sum(each.received for each in edges)),
    )


def _numbers(parts: Parts, before: _Look, after: _Look) -> dict[str, Any]:
    took_s, count = after.at_s - before.at_s, len(parts.edges)
    latencies_s = [value for each in parts.simulators for value in each.latency_s.values()]
    states = [each.step for each in parts.simulators]
    answered = [len(each.latency_s) / max(1, len(each.sent_s)) for each in parts.simulators]
    p50, p90, p99 = np.percentile(latencies_s, (50, 90, 99))
    edges_cpu_s = sum(b.cpu_s - a.cpu_s for a, b in zip(before.edges, after.edges, strict=True))
    return {
        "seconds": round(took_s, 2),
        "message_bytes": {
            topic: parts.simulators[0].message_bytes.get(topic, 0)
            for topic in ("state", "command", "health")
        },
        "states_each": min(states),
        "answered_least": min(answered),
        "latency_ms": {name: round(value * 1e3, 3) for name, value in
                       zip(("p50", "p90", "p99", "max"), (p50, p90, p99, max(latencies_s)),
                           strict=True)},
        "router_cpu_percent_of_a_core": 100 * (after.router.cpu_s - before.router.cpu_s) / took_s,
        "router_resident_mb": after.router.resident_mb,
        "edge_cpu_percent_of_a_core": 100 * edges_cpu_s / took_s / count,
        "edge_resident_mb": sum(each.resident_mb for each in after.edges) / count,
        "link_of_an_edge_kbit_s": _rates(before.edges_links, after.edges_links, took_s, count),
        "link_of_a_simulator_kbit_s": _rates(
            before.simulators_links, after.simulators_links, took_s, count
        ),
    }  # fmt: skip


def _rates(before: Carried, after: Carried, took_s: float, count: int) -> dict[str, float] | str:
    """Kilobits a second and vehicle of TCP payload, or why they were not counted."""
    if why_not_counted():
        return why_not_counted()
    scale = 8e-3 / took_s / count
    return {
        "sends": round((after.sent - before.sent) * scale, 2),
        "receives": round((after.received - before.received) * scale, 2),
    }


def _since(begun_s: float) -> float:
    return round(time.monotonic() - begun_s, 3)
