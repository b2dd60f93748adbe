"""Does the person wait for the learner? The pace of a real training with a person in it.

``python -m trainer.benches.pace --seconds 120 --out results/person/pace.json`` trains with the
default batch and a program in the person's place, in real time, and reads from the recording when
the hands were asked. The same without learning (``trainer drive``) is measured beside it.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from edge_runtime.cli import ArgumentParser, run_cli, write_json_out
from edge_runtime.errors import UserError
from edge_runtime.files import check_writable
from edge_runtime.option_types import not_negative, positive_number
from trainer.benches.scripted_person import NOTE, last_seen
from trainer.options import add_scenario
from trainer.person.recording import DIRECTORY, Step, read_steps, sittings
from trainer.person.session import LATE_S
from trainer.training.metrics import read_metrics
from trainer.util import about

PATIENCE_S = 120.0
PERIOD_S = 0.1


def drive(directory: Path, command: list[str], seconds: float) -> str:
    """Run the trainer with the scripted person for so long; its stderr.

    Raises:
        UserError: it did not drive, or did not end well.
    """
    seen = directory / "seen"
    seen.write_bytes(bytes(NOTE.size))
    words = [sys.executable, "-m", "trainer.benches.scripted_person", str(seen), *command]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    end_s = time.monotonic() + PATIENCE_S
    try:
        while last_seen(seen)[1] == 0 and process.poll() is None and time.monotonic() < end_s:
            time.sleep(0.05)
        time.sleep(seconds)
        process.terminate()
        _, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    if process.returncode != 0:
        raise UserError(f"the trainer ended with status {process.returncode}: {errors.strip()}")
    return errors


def pace(steps: list[Step]) -> dict[str, float]:
    """How regular the control periods are, by when the hands were asked."""
    gaps_s = [
        (after.time_ns - before.time_ns) * 1e-9
        for before, after in pairwise(steps)
        if after.episode == before.episode and after.step == before.step + 1
    ]
    if not gaps_s:
        raise UserError("too few steps were driven: give it more --seconds")
    off_ms = np.abs(np.array(gaps_s) - PERIOD_S) * 1e3
    return {
        "periods": len(gaps_s),
        "mean_ms": float(np.mean(gaps_s)) * 1e3,
        "off_p50_ms": float(np.percentile(off_ms, 50)),
        "off_p99_ms": float(np.percentile(off_ms, 99)),
        "off_max_ms": float(off_ms.max()),
        "late_share": float((np.array(gaps_s) > PERIOD_S + LATE_S).mean()),
    }


def read(place: Path) -> list[Step]:
    """All steps recorded in a directory."""
    return [step for path in sittings(place) for step in read_steps(path)]


def measure(directory: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Both drives, one after the other."""
    common = ["--scenario", arguments.scenario, "--human", "scripted"]
    common += ["--threads", str(arguments.threads)]
    run_dir, alone = directory / "run", directory / "alone"
    drive(directory, ["drive", "--out", str(alone), "--policy", "expert", *common], 15.0)
    settings = ["--set", "evaluate_every_steps=0", "--episodes", "100000"]
    errors = drive(
        directory, ["train", "--out", str(run_dir), *settings, *common], arguments.seconds
    )
    rows = read_metrics(run_dir)
    updating_s = sum(float(row["learning_s"]) for row in rows)
    driven_s = PERIOD_S * sum(int(row["steps"]) for row in rows)
    save = re.search(r"checkpoints in ([\d.]+) s", errors)
    return {
        **about(),
        "scenario": arguments.scenario,
        "threads": arguments.threads,
        "learning": pace(read(run_dir / DIRECTORY)),
        "not_learning": pace(read(alone)),
        "updating_share_of_time": updating_s / driven_s if driven_s else 0.0,
        "longest_save_s": float(save.group(1)) if save else None,
    }


def main(argv: list[str]) -> int:
    """Measure and report; returns the exit status."""
    parser = ArgumentParser(
        prog="python -m trainer.benches.pace",
        description=(__doc__ or "").split("\n\n")[0],
        epilog="example: python -m trainer.benches.pace --seconds 120 --out pace.json",
    )
    add_scenario(parser)
    parser.add_argument("--seconds", type=positive_number, default=120.0, help="of training")
    parser.add_argument("--threads", type=not_negative, default=0, help="the learner's; 0: all")
    parser.add_argument("--out", metavar="F.json", help="the figures")
    arguments = parser.parse_args(argv)
    if arguments.out is not None:
        check_writable(arguments.out)
    with tempfile.TemporaryDirectory() as directory:
        result = measure(Path(directory), arguments)
    write_json_out(arguments.out, result)
    for name in ("learning", "not_learning"):
        figures = ", ".join(f"{key} {value:.4g}" for key, value in result[name].items())
        print(f"{name}: {figures}")
    print(
        f"updating {result['updating_share_of_time']:.0%} of the time; "
        f"checkpoints in {result['longest_save_s']} s at most"
    )
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
