"""Options of the commands whose modules load torch: so --help does not wait for it."""

import argparse

from bridge.environments import NOMINAL
from bridge.network import parse_spec
from edge_runtime import cli
from edge_runtime.cli import add_public_key, command
from edge_runtime.config import add_trust
from trainer.__main__ import add_scenario
from trainer.environments import CONDITIONS


@command(
    "hil_tests.campaign:run",
    "python -m hil_tests campaign --only latency --runs 100 --out runs/latency.json",
    "python -m hil_tests campaign --only faults --rows 'hunter_*' --out runs/faults.json",
)
def campaign(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    out = "report to write, as JSON; R.md and a picture are written beside it"
    add("--out", required=True, metavar="R.json", type="path", help=out)
    add_scenario(parser)
    _add_common(parser, "SCENARIO")
    add("--runs", type=cli.whole_number(2), default=100, help="episodes per network")
    add("--only", choices=("latency", "faults"), help="run one part (default: both)")
    rows = "run only these networks and faults, by name or pattern (delay, hunter_*); an unknown"
    add("--rows", metavar="NAME,...", help=f"{rows} name lists all")
    add("--tries", type=cli.positive, default=10, help="repetitions of each fault")


@command(
    "hil_tests.envelope:run",
    "python -m hil_tests envelope --policy P.onnx --env left_turn --out E.json",
)
def envelope(parser: argparse.ArgumentParser) -> None:
    inner = cli.number("a share above 0.5 and below 1", lambda value: 0.5 < value < 1.0)
    add = parser.add_argument
    out = "envelope to write, as JSON, and as a picture F.png: green holds, red breaks; the same "
    out += "command goes on with an unfinished one"
    add("--out", required=True, metavar="F.json", type="path", help=out)
    add("--env", default="left_turn", help="scenario, gymnasium id or MODULE:ID")
    _add_common(parser, "ENV")
    add("--promise", type=inner, default=0.95, help="success rate that the policy must keep")


@command(
    "hil_tests.accept.command:run",
    "python -m hil_tests accept --policy P.onnx --env left_turn --out runs/accept",
    "python -m hil_tests accept --policy P.onnx --env left_turn --vehicle mock \\\n"
    "    --link 50ms+-10ms,loss=1% --config accept.toml --quick --out runs/accept",
)
def accept(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--policy", required=True, metavar="P.onnx", type="path", help="policy file to judge")
    add_trust(parser)
    add("--env", required=True, help="scenario, gymnasium id or MODULE:ID")
    driver = "vehicle whose driver is tested and driven, as by `edge_runtime run`: lift the wheels "
    driver += "(default: none)"
    add("--vehicle", metavar="NAME", help=driver)
    link = "network that the policy is to drive over, such as 50ms+-10ms,loss=1%%"
    add("--link", metavar="SPEC", type=parse_spec, default="none", help=link)
    board = "measure the inference time on this board, by ssh (default: here)"
    add("--board", metavar="USER@HOST", help=board)
    settings = "thresholds (hil_tests/accept/accept.toml explains them)"
    add("--config", metavar="accept.toml", type="path", help=settings)
    add("--quick", action="store_true", help="fewer drives and faults: 4 minutes, not 25")
    out = "folder of report.html, report.json and junit.xml; after ^C the same command goes on; "
    out += "exit status 1: rejected"
    add("--out", required=True, metavar="DIR", type="path", help=out)


def _add_common(parser: argparse.ArgumentParser, env: str) -> None:
    add, count = parser.add_argument, cli.not_negative
    policy = f"policy file (default: results/policies/{env}.onnx)"
    add("--policy", metavar="P.onnx", type="path", help=policy)
    add_public_key(parser)
    add("--condition", choices=CONDITIONS, default=NOMINAL, help="the scenario's traffic and noise")
    add("--seed", type=count, default=0, help="seed of the first drive")
    add("--jobs", type=count, default=0, help="parallel drives or faults; 0: one per core")
