"""Drives chunks over the wire: each worker has its own edge runtime process and endpoint."""

from __future__ import annotations

import queue
import shlex
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from edge_runtime.link_probe import free_endpoint
from edge_runtime.util import UserError, read_json
from hil_tests.campaign.chunks import Chunk, Task, halve, join_reports
from hil_tests.commands import BackgroundCommand, CommandTimeoutError
from hil_tests.options import trusting

VEHICLE = "campaign01"
ATTEMPTS = 6
CHUNK_LIMIT_S = 900.0
OnChunk = Callable[[Chunk, dict[str, Any], float], None]
"""Called with a chunk, the report of its drive, and the wall time that it took (s)."""


def drive_chunks(task: Task, chunks: Sequence[Chunk], jobs: int, on_chunk: OnChunk) -> None:
    """Drive all chunks, ``jobs`` at a time; ``on_chunk`` is called by one thread at a time.

    Raises:
        UserError: a command failed, or the machine stood still again and again.
    """
    waiting: queue.SimpleQueue[Chunk] = queue.SimpleQueue()
    for chunk in chunks:
        waiting.put(chunk)
    stopping, one_at_a_time = threading.Event(), threading.Lock()

    def work() -> None:
        with tempfile.TemporaryDirectory(prefix="phil-campaign-") as directory:
            worker = _Worker(task, Path(directory))
            try:
                while not stopping.is_set() and not waiting.empty():
                    chunk = _next(waiting)
                    if chunk is not None:
                        report, wall_s = worker.drive(chunk)
                        with one_at_a_time:
                            on_chunk(chunk, report, wall_s)
            finally:
                worker.close()

    with ThreadPoolExecutor(min(jobs, len(chunks)) or 1) as pool:
        futures = [pool.submit(work) for _ in range(min(jobs, len(chunks)))]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
        finally:  # Also on ^C: what is being driven is ended, the rest is not begun.
            stopping.set()
        for future in futures:
            future.result()


def _next(waiting: queue.SimpleQueue[Chunk]) -> Chunk | None:
    try:
        return waiting.get_nowait()
    except queue.Empty:
        return None


class _Worker:
    """One edge runtime that stays, and one simulator after another."""

    def __init__(self, task: Task, directory: Path) -> None:
        self._task = task
        self._report = directory / "report.json"
        self._start_edge()

    def _start_edge(self) -> None:
        task = self._task
        self._endpoint = free_endpoint()
        self._edge = BackgroundCommand(
            "edge_runtime", "run", *trusting(task.policy, task.public_key),
            "--connect", self._endpoint, "--vehicle-id", VEHICLE, ready="ready", quiet=True,
        )  # fmt: skip

    def drive(self, chunk: Chunk) -> tuple[dict[str, Any], float]:
        """Drive a chunk undisturbed by the machine; its report, and the wall time of that (s)."""
        try:
            return self._undisturbed(chunk, ATTEMPTS)
        except UserError as error:
            # Nobody listens between two chunks: any process of the machine may take the port. And
            # lock-step crawls beside an edge runtime that has lost its wire: each step waits.
            if not isinstance(error, CommandTimeoutError) and "is in use" not in str(error):
                raise
            self.close()
            self._start_edge()
            return self._undisturbed(chunk, ATTEMPTS)

    def _undisturbed(self, chunk: Chunk, attempts: int) -> tuple[dict[str, Any], float]:
        """Drive a chunk, and a disturbed one again in halves: the good half is done then."""
        began_s = time.monotonic()
        report = self._simulate(chunk)
        wall_s = time.monotonic() - began_s
        if self._task.clock == "realtime" or not disturbed(report):
            return report, wall_s
        if attempts == 1:
            raise UserError(
                f"{chunk.spec}: the edge runtime gets too little processor time for a drive "
                "without a pause; use fewer --jobs (rows that are done are kept)"
            )
        if chunk.episodes == 1:
            return self._undisturbed(chunk, attempts - 1)
        halves = [self._undisturbed(half, attempts) for half in halve(chunk)]
        return join_reports([report for report, _ in halves]), sum(wall for _, wall in halves)

    def close(self) -> None:
        """End the edge runtime."""
        self._edge.__exit__()

    def _simulate(self, chunk: Chunk) -> dict[str, Any]:
        task = self._task
        arguments = (
            "bridge", "simulate", "--env", task.scenario, "--condition", task.condition,
            "--episodes", str(chunk.episodes), "--seed", str(chunk.first_seed),
            "--clock", task.clock, "--latency", chunk.spec,
        )  # fmt: skip
        here = ("--listen", self._endpoint, "--vehicle-id", VEHICLE, "--out", str(self._report))
        with BackgroundCommand(*arguments, *here, quiet=True) as simulator:
            simulator.wait(CHUNK_LIMIT_S)
        report: dict[str, Any] = read_json(self._report, "report")
        return {**report, "command": f"python -m {shlex.join(arguments)}"}


def disturbed(report: dict[str, Any]) -> bool:
    """Whether a lock-step drive shows the machine's own pauses.

    The edge runtime lives in wall time: where it gets no processor for 2 T it rightly stops, and
    virtual time knows nothing of that.
    """
    return bool(report["wall_clock_stalls"])
