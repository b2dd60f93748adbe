"""What mutual TLS with access control costs: ``python -m hil_tests.benches.tls_cost``.

State sent to command received, one edge runtime for each link, blocks of both in turn: a busy
machine disturbs them alike, so compare them only with each other.
"""

from __future__ import annotations

import contextlib
import queue
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from deploy.certs import add_arguments, run
from edge_runtime import wire
from edge_runtime.access import rules_for_listener
from edge_runtime.cli import ArgumentParser, UserError, examples, run_cli, write_json_out
from edge_runtime.option_types import positive
from edge_runtime.tls import load_tls
from edge_runtime.transport import free_endpoint, open_session
from hil_tests.options import trusting

VEHICLE_ID = "hunter01"
PACE_S = 0.004
BLOCK = 250
WAIT_S = 5.0


class Bench:
    """A simulator's end that sends states and waits for the command that answers each."""

    def __init__(self, endpoint: str, folder: Path | None) -> None:
        tls = None if folder is None else load_tls(folder / f"simulator-{VEHICLE_ID}")
        rules = None if tls is None else rules_for_listener([VEHICLE_ID])
        self._session = open_session(listen=endpoint, mode="router", tls=tls, access=rules)
        self._arrivals: queue.Queue[tuple[int, bytes]] = queue.Queue()
        self._states = self._session.declare_publisher(wire.key(VEHICLE_ID, "state"))
        self._commands = self._session.declare_subscriber(
            wire.key(VEHICLE_ID, "command"),
            lambda sample: self._arrivals.put((time.perf_counter_ns(), sample.payload.to_bytes())),
        )
        self._step = 0
        self.round_trips_us: list[float] = []

    def block(self, count: int, keep: bool = True) -> None:
        """Send ``count`` states at the pace, each after the answer to the one before."""
        for _ in range(count):
            due_s = time.perf_counter() + PACE_S
            took_us = self._round_trip_us()
            if keep:
                self.round_trips_us.append(took_us)
            time.sleep(max(0.0, due_s - time.perf_counter()))

    def close(self) -> None:
        """Undeclare and close."""
        self._commands.undeclare()
        self._states.undeclare()
        self._session.close()

    def _round_trip_us(self) -> float:
        state = self._next_state()
        sent_ns = time.perf_counter_ns()
        self._states.put(wire.encode(state))
        while True:
            try:
                arrived_ns, payload = self._arrivals.get(timeout=WAIT_S)
            except queue.Empty:
                raise UserError(f"no command within {WAIT_S:g} s") from None
            command = wire.decode_command(payload)
            if isinstance(command, wire.Command) and command.step == state.step:
                return (arrived_ns - sent_ns) / 1000

    def _next_state(self) -> wire.State:
        self._step += 1
        return wire.State(
            session="bench",
            episode=0,
            step=self._step,
            sim_time_s=self._step * wire.CONTROL_PERIOD_S,
            sent_ns=time.time_ns(),
            frames=bytes(wire.FRAMES_BYTES),
            speed_mps=1.0,
            final=False,
        )


@contextlib.contextmanager
def edge_and_bench(policy: Path, folder: Path | None) -> Iterator[Bench]:
    """An edge runtime in a process of its own, and the other end of its link."""
    endpoint = free_endpoint("tcp" if folder is None else "tls")
    bench = Bench(endpoint, folder)
    command = [sys.executable, "-m", "edge_runtime", "run", "--log-level", "error"]
    command += [*trusting(policy, None), "--connect", endpoint]
    if folder is not None:
        command += ["--tls", str(folder / f"edge-{VEHICLE_ID}")]
    edge = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert edge.stdout is not None
        edge.stdout.readline()
        time.sleep(1.0)  # Until it has connected: an unanswered state would be waited for.
        yield bench
    finally:
        edge.terminate()
        edge.wait(10)
        bench.close()


def measure(policy: Path, blocks: int) -> dict[str, Any]:
    """Quantiles in microseconds by link, and how they compare."""
    with tempfile.TemporaryDirectory() as folder:
        certificates = Path(folder) / "certs"
        parser = ArgumentParser()
        add_arguments(parser)
        with contextlib.redirect_stdout(sys.stderr):
            run(parser.parse_args(["--out", str(certificates), "--vehicle-id", VEHICLE_ID]))
        with edge_and_bench(policy, None) as plain, edge_and_bench(policy, certificates) as tls:
            for bench in (plain, tls):
                bench.block(BLOCK, keep=False)
            for number in range(blocks):
                for bench in (plain, tls) if number % 2 else (tls, plain):
                    bench.block(BLOCK)
    rows = {"tcp": quantiles(plain.round_trips_us), "tls": quantiles(tls.round_trips_us)}
    ratio = {name: round(rows["tls"][name] / rows["tcp"][name], 3) for name in rows["tcp"]}
    return {"round_trip_us": rows, "tls_over_tcp": ratio, "round_trips": blocks * BLOCK}


def quantiles(values: list[float]) -> dict[str, float]:
    """p50, p90 and p99."""
    found = np.percentile(values, [50, 90, 99])
    return {f"p{q}": round(float(v), 1) for q, v in zip((50, 90, 99), found, strict=True)}


def main(argv: list[str]) -> int:
    """Measure, print a line for each link, and write the result."""
    parser = ArgumentParser(
        prog="python -m hil_tests.benches.tls_cost",
        description=__doc__,
        epilog=examples("python -m hil_tests.benches.tls_cost --out runs/tls.json"),
    )
    parser.add_argument(
        "--policy", default="results/policies/left_turn.onnx", help="the policy that answers"
    )
    parser.add_argument(
        "--blocks", type=positive, default=12, help=f"blocks of {BLOCK} round trips on each link"
    )
    parser.add_argument("--out", metavar="R.json", help="write the result to this file")
    arguments = parser.parse_args(argv)
    result = measure(Path(arguments.policy), arguments.blocks)
    for name, row in result["round_trip_us"].items():
        print(name, *(f"{label} {value:.0f} us" for label, value in row.items()))
    print("tls / tcp", *(f"{label} {value:.2f}" for label, value in result["tls_over_tcp"].items()))
    write_json_out(arguments.out, result)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
