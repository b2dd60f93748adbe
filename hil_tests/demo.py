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
GOOD_SUCCESS = 0.8  # What the drives without latency should reach
RECORDED_RUNS = 2
TRAINING_STEPS, HUMAN_MINUTES, TRAINING_MINUTES = 1500, 2.5, 4.5
"""With them, a demo takes nine minutes at most, on a slow machine, too."""
REFINING_UPDATES = 1000
SETTINGS = (
    "batch_size=64", "evaluate_every_steps=500", "evaluation_runs=30",
    # Within so few steps a fast actor learns more than it unlearns.
    "actor_learning_rate=5e-4", "cloning_weight=20",
)  # fmt: skip
EXAMPLE = examples(
    "python -m hil_tests demo", "python -m hil_tests demo --fresh --minutes 10 --out runs/demo"
)


def add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("--out", default="demo", help="directory of all it makes")
    parser.add_argument(
        "--fresh", action="store_true", help="train anew even where a trained policy is kept"
    )
    for name, kind, default, text in (
        ("--seed", not_negative, 1, "random seed of the training"),
        ("--steps", positive, TRAINING_STEPS, "environment steps of the PHIL-TD3 training"),
        ("--human-episodes", positive, 40, "episodes of the human model's training"),
        ("--human-minutes", positive_number, HUMAN_MINUTES, "limit of the human model's training"),
        ("--minutes", positive_number, TRAINING_MINUTES, "limit of the PHIL-TD3 training"),
        ("--runs", positive, 20, "test episodes of each drive"),
    ):
        parser.add_argument(name, type=kind, default=default, help=text)


def run(arguments: argparse.Namespace) -> int:
    """Train or take what is kept, drive, show; 1 where the policy misses too many goals."""
    began_s = time.monotonic()
    demo = Demo(Path(arguments.out), arguments.runs)
    demo.claim_directory()
    if arguments.fresh or not demo.has_kept():
        demo.train(arguments)
    success = demo.drive()
    print(f"learning curve  {demo.directory}/learning_curve.png")
    print(f"recording       {demo.recording}   (see it: .venv/bin/rerun {demo.recording})")
    print(f"policy          {demo.policy}")
    good = min(success[:2]) >= GOOD_SUCCESS
    if not good:
        print(f"The policy reaches the goal in fewer than {GOOD_SUCCESS:.0%} of the episodes.")
    print(f"\ndone in {time.monotonic() - began_s:.0f} s")
    return 0 if good else 1


class Demo:
    """The steps of the demo; each is a command that a person could type."""

    def __init__(self, directory: Path, runs: int) -> None:
        self.directory, self.runs = directory, runs
        self.policy, self.recording = directory / "left_turn.onnx", directory / "drive.rrd"
        self.run_dir, self.human_dir = directory / "run", directory / "human"
        self.keys = directory / "keys"
        self.public_key = self.keys / "policy.pub"
        self.made = (self.policy, Path(f"{self.policy}.sig"), self.public_key)

    def claim_directory(self) -> None:
        """Take an empty directory, or one of an earlier demo; UserError where it is another's."""
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
        """Return whether a trained policy with its signature is there, and say that it is used."""
        if not all(path.exists() for path in self.made):
            return False
        made = time.strftime("%Y-%m-%d %H:%M", time.localtime(self.policy.stat().st_mtime))
        print(f"A policy trained by an earlier demo ({made}) is kept in {self.directory}/.")
        print("Using it; --fresh trains anew.")
        return True

    def train(self, arguments: argparse.Namespace) -> None:
        """Train the human model and PHIL-TD3 with its guidance; export with signature."""
        unfinished = (self.run_dir / "checkpoint.pt").exists() and not self.policy.exists()
        resume = ["--resume"] if unfinished and not arguments.fresh else []
        seed = ("--seed", arguments.seed)
        if resume:
            print("An earlier demo was interrupted in its training: going on with that.")
        else:
            for path in (self.run_dir, self.human_dir):
                shutil.rmtree(path, ignore_errors=True)
            command(
                "1  A person drives and takes over; the human model learns to imitate that",
                "trainer", "human", "--out", self.human_dir, *seed,
                "--episodes", arguments.human_episodes, "--frames", "2", "--label-every-step",
                "--refining-updates", REFINING_UPDATES, "--max-minutes", arguments.human_minutes,
            )  # fmt: skip
        settings = [word for setting in SETTINGS for word in ("--set", setting)]
        command(
            "2  PHIL-TD3 learns to drive; the human model takes over when it must",
            "trainer", "train", "--human", self.human_dir, "--out", self.run_dir, *seed,
            "--steps", arguments.steps, "--max-minutes", arguments.minutes, *settings, *resume,
        )  # fmt: skip
        shutil.copy(self.run_dir / "learning_curve.png", self.directory / "learning_curve.png")
        # If it is cut off from here on, the policy of the earlier key must not count as kept.
        for path in self.made:
            path.unlink(missing_ok=True)
        shutil.rmtree(self.keys, ignore_errors=True)
        command("3  The actor becomes a signed policy file", "deploy", "keys", "--out", self.keys)
        key = self.keys / "policy.key"
        command("", "trainer", "export", self.run_dir, "--out", self.policy, "--key", key)

    def drive(self) -> list[float]:
        """Drive the same episodes in process, over the wire, over a slow wire; then record.

        Print a table, and return the success of each.
        """
        reports = [self.directory / f"{n}.json" for n in ("in_process", "wire", "wire_latency")]
        command(
            "4  Test episodes in process", "trainer", "evaluate", self.policy, "--seed", "0",
            "--runs", self.runs, "--public-key", self.public_key, "--out", reports[0],
        )  # fmt: skip
        heading("5  The same episodes through an edge runtime in a process of its own")
        self._simulate(self.runs, "lockstep", "none", reports[1])
        heading(f"6  Again, with {LATENCY} of latency each way")
        self._simulate(self.runs, "lockstep", LATENCY, reports[2])
        heading("7  In real time, recorded for rerun")
        view = ("view", "--save", str(self.recording))
        runs = min(RECORDED_RUNS, self.runs)
        self._simulate(runs, "realtime", LATENCY, self.directory / "realtime.json", *view)
        found = [read_json(path, "report") for path in reports]
        names = ("in process", "over Zenoh", "... 50 ± 10 ms each way")
        Console().print("\n", drives_table(dict(zip(names, found, strict=True))))
        return [report["success_rate"] for report in found]

    def _simulate(
        self, episodes: int, clock: str, latency: str, report: Path, *listener: str
    ) -> None:
        trust = ("--policy", str(self.policy), "--public-key", str(self.public_key))
        words = ("--episodes", str(episodes), "--clock", clock, "--latency", latency, "--seed", "0")
        drive_shown("demo01", trust, (*words, "--out", str(report)), listener)


def heading(text: str) -> None:
    """Announce a step."""
    Console().print(f"\n[bold]{text}[/bold]")


def command(title: str, *words: object) -> None:
    """Announce a step, where it has a title, and run its command."""
    if title:
        heading(title)
    run_command(*map(str, words))


def drives_table(reports: dict[str, dict[str, Any]]) -> Table:
    """Make a row for each report, under its name."""
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
