"""Options of the commands whose work loads torch: --help need not wait for it."""

import argparse

from bridge.environments import NOMINAL
from edge_runtime import cli
from edge_runtime.cli import add_public_key, command
from trainer.environments import CONDITIONS
from trainer.options import add_scenario


@command(
    "hil_tests.campaign:run",
    "python -m hil_tests campaign --only latency --runs 100 --out runs/latency.json",
    "python -m hil_tests campaign --only faults --rows 'hunter_*' --out runs/faults.json",
)
def campaign(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    out = "report as JSON; R.md and a picture go beside it"
    add("--out", required=True, metavar="R.json", help=out)
    add("--policy", metavar="P.onnx", help="policy file (default: results/policies/SCENARIO.onnx)")
    add_public_key(parser)
    add_scenario(parser)
    add("--condition", choices=CONDITIONS, default=NOMINAL, help="condition of the scene")
    add("--runs", type=cli.whole_number(2), default=100, help="episodes on each network")
    add("--seed", type=cli.not_negative, default=0, help="seed of the first episode")
    add("--target", type=cli.share, default=0.98, help="share of successes that is asked for")
    add("--only", choices=("latency", "faults"), help="run one part (default: both)")
    jobs = "drives or faults at the same time; 0: one a core"
    add("--jobs", type=cli.not_negative, default=0, help=jobs)
    rows = "run only these networks and faults, by name or pattern (delay, hunter_*); an unknown"
    add("--rows", metavar="NAME,...", help=f"{rows} name lists all")
    add("--tries", type=cli.positive, default=10, help="tries of each fault")


@command(
    "hil_tests.envelope:run",
    "python -m hil_tests envelope --policy P.onnx --env left_turn --out E.json",
    "python -m hil_tests envelope --confirm E.json --runs 500 --out C.json",
)
def envelope(parser: argparse.ArgumentParser) -> None:
    inner = cli.number("a share above 0.5 and below 1", lambda value: 0.5 < value < 1.0)
    add, count = parser.add_argument, cli.not_negative
    add("--out", required=True, metavar="F.json", type="path", help="the envelope, as JSON")
    add("--policy", metavar="P.onnx", help="policy file (default: results/policies/ENV.onnx)")
    add_public_key(parser)
    add("--env", help="scenario, gymnasium id or module:id (default: the file's, else left_turn)")
    add("--condition", choices=CONDITIONS, default=NOMINAL, help="condition of the scene")
    add("--promise", type=inner, default=0.95, help="share of successes to be kept")
    add("--confidence", type=inner, default=0.95, help="confidence of each axis's limit")
    add("--seed", type=count, default=0, help="seed of the first drive")
    add("--jobs", type=count, default=0, help="processes that drive; 0: one a core")
    confirms = "drive both sides of each edge in this file with fresh seeds; scene and promise are"
    add("--confirm", metavar="F.json", type="path", help=f"{confirms} the file's")
    add("--runs", type=cli.positive, default=500, help="drives to confirm a network")
