"""Pictures of what results/ keeps: learning curves, and success against latency."""

from __future__ import annotations

import shutil
from pathlib import Path

from edge_runtime.util import read_json
from hil_tests.campaign.figures import write_figures
from hil_tests.commands import run_command

RUNS = Path("results/units/left_turn/phil_td3/normal")
LATENCY = Path("results/latency/left_turn/shipped.json")


def learning_curve(out: Path, _work: Path) -> None:
    """Three seeds of PHIL-TD3 in the left turn."""
    run_dirs = sorted(str(path) for path in RUNS.glob("seed_*"))
    run_command("trainer", "plot", *run_dirs, "--out", str(out))


def success_against_latency(out: Path, work: Path) -> None:
    """The shipped policy behind worse and worse networks."""
    report = read_json(LATENCY, "latency report")
    names = write_figures(work / LATENCY.name, report["latency"], {})
    shutil.copyfile(work / names["success"], out)
