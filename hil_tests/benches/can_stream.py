"""``python -m hil_tests.benches.can_stream``: how evenly the set-points leave, both cores busy.

The whole drive runs, each part a process: simulator, edge runtime with the Hunter's driver, mock
Hunter; a bare sender (`can_floor.py`) streams beside it on a bus of its own; and a process that
never waits keeps each core busy, at the same priority as all the others. A third party hears both
buses, and takes the kernel's stamps: only the senders' gaps count.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from edge_runtime.cli import ArgumentParser, examples, run_cli, write_json_out
from edge_runtime.errors import UserError
from edge_runtime.files import check_writable
from edge_runtime.option_types import not_negative, positive
from edge_runtime.wire import SAFE_STOP
from hil_tests.benches.can_floor import CAN_ID
from hil_tests.faults.can_ears import CanEars
from hil_tests.faults.chassis import free_bus
from hil_tests.faults.ends import spin
from hil_tests.faults.processes import Process
from hil_tests.faults.rig import Rig
from hil_tests.faults.slow_policy import write_steady
from trainer.util import processor_model, source_revision

P99_BAR_MS = 25.0
TIMEOUT_BAR_MS = 500.0
"""The chassis then takes the link for lost."""
_SETTLE_S = 2.0
_TELL_EVERY_S = 5.0


def main(argv: list[str]) -> int:
    """Measure, print the table, and write the JSON. Bars are shown, never enforced."""
    parser = ArgumentParser(
        prog="python -m hil_tests.benches.can_stream",
        description=__doc__,
        epilog=examples("python -m hil_tests.benches.can_stream --minutes 1 --out runs/can.json"),
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="of streaming")
    parser.add_argument(
        "--busy", type=positive, default=os.cpu_count() or 1, help="processes that never wait"
    )
    parser.add_argument(
        "--realtime-priority",
        type=not_negative,
        default=0,
        metavar="1..99",
        help="of both senders, as the edge runtime's; 0: none, that of the busy processes",
    )
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")
    arguments = parser.parse_args(argv)
    if not 0.0 < arguments.minutes < 24 * 60:
        parser.error(f"--minutes {arguments.minutes} is not between 0 and a day")
    if arguments.out is not None:
        check_writable(arguments.out)
    report = {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "source_revision": source_revision(),
        "busy_processes": arguments.busy,
        "realtime_priority": arguments.realtime_priority,
        **measure(arguments.minutes * 60.0, arguments.busy, arguments.realtime_priority),
    }
    write_json_out(arguments.out, report)
    print(render(report))
    return 0


def measure(seconds: float, busy: int, priority: int = 0) -> dict[str, Any]:
    """Stream so long; the gaps of both senders, and what became of the drive."""
    with tempfile.TemporaryDirectory(prefix="phil-can-") as work:
        policy = Path(work) / "steady.onnx"
        write_steady(policy)
        flags = ["--policy", str(policy), "--allow-unsigned"]
        config = Path(work) / "edge.toml"
        config.write_text(f"realtime_priority = {priority}\n")
        flags += ["--config", str(config)]
        with (
            Rig(flags, Path(work), vehicle="hunter", model="hunter-2.0") as rig,
            _floor(priority) as floor,
        ):
            _wait_for_a_drive(rig)
            with _busy(busy):
                time.sleep(_SETTLE_S)
                begin_s = rig.mark()
                _wait(seconds)
                end_s = rig.mark()
            return _report(rig, floor, begin_s, end_s)


def _wait_for_a_drive(rig: Rig) -> None:
    try:
        rig.wait_until_driving()
    except TimeoutError as error:
        last = rig.edge.lines[-1][1] if rig.edge.lines else "nothing"
        raise UserError(f"no drive to measure: {error}; the edge runtime said: {last}") from None


def _report(rig: Rig, floor: CanEars, begin_s: float, end_s: float) -> dict[str, Any]:
    assert rig.ears is not None
    assert rig.chassis is not None
    ours = [one.seen_s for one in rig.ears.of(CAN_ID, begin_s) if one.seen_s < end_s]
    bare = [one.seen_s for one in floor.of(CAN_ID, begin_s) if one.seen_s < end_s]
    during = [one for one in rig.chassis.truth if begin_s < one.since_s < end_s]
    stops = [m for m in rig.timeline.modes if begin_s < m.seen_s < end_s]
    return {
        "seconds": round(end_s - begin_s, 1),
        "driver": gaps(ours),
        "floor": gaps(bare),
        "links_lost": sum(one.control == "link_lost" for one in during),
        "safe_stops": sum(mode.mode == SAFE_STOP for mode in stops),
    }


def gaps(times_s: Sequence[float]) -> dict[str, float]:
    """Quantiles of the time between two frames, ms; and how many gaps were over the bar."""
    found = np.array([after - before for before, after in pairwise(times_s)]) * 1e3
    p50, p99 = np.percentile(found, (50, 99))
    return {
        "frames": len(times_s),
        "p50_ms": round(float(p50), 3),
        "p99_ms": round(float(p99), 3),
        "max_ms": round(float(found.max()), 3),
        "over_25_ms": int((found > P99_BAR_MS).sum()),
    }


def render(report: dict[str, Any]) -> str:
    """The table for a person."""
    lines = [
        f"50 Hz over udp_multicast, {report['seconds'] / 60:.1f} min,"
        f" {report['busy_processes']} busy processes, priority {report['realtime_priority']}",
        "| gap between frames, ms | p50 | p99 | longest | over 25 | frames |",
        "|---|---|---|---|---|---|",
    ]
    for name, title in (("driver", "the Hunter's driver"), ("floor", "bare sender beside it")):
        row = report[name]
        cells = [f"{row[key]:.1f}" for key in ("p50_ms", "p99_ms", "max_ms")]
        counts = [str(row["over_25_ms"]), f"{row['frames']:,}"]
        lines.append("| " + " | ".join([title, *cells, *counts]) + " |")
    met = report["driver"]["p99_ms"] < P99_BAR_MS and report["driver"]["max_ms"] < TIMEOUT_BAR_MS
    lines.append(
        f"bar: p99 under {P99_BAR_MS:.0f}, longest under {TIMEOUT_BAR_MS:.0f}:"
        f" {'met' if met else 'MISSED'}; the chassis lost the link {report['links_lost']} times,"
        f" {report['safe_stops']} safe stops"
    )
    return "\n".join(lines)


@contextmanager
def _floor(priority: int) -> Iterator[CanEars]:
    bus = free_bus()
    ears = CanEars(bus, (CAN_ID,))
    process = Process("hil_tests.benches.can_floor", bus, str(priority))
    try:
        process.wait_for_line("ready")
        yield ears
    finally:
        process.end()
        ears.close()


@contextmanager
def _busy(count: int) -> Iterator[None]:
    spinners = [
        multiprocessing.get_context("spawn").Process(target=spin, daemon=True) for _ in range(count)
    ]
    for spinner in spinners:
        spinner.start()
    try:
        yield
    finally:
        for spinner in spinners:
            spinner.kill()
            spinner.join()


def _wait(seconds: float) -> None:
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0:
        if sys.stderr.isatty():
            print(f"\r{left_s:5.0f} s left ", end="", file=sys.stderr, flush=True)
        time.sleep(min(left_s, _TELL_EVERY_S))


if __name__ == "__main__":
    sys.exit(run_cli(main))
