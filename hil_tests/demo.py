"""Train with a human's guidance, export, drive over a network, record: all in one command."""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from bridge.report import markdown_table
from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.files import make_directory
from edge_runtime.reach import free_endpoint
from edge_runtime.util import read_json
from hil_tests.processes import Process, operator, run_command

VEHICLE_ID, LATENCY = "demo01", "50ms+-10ms"
GOOD_SUCCESS = 0.8  # Success that the drives without latency should reach
RUNS, RECORDED_RUNS = 20, 2
HUMAN = ("--episodes", 40, "--max-minutes", 2.5, "--refining-updates", 1000)
TRAINING = ("--steps", 1500, "--max-minutes", 4.5)
"""With these limits a demo takes nine minutes at most, even on a slow machine."""
SETTINGS = (
    "batch_size=64", "evaluate_every_steps=500", "evaluation_runs=30",
    # In so few steps, a fast actor gains more than it forgets.
    "actor_learning_rate=5e-4", "cloning_weight=20",
)  # fmt: skip
EXAMPLE = examples("python -m hil_tests demo --out runs/demo")


def add_arguments(parser: ArgumentParser) -> None:
    out = "output directory; a policy, model or training in it is used again"
    parser.add_argument("--out", default="demo", help=out)


def run(arguments: argparse.Namespace) -> int:
    """Train (or use a kept policy), drive, print; return 1 if too few drives reach the goal."""
    began_s, folder = time.monotonic(), Path(arguments.out)
    make_directory(folder)
    policy, public_key = folder / "left_turn.onnx", folder / "keys" / "policy.pub"
    if Path(f"{policy}.sig").exists():
        print(f"Using the policy in {folder}/; name another --out to train anew.")
    else:
        train(folder)
        print("\n3  The actor becomes a signed policy file")
        if not public_key.exists():
            run_command("deploy", "keys", "--out", public_key.parent)
        key = public_key.with_suffix(".key")
        run_command("trainer", "export", folder / "run", "--out", policy, "--key", key)
    reports = drive(folder, ("--policy", str(policy), "--public-key", str(public_key)))
    print(f"\n{drives_table(reports)}")
    print(f"learning curve  {folder}/run/learning_curve.png")
    print(f"recording       {folder}/drive.rrd   (see it: .venv/bin/rerun {folder}/drive.rrd)")
    print(f"policy          {policy}")
    good = min(each["success_rate"] for each in [*reports.values()][:2]) >= GOOD_SUCCESS
    if not good:
        print(f"The policy reaches the goal in fewer than {GOOD_SUCCESS:.0%} of the episodes.")
    print(f"\ndone in {time.monotonic() - began_s:.0f} s")
    return 0 if good else 1


def train(folder: Path) -> None:
    """Train the human model and PHIL-TD3 with its guidance; resume an interrupted training."""
    human_dir, run_dir = folder / "human", folder / "run"
    if not (human_dir / "human.json").exists():  # It is written last.
        print("\n1  A person drives and takes over; the human model learns to imitate that")
        words = ("--seed", 1, "--frames", 2, "--label-every-step", *HUMAN)
        run_command("trainer", "human", "--out", human_dir, *words)
    print("\n2  PHIL-TD3 learns to drive; the human model takes over when it must")
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    settings += ["--resume"] * (run_dir / "config.json").exists()
    options = ("--human", human_dir, "--seed", 1, *TRAINING, *settings)
    run_command("trainer", "train", "--out", run_dir, *options)


def drive(folder: Path, trust: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Drive the same episodes in process, over the wire, and with latency; return the reports."""

    def simulate(name: str, runs: int, clock: str, latency: str, *view: object) -> dict[str, Any]:
        out, endpoint, us = folder / f"{name}.json", free_endpoint(), ("--vehicle-id", VEHICLE_ID)
        words = ("--episodes", runs, "--clock", clock, "--latency", latency, "--out", out)
        with ExitStack() as stack:
            edge = ("edge_runtime", "run", *trust, "--vehicle", "mock", "--connect", endpoint, *us)
            stack.enter_context(Process(*edge, ready="ready", shown=True))
            viewer = ("bridge", *view, "--connect", endpoint, *us)
            views = [stack.enter_context(Process(*viewer, shown=True))] if view else []
            stack.enter_context(operator(endpoint, VEHICLE_ID))
            where = ("--listen", endpoint, *us)
            run_command("bridge", "simulate", "--env", "left_turn", *where, *words)
            for each in views:
                each.succeed()
        return read_json(out, "report")

    reports = {}
    print("\n4  Test episodes in process")
    words = ("--seed", 0, "--runs", RUNS, *trust[2:], "--out", folder / "in_process.json")
    run_command("trainer", "evaluate", trust[1], *words)
    reports["in process"] = read_json(folder / "in_process.json", "report")
    print("\n5  The same episodes through an edge runtime in a process of its own")
    reports["over Zenoh"] = simulate("wire", RUNS, "lockstep", "none")
    print(f"\n6  Again, with {LATENCY} of latency each way")
    reports["... 50 ± 10 ms each way"] = simulate("wire_latency", RUNS, "lockstep", LATENCY)
    print("\n7  In real time, recorded for rerun")
    simulate("realtime", RECORDED_RUNS, "realtime", LATENCY, "view", "--save", folder / "drive.rrd")
    return reports


def drives_table(reports: dict[str, dict[str, Any]]) -> str:
    rows = []
    for name, report in reports.items():
        distance, latency = report["surviving_distance_m"], report.get("latency_ms")
        row = [name, f"{report['success_rate']:.0%}"]
        row.append(f"{distance['mean']:.2f} ± {distance['std']:.2f}")
        row += [f"{latency[each]:.1f}" if latency else "-" for each in ("p50", "p99")]
        rows.append([*row, report.get("safe_stops", "-")])
    head = ("drive", "success", "distance, m", "p50, ms", "p99, ms", "safe stops")
    return "\n".join(markdown_table(head, rows))
