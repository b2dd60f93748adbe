"""Does the human object to drives that need no objection? What taking over rests on, counted.

``python -m trainer.benches.objections --out results/humans/objections.json`` lets the expert and
the human model of each scenario drive, and asks the trigger at every step.
"""

from __future__ import annotations

import sys
from typing import Any

from edge_runtime.cli import ArgumentParser, run_cli, write_json_out
from edge_runtime.episode_report import GOAL
from edge_runtime.files import check_writable
from edge_runtime.option_types import positive
from trainer.drivers import EXPERTS, TRIGGERS, load_driver, make_environment
from trainer.human.guide import Driver
from trainer.scenarios import SCENARIOS
from trainer.util import source_revision


def objections(env: Any, driver: Driver, drives: int) -> dict[str, int]:
    """Drives with the seeds 0, 1, ...; how many arrived, and to how many of those it objected."""
    trigger = TRIGGERS[env.scenario](EXPERTS[env.scenario](env))
    arrived = objected = 0
    for seed in range(drives):
        observation, info = env.reset(seed=seed)
        driver.reset()
        trigger.reset()
        reasons = set()
        while "outcome" not in info:
            action = driver.act(observation)
            reasons.add(trigger.judge(action))
            observation, _, _, _, info = env.step(action)
        arrived += info["outcome"] == GOAL
        objected += info["outcome"] == GOAL and reasons != {None}
    return {"drives": drives, "arrived": arrived, "objected_of_these": objected}


def main(argv: list[str]) -> int:
    """Count and report; returns the exit status."""
    parser = ArgumentParser(
        prog="python -m trainer.benches.objections",
        description=(__doc__ or "").split("\n\n")[0],
        epilog="example: python -m trainer.benches.objections --out objections.json",
    )
    parser.add_argument("--drives", type=positive, default=200, help="of each driver")
    parser.add_argument("--humans", default="results/humans", help="directory of human models")
    parser.add_argument("--out", metavar="F.json", help="the counts")
    arguments = parser.parse_args(argv)
    if arguments.out is not None:
        check_writable(arguments.out)
    result: dict[str, Any] = {"source_revision": source_revision()}
    for scenario in SCENARIOS:
        env = make_environment(scenario)
        drivers = {"expert": "expert", "human_model": f"{arguments.humans}/{scenario}"}
        result[scenario] = {
            name: objections(env, load_driver(policy, env)[0], arguments.drives)
            for name, policy in drivers.items()
        }
        print(scenario, result[scenario], flush=True)
    write_json_out(arguments.out, result)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
