"""Those commands of ``python -m hil_tests`` whose work loads torch: their options, and its place.

That takes seconds; ``--help`` need not wait for it.
"""

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
    out = "the report; R.md and a picture go beside it"
    parser.add_argument("--out", required=True, metavar="R.json", help=out)
    default = "policy file (default: results/policies/SCENARIO.onnx)"
    parser.add_argument("--policy", metavar="P.onnx", help=default)
    add_public_key(parser)
    add_scenario(parser)
    parser.add_argument("--condition", choices=CONDITIONS, default=NOMINAL, help="scene")
    for name, kind, value, text in (
        ("--runs", cli.whole_number(2), 100, "episodes of each row, the same seeds"),
        ("--seed", cli.not_negative, 0, "of the first episode"),
        ("--target", cli.share, 0.98, "success that is asked for"),
    ):
        parser.add_argument(name, type=kind, default=value, help=text)
    only = "one part (default: both)"
    parser.add_argument("--only", choices=("latency", "faults"), help=only)
    jobs = "drives or faults side by side; 0: one a core"
    parser.add_argument("--jobs", type=cli.not_negative, default=0, help=jobs)
    rows = "only these latency axes and faults, by name or pattern (delay, hunter_*); a wrong one "
    rows += "lists them"
    parser.add_argument("--rows", metavar="NAME,...", help=rows)
    parser.add_argument("--tries", type=cli.positive, default=10, help="of each fault")


@command(
    "hil_tests.envelope:run",
    "python -m hil_tests envelope --policy P.onnx --env left_turn --out E.json",
    "python -m hil_tests envelope --confirm E.json --runs 500 --out C.json",
)
def envelope(parser: argparse.ArgumentParser) -> None:
    inner = cli.number("a share above 0.5 and below 1", lambda value: 0.5 < value < 1.0)
    add, count = parser.add_argument, cli.not_negative
    add("--out", required=True, metavar="F.json", type="path", help="what is found")
    add("--policy", metavar="P.onnx", help="(default: results/policies/ENV.onnx)")
    add_public_key(parser)
    add("--env", help="scenario, gymnasium id or module:id (default: the file's, else left_turn)")
    add("--condition", choices=CONDITIONS, default="nominal", help="of the scene")
    add("--promise", type=inner, default=0.95, help="share of successes")
    add("--confidence", type=inner, default=0.95, help="of each axis's limit")
    add("--seed", type=count, default=0, help="of the first drive")
    add("--jobs", type=count, default=0, help="processes that drive; 0: one a core")
    confirms = "drive just inside and outside of this file's edges, with fresh seeds; scene and "
    confirms += "promise are the file's"
    add("--confirm", metavar="F.json", type="path", help=confirms)
    add("--runs", type=cli.positive, default=500, help="drives that confirm a network")
