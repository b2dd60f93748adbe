"""Training on a GPU: seconds for 10,000 steps of one run, and of several runs at once.

Runs are what they are in use: processes of ``python -m trainer train``, here without validation and
checkpoints. They are watched through their metrics, and ended once each has taken its steps.
Several algorithms or seeds at once are plain processes: without NVIDIA's MPS, which nothing here
starts, the GPU works for one process at a time, in slices.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from edge_runtime.cli import ArgumentParser, UserError, examples, run_cli, write_json_out
from edge_runtime.files import check_writable
from edge_runtime.option_types import positive
from trainer.benches.machine import about
from trainer.learner.config import LearnerConfig
from trainer.training.metrics import read_metrics

STEPS = 10_000
ENDLESS = 10**6
"""Episodes; the runs are ended before."""
LOOK_EVERY_S = 0.05


class WatchedRun:
    """A training process, and when it had taken how many steps.

    Args:
        seed: of the run.
        directory: of this run alone.
        device: ``cuda``, or ``cpu``.
    """

    def __init__(self, seed: int, directory: Path, device: str) -> None:
        self.run_dir, self._log = directory / "run", directory / "log"
        settings = ("evaluate_every=0", f"checkpoint_every={ENDLESS + 1}")
        options = {"--device": device, "--seed": seed, "--episodes": ENDLESS, "--threads": 1}
        command = [sys.executable, "-m", "trainer", "train", "--out", str(self.run_dir)]
        command += [str(part) for option in options.items() for part in option]
        command += [part for setting in settings for part in ("--set", setting)]
        self.began_s = time.monotonic()
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)
        self.looks: list[tuple[float, int]] = []
        """Seconds since the start, and steps by then."""

    @property
    def steps(self) -> int:
        """Steps when it was last looked at."""
        return self.looks[-1][1] if self.looks else 0

    def look(self) -> None:
        """See how far it is.

        Raises:
            UserError: it ended by itself.
        """
        if self.process.poll() is not None:
            lines = self._log.read_text(errors="replace").strip().splitlines()
            raise UserError(f"a training run ended early: {lines[-1] if lines else 'silently'}")
        rows = read_metrics(self.run_dir)
        # A row that is just being written has no last field yet.
        done = [int(row["total_steps"]) for row in rows if row["validation_distance_m"]]
        if done and done[-1] > self.steps:
            self.looks.append((time.monotonic() - self.began_s, done[-1]))

    def stop(self) -> None:
        """End the process: there is nothing in it to be kept."""
        self.process.kill()
        self.process.wait()


def seconds(looks: list[tuple[float, int]], steps: int, warmup_steps: int) -> dict[str, float]:
    """What a run's looks, as (seconds since the start, steps), say.

    Returns:
        ``whole_s``: from the start of the process until at least ``steps`` steps were taken.
        ``s_per_10k_steps``: the pace from the first look behind the warm-up to the last; nan where
        there is only one. Starting Python and capturing graphs is not in it.
    """
    whole_s = next(second for second, taken in looks if taken >= steps)
    behind = [look for look in looks if look[1] > warmup_steps]
    pace = float("nan")
    if len(behind) > 1:
        (first_s, first), (last_s, last) = behind[0], behind[-1]
        pace = STEPS * (last_s - first_s) / (last - first)
    return {"whole_s": whole_s, "s_per_10k_steps": pace}


def measure_runs(runs: int, device: str = "cuda", steps: int = STEPS) -> dict[str, Any]:
    """Train ``runs`` runs at once; those that are done go on until all are.

    Returns:
        ``slowest``, the run that took longest, and ``each``; see ``seconds``.
    """
    with (
        tempfile.TemporaryDirectory() as directory,
        _started(runs, Path(directory), device) as at_work,
    ):
        while min(run.steps for run in at_work) < steps:
            time.sleep(LOOK_EVERY_S)
            for run in at_work:
                run.look()
        warmup_steps = LearnerConfig().warmup_steps
        each = [seconds(run.looks, steps, warmup_steps) for run in at_work]
    slowest = {name: max(figures[name] for figures in each) for name in each[0]}
    return {"runs": runs, "steps": steps, "slowest": slowest, "each": each}


def measure_accelerator(runs: int) -> dict[str, Any]:
    """One run, then ``runs`` at once, on the GPU.

    Raises:
        UserError: there is no GPU.
    """
    if not torch.cuda.is_available():
        raise UserError("no CUDA device is available: there is nothing to measure here")
    return {
        **about(),
        "device": torch.cuda.get_device_name(),
        "one_run": measure_runs(1),
        "runs_at_once": measure_runs(runs),
    }


def main(argv: list[str]) -> int:
    """Measure and print; the exit status."""
    parser = ArgumentParser(
        prog="python -m trainer.benches.accelerator",
        description="Measures PHIL-TD3 in the left turn on a GPU.",
        epilog=examples("python -m trainer.benches.accelerator --runs 8 --out accelerator.json"),
    )
    parser.add_argument("--runs", type=positive, default=8, metavar="N", help="runs at once")
    parser.add_argument("--out", metavar="F.json", help="also write the figures to this file")
    arguments = parser.parse_args(argv)
    if arguments.out:
        check_writable(arguments.out)
    report = measure_accelerator(arguments.runs)
    print(json.dumps(report, indent=2))
    write_json_out(arguments.out, report)
    return 0


@contextlib.contextmanager
def _started(runs: int, directory: Path, device: str) -> Iterator[list[WatchedRun]]:
    started: list[WatchedRun] = []
    try:
        for seed in range(runs):
            own = directory / str(seed)
            own.mkdir()
            started.append(WatchedRun(seed, own, device))
        yield started
    finally:
        for run in started:
            run.stop()


if __name__ == "__main__":
    sys.exit(run_cli(main))
