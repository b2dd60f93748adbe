"""The whole story in one command: a human's guidance, a policy, a board, a network, a picture."""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path
from typing import Any

from bridge.report import markdown_table
from edge_runtime.cli import ArgumentParser, examples, not_negative, positive, positive_number
from edge_runtime.files import make_directory
from edge_runtime.util import UserError, read_json
from hil_tests.processes import drive_shown, run_command

MARKER = ".phil-demo"
"""Says that a directory is a demo's, so that the demo may replace what is in it."""
LATENCY = "50ms+-10ms"
GOOD_SUCCESS = 0.8  # What the drives without latency should reach
RECORDED_RUNS = 2
TRAINING_STEPS, TRAINING_MINUTES = 1500, 4.5
HUMAN = ("--episodes", 40, "--max-minutes", 2.5, "--refining-updates", 1000)
"""With them, a demo takes nine minutes at most, on a slow machine, too."""
SETTINGS = (
    "batch_size=64", "evaluate_every_steps=500", "evaluation_runs=30",
    # Within so few steps a fast actor learns more than it unlearns.
    "actor_learning_rate=5e-4", "cloning_weight=20",
)  # fmt: skip
EXAMPLE = examples(
    "python -m hil_tests demo", "python -m hil_tests demo --fresh --minutes 10 --out runs/demo"
)


def add_arguments(parser: ArgumentParser) -> None:
    add, fresh = parser.add_argument, "train anew even where a trained policy is kept"
    add("--out", default="demo", help="directory of all it makes")
    add("--fresh", action="store_true", help=fresh)
    add("--seed", type=not_negative, default=1, help="random seed of the training")
    add("--steps", type=positive, default=TRAINING_STEPS, help="steps of the PHIL-TD3 training")
    minutes = "limit of the PHIL-TD3 training"
    add("--minutes", type=positive_number, default=TRAINING_MINUTES, help=minutes)
    add("--runs", type=positive, default=20, help="test episodes of each drive")


def run(arguments: argparse.Namespace) -> int:
    """Train or take what is kept, drive, show; 1 where the policy misses too many goals."""
    began_s, folder = time.monotonic(), Path(arguments.out)
    claim(folder)
    policy, public_key = folder / "left_turn.onnx", folder / "keys" / "policy.pub"
    made = (policy, Path(f"{policy}.sig"), public_key)
    if arguments.fresh or not all(path.exists() for path in made):
        train(arguments, folder)
        # If it is cut off from here on, the policy of the earlier key must not count as kept.
        for path in made:
            path.unlink(missing_ok=True)
        shutil.rmtree(public_key.parent, ignore_errors=True)
        print("\n3  The actor becomes a signed policy file")
        command("deploy", "keys", "--out", public_key.parent)
        key = public_key.with_suffix(".key")
        command("trainer", "export", folder / "run", "--out", policy, "--key", key)
    else:
        print(f"Using the policy that is kept in {folder}/; --fresh trains anew.")
    reports = drive(folder, ("--policy", str(policy), "--public-key", str(public_key)), arguments)
    print(f"\n{drives_table(reports)}")
    print(f"learning curve  {folder}/run/learning_curve.png")
    print(f"recording       {folder}/drive.rrd   (see it: .venv/bin/rerun {folder}/drive.rrd)")
    print(f"policy          {policy}")
    good = min(each["success_rate"] for each in [*reports.values()][:2]) >= GOOD_SUCCESS
    if not good:
        print(f"The policy reaches the goal in fewer than {GOOD_SUCCESS:.0%} of the episodes.")
    print(f"\ndone in {time.monotonic() - began_s:.0f} s")
    return 0 if good else 1


def claim(folder: Path) -> None:
    """Take an empty directory, or one of an earlier demo; UserError where it is another's."""
    make_directory(folder)
    if any(folder.iterdir()) and not (folder / MARKER).exists():
        raise UserError(f"--out {folder} holds something else; name an empty directory")
    (folder / MARKER).touch()


def train(arguments: argparse.Namespace, folder: Path) -> None:
    """Train the human model and PHIL-TD3 with its guidance, or go on with a training."""
    run_dir, human_dir, seed = folder / "run", folder / "human", ("--seed", arguments.seed)
    resume = ["--resume"]
    if arguments.fresh or not (run_dir / "checkpoint.pt").exists():
        resume = []
        for path in (run_dir, human_dir):
            shutil.rmtree(path, ignore_errors=True)
        print("\n1  A person drives and takes over; the human model learns to imitate that")
        told = ("--frames", "2", "--label-every-step", *HUMAN)
        command("trainer", "human", "--out", human_dir, *seed, *told)
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    print("\n2  PHIL-TD3 learns to drive; the human model takes over when it must")
    command(
        "trainer", "train", "--human", human_dir, "--out", run_dir, *seed,
        "--steps", arguments.steps, "--max-minutes", arguments.minutes, *settings, *resume,
    )  # fmt: skip


def drive(
    folder: Path, trust: tuple[str, ...], arguments: argparse.Namespace
) -> dict[str, dict[str, Any]]:
    """Drive the same episodes in process, over the wire, over a slow wire; then record.

    Return the reports of the first three, under their names.
    """

    def simulate(name: str, runs: int, clock: str, latency: str, *listener: str) -> dict[str, Any]:
        words = ("--episodes", str(runs), "--clock", clock, "--latency", latency, "--seed", "0")
        out = folder / f"{name}.json"
        drive_shown("demo01", trust, (*words, "--out", str(out)), listener)
        return read_json(out, "report")

    runs, reports = arguments.runs, {}
    print("\n4  Test episodes in process")
    words = ("--seed", 0, "--runs", runs, *trust[2:], "--out", folder / "in_process.json")
    command("trainer", "evaluate", trust[1], *words)
    reports["in process"] = read_json(folder / "in_process.json", "report")
    print("\n5  The same episodes through an edge runtime in a process of its own")
    reports["over Zenoh"] = simulate("wire", runs, "lockstep", "none")
    print(f"\n6  Again, with {LATENCY} of latency each way")
    reports["... 50 ± 10 ms each way"] = simulate("wire_latency", runs, "lockstep", LATENCY)
    print("\n7  In real time, recorded for rerun")
    view = ("view", "--save", str(folder / "drive.rrd"))
    simulate("realtime", min(RECORDED_RUNS, runs), "realtime", LATENCY, *view)
    return reports


def command(*words: object) -> None:
    run_command(*map(str, words))


def drives_table(reports: dict[str, dict[str, Any]]) -> str:
    """Make a row for each report, under its name; latency from state sent to command received."""
    rows = []
    for name, report in reports.items():
        distance, latency = report["surviving_distance_m"], report.get("latency_ms")
        row = [name, f"{report['success_rate']:.0%}"]
        row.append(f"{distance['mean']:.2f} ± {distance['std']:.2f}")
        row += [f"{latency[each]:.1f}" if latency else "-" for each in ("p50", "p99")]
        rows.append([*row, report.get("safe_stops", "-")])
    head = ("drive", "success", "distance, m", "p50, ms", "p99, ms", "safe stops")
    return "\n".join(markdown_table(head, rows))
