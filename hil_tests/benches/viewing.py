"""What looking on costs: the training loop with ``--rerun``, and the simulator with a view beside.

Training: two runs of the same seed, one of them watched, drive the same episodes in turn; they take
the same steps to the bit, so that only the time differs. Simulator: the time that a tick spends on
the scene for viewers, with ``bridge view`` beside and without.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bridge.environments import make_environment
from bridge.port import SimulatorPort, open_port
from bridge.scene import Stamps
from edge_runtime.cli import ArgumentParser, examples, run_cli, write_json_out
from edge_runtime.files import check_writable
from edge_runtime.option_types import positive
from edge_runtime.transport import free_endpoint
from edge_runtime.wire import State, encode
from hil_tests.commands import BackgroundCommand
from trainer.options import set_threads
from trainer.training.config import RunConfig
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun
from trainer.training.seen import Seen
from trainer.util import processor_model, source_revision
from trainer.view import watched
from viewing.sinks import Sink

LIMIT_MS = 1.0
TICK_S = 0.02
"""Five times as quick as the loop: less waiting, the same work."""
VIEWER_S = 3.0
"""For the view to come up and listen."""


class Called:
    """A function whose calls are timed."""

    def __init__(self, function: Any) -> None:
        self.function, self.times_ms = function, list[float]()

    def __call__(self, argument: Seen | EpisodeMetrics) -> None:
        """Call it."""
        began_s = time.perf_counter()
        self.function(argument)
        self.times_ms.append((time.perf_counter() - began_s) * 1e3)


def measure_training(episodes: int, scenario: str) -> dict[str, Any]:
    """Time a step with the view and without, in turn, and what the loop spends in it itself."""
    config = RunConfig(scenario=scenario, episodes=10**6, evaluate_every_steps=0)
    with tempfile.TemporaryDirectory(prefix="phil-view-") as work, contextlib.ExitStack() as stack:
        folder = Path(work)
        runs = [TrainingRun(config, folder) for _ in range(2)]
        for run in runs:
            stack.callback(run.learning.close)
        on_episode = Called(
            stack.enter_context(watched(runs[1], Sink("save", str(folder / "run.rrd"))))
        )
        on_step = Called(runs[1].on_step)
        runs[1].on_step = on_step
        _warm_up(runs, on_episode)
        rows = [_episode(runs, on_episode, number % 2 == 1) for number in range(episodes)]
    plain_ms, watched_ms = (np.array(column) for column in zip(*rows, strict=True))
    steps = len(on_step.times_ms)
    return {
        "scenario": scenario,
        "steps": steps,
        "plain_ms_a_step": float(np.median(plain_ms)),
        "watched_ms_a_step": float(np.median(watched_ms)),
        "difference_ms_a_step": float(np.median(watched_ms - plain_ms)),
        "in_the_loop_ms_a_step": (sum(on_step.times_ms) + sum(on_episode.times_ms)) / steps,
        "in_the_loop_p99_ms": float(np.percentile(on_step.times_ms, 99)),
        "at_an_episodes_end_ms": float(np.mean(on_episode.times_ms)),
        "limit_ms": LIMIT_MS,
    }


def _warm_up(runs: list[TrainingRun], on_episode: Called) -> None:
    """Until updates run in both."""
    while runs[0].learning.added <= runs[0].config.learner.warmup_steps:
        for run in runs:
            metrics = run.advance()
        on_episode(metrics)


def _episode(runs: list[TrainingRun], on_episode: Called, reverse: bool) -> tuple[float, float]:
    """The time of a step of one episode in each run, ms; who is first changes."""
    found = [0.0, 0.0]
    for number in (1, 0) if reverse else (0, 1):
        began_s = time.perf_counter()
        metrics = runs[number].advance()
        if number == 1:
            on_episode(metrics)
        found[number] = (time.perf_counter() - began_s) * 1e3 / metrics.steps
    return found[0], found[1]


def measure_simulator(ticks: int, scenario: str) -> dict[str, Any]:
    """Time what a tick spends on the scene."""
    with tempfile.TemporaryDirectory(prefix="phil-view-") as work:
        endpoint = free_endpoint()
        with open_port(endpoint, "bench") as port:
            plain_ms = _ticks(port, scenario, ticks)
            with _view(endpoint, Path(work) / "loop.rrd"):
                watched_ms = _ticks(port, scenario, ticks)
    return {
        "scenario": scenario,
        "ticks": ticks,
        "plain_ms_a_tick": float(np.mean(plain_ms)),
        "watched_ms_a_tick": float(np.mean(watched_ms)),
        "watched_p99_ms": float(np.percentile(watched_ms, 99)),
        "limit_ms": LIMIT_MS,
    }


@contextlib.contextmanager
def _view(endpoint: str, out: Path) -> Iterator[None]:
    words = ("--connect", endpoint, "--vehicle-id", "bench", "--save", str(out))
    with BackgroundCommand("bridge", "view", *words, quiet=True):
        time.sleep(VIEWER_S)
        yield


def _ticks(port: SimulatorPort, scenario: str, ticks: int) -> list[float]:
    """Drive with the pedal down, publish state and scene each tick; ms that the scenes took."""
    environment = make_environment(scenario)
    action = np.zeros(1, np.float32)
    times_ms, step, ended = [], 0, True
    for _ in range(ticks):
        if ended:
            observation, _info = environment.reset(seed=1)
            step = 0
        stamps = Stamps(0, step, round(0.1 * step, 6), 1.0, max(step - 1, 0), {"stale": step})
        began_s = time.perf_counter()
        port.publish_scene(environment, stamps)
        times_ms.append((time.perf_counter() - began_s) * 1e3)
        port.publish_state(_state(port.session, step, observation))
        observation, _, terminated, truncated, _info = environment.step(action)
        step, ended = step + 1, terminated or truncated
        time.sleep(TICK_S)
    return times_ms


def _state(session: str, step: int, observation: Any) -> bytes:
    state = State(
        session=session, episode=0, step=step, sim_time_s=round(0.1 * step, 6),
        sent_ns=time.time_ns(), frames=observation.tobytes(), speed_mps=0.0, final=False,
    )  # fmt: skip
    return encode(state)


def main(argv: list[str]) -> int:
    """Measure, print, and write the JSON. The limit is shown, never enforced."""
    parser = ArgumentParser(
        prog="python -m hil_tests.benches.viewing",
        description=__doc__,
        epilog=examples("python -m hil_tests.benches.viewing --out runs/viewing.json"),
    )
    parser.add_argument("--episodes", type=positive, default=12, help="of each training run")
    parser.add_argument("--ticks", type=positive, default=500, help="of the simulator, each way")
    parser.add_argument(
        "--scenario", choices=("left_turn", "congestion"), default="left_turn", help="which drive"
    )
    parser.add_argument("--threads", type=int, default=0, metavar="N", help="0: all cores")
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")
    arguments = parser.parse_args(argv)
    if arguments.out is not None:
        check_writable(arguments.out)
    set_threads(arguments.threads)
    report = {
        "machine": {"processor": processor_model(), "cores": os.cpu_count()},
        "source_revision": source_revision(),
        "training": measure_training(arguments.episodes, arguments.scenario),
        "simulator": measure_simulator(arguments.ticks, arguments.scenario),
    }
    write_json_out(arguments.out, report)
    print(json.dumps(report, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
