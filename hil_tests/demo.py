"""The whole story in one command: a human's guidance, a policy, a board, a network, a picture."""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from edge_runtime.cli import ArgumentParser, examples, not_negative, positive, positive_number
from edge_runtime.util import UserError, read_json
from hil_tests.processes import drive_shown, run_command

MARKER = ".phil-demo"
"""Says that a directory is a demo's, so that the demo may replace what is in it."""
LATENCY = "50ms+-10ms"
VEHICLE = "demo01"
RUNS = 20
GOOD_SUCCESS = 0.8  # What the drives without latency should reach
FIRST_SEED = 0
RECORDED_RUNS = 2
TRAINING_STEPS = 1500
HUMAN_MINUTES = 2.5  # With them, a demo takes nine at most, on a slow machine, too
TRAINING_MINUTES = 4.5

EXAMPLE = examples(
    "python -m hil_tests demo", "python -m hil_tests demo --fresh --minutes 10 --out runs/demo"
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", default="demo", help="directory of all it makes")
    parser.add_argument(
        "--fresh", action="store_true", help="train anew even where a trained policy is kept"
    )
    for name, kind, default, text in (
        ("--seed", not_negative, 1, "of the training"),
        ("--steps", positive, TRAINING_STEPS, "environment steps of the PHIL-TD3 training"),
        ("--human-episodes", positive, 40, "of the human model's training"),
        ("--human-minutes", positive_number, HUMAN_MINUTES, "limit of the human model's training"),
        ("--minutes", positive_number, TRAINING_MINUTES, "limit of the PHIL-TD3 training"),
        ("--runs", positive, RUNS, "test episodes of each drive"),
    ):
        parser.add_argument(name, type=kind, default=default, help=text)


def run(arguments: argparse.Namespace) -> int:
    """Train or take what is kept, drive, show.

    Returns:
        0, or 1 where the policy reaches the goal in fewer episodes than it should.
    """
    began_s = time.monotonic()
    demo = Demo(Path(arguments.out), arguments.runs)
    demo.claim_directory()
    if arguments.fresh or not demo.has_kept():
        demo.train(arguments)
    demo.drive()
    demo.record()
    good = demo.show()
    print(f"\ndone in {time.monotonic() - began_s:.0f} s")
    return 0 if good else 1


class Demo:
    """The steps of the demo; each is a command that a person could type."""

    def __init__(self, directory: Path, runs: int) -> None:
        self.directory, self.runs = directory, runs
        self.policy = directory / "left_turn.onnx"
        self.run_dir, self.human_dir = directory / "run", directory / "human"
        self.keys = directory / "keys"
        self.public_key = self.keys / "policy.pub"
        self.recording = directory / "drive.rrd"
        self.reports = {
            "in process": directory / "in_process.json",
            "over Zenoh": directory / "wire.json",
            "... 50 ± 10 ms each way": directory / "wire_latency.json",
        }

    def claim_directory(self) -> None:
        """Take an empty directory, or one that an earlier demo made: others are not touched.

        Raises:
            UserError: the directory holds something else.
        """
        marker = self.directory / MARKER
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(self.directory.iterdir()) and not marker.exists():
                raise UserError(
                    f"--out {self.directory} holds something else; name an empty directory"
                )
            marker.touch()
        except OSError as error:
            raise UserError(f"--out {self.directory}: {error.strerror}") from None

    def has_kept(self) -> bool:
        """Whether a trained policy with its signature is there; says that it is used."""
        signature = Path(f"{self.policy}.sig")
        if not all(path.exists() for path in (self.policy, signature, self.public_key)):
            return False
        made = time.strftime("%Y-%m-%d %H:%M", time.localtime(self.policy.stat().st_mtime))
        print(f"A policy trained by an earlier demo ({made}) is kept in {self.directory}/.")
        print("Using it; --fresh trains anew.")
        return True

    def train(self, arguments: argparse.Namespace) -> None:
        """Human model, PHIL-TD3 with its guidance, export with signature."""
        seed = str(arguments.seed)
        unfinished = (self.run_dir / "checkpoint.pt").exists() and not self.policy.exists()
        resume = ["--resume"] if unfinished and not arguments.fresh else []
        if resume:
            print("An earlier demo was interrupted in its training: going on with that.")
        else:
            for path in (self.run_dir, self.human_dir):
                shutil.rmtree(path, ignore_errors=True)
            heading("1  A person drives and takes over; the human model learns to imitate that")
            run_command(
                "trainer", "human", "--out", str(self.human_dir), "--seed", seed,
                "--episodes", str(arguments.human_episodes), "--frames", "2", "--label-every-step",
                "--refining-updates", "1000", "--max-minutes", f"{arguments.human_minutes:g}",
            )  # fmt: skip
        heading("2  PHIL-TD3 learns to drive; the human model takes over when it must")
        run_command(
            "trainer", "train", "--human", str(self.human_dir), "--out", str(self.run_dir),
            "--seed", seed, "--steps", str(arguments.steps),
            "--max-minutes", f"{arguments.minutes:g}", "--set", "batch_size=64",
            "--set", "evaluate_every_steps=500", "--set", "evaluation_runs=30", *resume,
            # Within so few steps a fast actor learns more than it unlearns.
            "--set", "actor_learning_rate=5e-4", "--set", "cloning_weight=20",
        )  # fmt: skip
        shutil.copy(self.run_dir / "learning_curve.png", self.directory / "learning_curve.png")
        heading("3  The actor becomes a signed policy file")
        # If it is cut off from here on, the policy of the earlier key must not count as kept.
        for path in (self.policy, Path(f"{self.policy}.sig")):
            path.unlink(missing_ok=True)
        shutil.rmtree(self.keys, ignore_errors=True)
        run_command("deploy", "keys", "--out", str(self.keys))
        run_command(
            "trainer", "export", str(self.run_dir), "--out", str(self.policy),
            "--key", str(self.keys / "policy.key"),
        )  # fmt: skip

    def drive(self) -> None:
        """The same test episodes in process, over the wire, and over a slow wire."""
        in_process, wire, slow_wire = self.reports.values()
        heading("4  Test episodes in process")
        run_command(
            "trainer", "evaluate", str(self.policy), "--runs", str(self.runs),
            "--public-key", str(self.public_key),
            "--seed", str(FIRST_SEED), "--out", str(in_process),
        )  # fmt: skip
        heading("5  The same episodes through an edge runtime in a process of its own")
        self._simulate(self.runs, "lockstep", "none", wire)
        heading(f"6  Again, with {LATENCY} of latency each way")
        self._simulate(self.runs, "lockstep", LATENCY, slow_wire)

    def record(self) -> None:
        """A few episodes in real time, recorded for rerun by a listener on the wire."""
        heading("7  In real time, recorded for rerun")
        report = self.directory / "realtime.json"
        view = ("view", "--save", str(self.recording))
        self._simulate(min(RECORDED_RUNS, self.runs), "realtime", LATENCY, report, *view)

    def show(self) -> bool:
        """The table, where everything is, and whether the policy drives as well as it should."""
        reports = {name: read_json(path, "report") for name, path in self.reports.items()}
        Console().print("\n", drives_table(reports))
        print(f"learning curve  {self.directory}/learning_curve.png")
        print(f"recording       {self.recording}   (see it: .venv/bin/rerun {self.recording})")
        print(f"policy          {self.policy}")
        success = [report["success_rate"] for report in reports.values()]
        good = min(success[:2]) >= GOOD_SUCCESS
        if not good:
            print(f"The policy reaches the goal in fewer than {GOOD_SUCCESS:.0%} of the episodes.")
        return good

    def _simulate(
        self, episodes: int, clock: str, latency: str, report: Path, *listener: str
    ) -> None:
        trust = ("--policy", str(self.policy), "--public-key", str(self.public_key))
        simulate = (
            "--episodes", str(episodes), "--clock", clock, "--latency", latency,
            "--seed", str(FIRST_SEED), "--out", str(report),
        )  # fmt: skip
        drive_shown(VEHICLE, trust, simulate, listener)


def heading(text: str) -> None:
    """Announce a step."""
    Console().print(f"\n[bold]{text}[/bold]")


def drives_table(reports: dict[str, dict[str, Any]]) -> Table:
    """A row for each report, under its name."""
    table = Table(title="Left turn, the same seeds; latency from state sent to command received")
    table.add_column("drive")
    for column in ("success", "distance, m", "p50, ms", "p99, ms", "safe stops"):
        table.add_column(column, justify="right")
    for name, report in reports.items():
        distance, latency = report["surviving_distance_m"], report.get("latency_ms")
        table.add_row(
            name,
            f"{report['success_rate']:.0%}",
            f"{distance['mean']:.2f} ± {distance['std']:.2f}",
            *(f"{latency[name]:.1f}" if latency else "-" for name in ("p50", "p99")),
            str(report.get("safe_stops", "-")),
        )
    return table
