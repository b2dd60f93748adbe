"""What many vehicles cost before the first of them comes: certificates, a router's rules."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

from deploy.router import router_config
from edge_runtime import access
from edge_runtime.tls import load_tls
from edge_runtime.transport import free_endpoint
from hil_tests.faults.processes import Process
from hil_tests.fleet.drive import write_certificates, write_router_config
from hil_tests.fleet.usage import usage


def certificates_ms(count: int, folder: Path) -> float:
    """Processor time that a vehicle's certificates take, of `count` made at once."""
    begun_s = time.process_time()
    write_certificates([f"vehicle{i:06d}" for i in range(count)], folder)
    return round(1e3 * (time.process_time() - begun_s) / count, 1)


def measure_rules(counts: Sequence[int], folder: Path) -> list[dict[str, float]]:
    """For each number of vehicles: the file's size, and a router's start and memory with it.

    Args:
        counts: vehicles with rights; none of them connects.
        folder: for the router's certificate and files.

    Raises:
        TimeoutError: the router did not start.
    """
    write_router_config(["vehicle00"], free_endpoint("tls"), folder)
    tls = load_tls(folder / "certs" / access.ROUTER)
    rows = []
    for count in counts:
        path = folder / f"rules_{count}.json5"
        vehicle_ids = [f"vehicle{i:06d}" for i in range(count)]
        path.write_text(json.dumps(router_config([free_endpoint("tls")], vehicle_ids, tls)))
        begun_s = time.monotonic()
        router = Process("bridge", "router", "--config", str(path))
        try:
            ready_s = router.wait_for_line("ready", 120.0) - begun_s
            resident_mb = usage(router.pid).resident_mb
        finally:
            router.end()
        rows.append(
            {
                "vehicles": count,
                "file_bytes": path.stat().st_size,
                "ready_after_s": round(ready_s, 3),
                "resident_mb": resident_mb,
            }
        )
    return rows
