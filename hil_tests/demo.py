"""The whole story in one command: a human's guidance, a policy, a board, a network, a picture."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from edge_runtime.cli import ArgumentParser
from edge_runtime.errors import UserError
from edge_runtime.files import read_bytes
from hil_tests.commands import BackgroundCommand, free_endpoint, run_command
from hil_tests.operator import Operator

LATENCY = "50ms+-10ms"
VEHICLE = "demo01"
EPISODES = 20
FIRST_SEED = 0
RECORDED_EPISODES = 2
TRAINING_EPISODES = 150
TRAINING_MINUTES = 4.5
COLUMNS = ("drive", "success", "distance, m", "p50, ms", "p99, ms", "safe stops")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", default="demo", help="directory for everything the demo makes")
    parser.add_argument(
        "--fresh", action="store_true", help="train anew even where a trained policy is kept"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the training")
    parser.add_argument(
        "--minutes", type=float, default=TRAINING_MINUTES, help="limit of the PHIL-TD3 training"
    )


def run(arguments: argparse.Namespace) -> int:
    """Train or take what is kept, drive, show; returns the exit status."""
    began_s = time.monotonic()
    demo = Demo(Path(arguments.out))
    if arguments.fresh or not demo.offer_kept():
        demo.train(arguments.seed, arguments.minutes)
    demo.drive()
    demo.record()
    demo.show()
    print(f"\ndone in {time.monotonic() - began_s:.0f} s")
    return 0


class Demo:
    """The steps of the demo; each is a command that a person could type."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.policy = directory / "left_turn.onnx"
        self.run_dir, self.human_dir = directory / "run", directory / "human"
        self.public_key = directory / "keys" / "policy.pub"
        self.recording = directory / "drive.rrd"
        self.reports = {
            "in process": directory / "in_process.json",
            "over Zenoh": directory / "wire.json",
            "... 50 ± 10 ms each way": directory / "wire_latency.json",
        }

    def offer_kept(self) -> bool:
        """Whether a trained policy is there and the person (if one is asked) wants it."""
        if not self.policy.exists():
            return False
        made = time.strftime("%Y-%m-%d %H:%M", time.localtime(self.policy.stat().st_mtime))
        print(f"A policy trained by an earlier demo ({made}) is kept in {self.directory}/.")
        if not sys.stdin.isatty():
            print("Using it; --fresh trains anew.")
            return True
        return input("Use it? [Y/n] ").strip().lower() in ("", "y", "yes")

    def train(self, seed: int, minutes: float) -> None:
        """Human model, PHIL-TD3 with its guidance, export with signature."""
        for path in (self.run_dir, self.human_dir, self.public_key.parent):
            shutil.rmtree(path, ignore_errors=True)
        self.policy.unlink(missing_ok=True)
        self.directory.mkdir(parents=True, exist_ok=True)
        heading("1  A person drives and takes over; the human model learns to imitate that")
        run_command("trainer", "human", "--out", str(self.human_dir), "--seed", str(seed))
        heading("2  PHIL-TD3 learns to drive; the human model takes over when it must")
        run_command(
            "trainer", "train", "--human", str(self.human_dir), "--out", str(self.run_dir),
            "--seed", str(seed), "--episodes", str(TRAINING_EPISODES),
            "--max-minutes", f"{minutes:g}", "--set", "batch_size=64",
            "--set", "evaluate_every=10", "--set", "evaluation_runs=30",
        )  # fmt: skip
        shutil.copy(self.run_dir / "learning_curve.png", self.directory / "learning_curve.png")
        heading("3  The actor becomes a signed policy file")
        keys = self.public_key.parent
        run_command("deploy", "keys", "--out", str(keys))
        run_command(
            "trainer", "export", str(self.run_dir), "--out", str(self.policy),
            "--key", str(keys / "policy.key"),
        )  # fmt: skip

    def drive(self) -> None:
        """The same test episodes in process, over the wire, and over a slow wire."""
        in_process, wire, slow_wire = self.reports.values()
        heading("4  Test episodes in process")
        run_command(
            "trainer", "evaluate", str(self.policy), "--runs", str(EPISODES),
            "--seed", str(FIRST_SEED), "--out", str(in_process),
        )  # fmt: skip
        heading("5  The same episodes through an edge runtime in a process of its own")
        self._simulate(EPISODES, "lockstep", "none", wire)
        heading(f"6  Again, with {LATENCY} of latency each way")
        self._simulate(EPISODES, "lockstep", LATENCY, slow_wire)

    def record(self) -> None:
        """A few episodes in real time, recorded for rerun by a listener on the wire."""
        heading(f"7  {RECORDED_EPISODES} episodes in real time, recorded for rerun")
        report = self.directory / "realtime.json"
        self._simulate(RECORDED_EPISODES, "realtime", LATENCY, report, self.recording)

    def show(self) -> None:
        """The table, and where everything is."""
        table = Table(
            title="Left turn, the same seeds; latency from state sent to command received"
        )
        for column in COLUMNS:
            table.add_column(column, justify="left" if column == COLUMNS[0] else "right")
        for name, path in self.reports.items():
            table.add_row(name, *summary_cells(json.loads(read_bytes(path, "report"))))
        Console().print("\n", table)
        print(f"learning curve  {self.directory}/learning_curve.png")
        print(f"recording       {self.recording}   (see it: .venv/bin/rerun {self.recording})")
        print(f"policy          {self.policy}")

    def _simulate(
        self,
        episodes: int,
        clock: str,
        latency: str,
        report: Path,
        recording: Path | None = None,
    ) -> None:
        """Drive over Zenoh: edge runtime, simulator, operator, and a viewer that records."""
        endpoint = free_endpoint()
        common = ("--connect", endpoint, "--vehicle-id", VEHICLE)
        with ExitStack() as stack:
            stack.enter_context(
                BackgroundCommand(
                    "edge_runtime", "run", "--policy", str(self.policy),
                    "--public-key", str(self.public_key), *common, "--vehicle", "mock",
                    ready="ready",
                )
            )  # fmt: skip
            viewer = None
            if recording is not None:
                viewer = stack.enter_context(
                    BackgroundCommand("bridge", "view", "--save", str(recording), *common)
                )
            stack.enter_context(Operator(endpoint, VEHICLE))
            run_command(
                "bridge", "simulate", "--env", "left_turn", "--episodes", str(episodes),
                "--clock", clock, "--latency", latency, "--listen", endpoint,
                "--vehicle-id", VEHICLE, "--seed", str(FIRST_SEED), "--out", str(report),
            )  # fmt: skip
            if viewer is not None and viewer.wait(timeout_s=20.0):
                raise UserError("the recording failed; the viewer has said why")


def heading(text: str) -> None:
    """Announce a step."""
    Console().print(f"\n[bold]{text}[/bold]")


def summary_cells(report: dict[str, Any]) -> list[str]:
    """A report's row of the table."""
    distance, latency = report["surviving_distance_m"], report.get("latency_ms")
    return [
        f"{report['success_rate']:.0%}",
        f"{distance['mean']:.2f} ± {distance['std']:.2f}",
        f"{latency['p50']:.1f}" if latency else "-",
        f"{latency['p99']:.1f}" if latency else "-",
        str(report.get("safe_stops", "-")),
    ]
