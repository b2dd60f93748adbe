"""Drive test episodes with a policy and report how well it does."""

from __future__ import annotations

import argparse
import json

from bridge.network import parse_spec
from bridge.report import GOAL, EpisodeResult, summarise
from edge_runtime.cli import add_public_key, examples, not_negative, positive
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.util import counted
from trainer.commands.options import add_latency, add_scenario, set_threads
from trainer.conditions import CONDITIONS
from trainer.drivers import load_driver, make_environment
from trainer.evaluation import drive_episodes
from trainer.parallel import WORTH_STARTING, choose_jobs, drive_episodes_in_parallel
from trainer.progress import ProgressBar

EXAMPLE = examples(
    "python -m trainer evaluate expert --runs 20",
    "python -m trainer evaluate constant:0 --scenario congestion",
    "python -m trainer evaluate runs/phil_1 --runs 50 --out result.json",
    "python -m trainer evaluate runs/phil_1 --condition variant --latency 50ms+-10ms,loss=1%",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "policy",
        help="an .onnx file, a RUN_DIR, a HUMAN_DIR, the word expert, or constant:ACTION for one "
        "action from -1 to 1 throughout",
    )
    add_public_key(parser)
    add_scenario(parser)
    parser.add_argument(
        "--condition",
        choices=CONDITIONS,
        default="nominal",
        help="; ".join(f"{name}: {what.meaning}" for name, what in CONDITIONS.items()).replace(
            "%", "%%"
        ),
    )
    add_latency(parser, "network between policy and vehicle")
    parser.add_argument("--runs", type=positive, default=50, help="episodes")
    parser.add_argument(
        "--seed", type=not_negative, default=0, help="of the first episode; the next has one more"
    )
    parser.add_argument(
        "--jobs",
        type=not_negative,
        default=0,
        metavar="N",
        help="processes; they change the time taken, never a result. "
        f"0: one a core from {WORTH_STARTING} episodes on, below that a single one",
    )
    parser.add_argument(
        "--out",
        metavar="R.json",
        help="write the report, with each episode, to this file instead of printing it",
    )


def run(arguments: argparse.Namespace) -> int:
    """Evaluate and print the report; returns the exit status."""
    if arguments.out:
        check_writable(arguments.out)
    latency = parse_spec(arguments.latency)
    env = make_environment(arguments.scenario, arguments.condition)
    driver, policy_id = load_driver(arguments.policy, env, arguments.public_key)
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    jobs = min(arguments.jobs or choose_jobs(arguments.runs), arguments.runs)
    goals = 0
    with ProgressBar("evaluating", arguments.runs) as bar:

        def on_episode(result: EpisodeResult) -> None:
            nonlocal goals
            goals += result.outcome == GOAL
            bar.advance({"success": f"{goals / (bar.done + 1):.2f}"})

        if jobs == 1:
            set_threads(1)  # As each worker: the last bits must not depend on how many drive.
            results = drive_episodes(env, driver, seeds, arguments.condition, on_episode, latency)
        else:
            results = drive_episodes_in_parallel(
                arguments.policy,
                arguments.scenario,
                seeds,
                jobs,
                arguments.condition,
                on_episode,
                latency,
                arguments.public_key,
            )
    report = summarise(results, arguments.scenario, arguments.condition, policy_id, arguments.seed)
    report["latency_spec"] = str(latency)
    if not arguments.out:
        print(json.dumps(report, indent=2))
        return 0
    detail = [result.as_dict() for result in results]
    write_json_out(arguments.out, {**report, "per_episode": detail})
    distance_m = report["surviving_distance_m"]
    print(
        f"{counted(arguments.runs, 'episode')}: success {report['success_rate']:.0%}, "
        f"surviving distance {distance_m['mean']:.2f} ± {distance_m['std']:.2f} m: {arguments.out}"
    )
    return 0
