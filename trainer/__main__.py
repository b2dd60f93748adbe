"""``python -m trainer``: its commands, their options, and the function that runs each.

The function is imported only when it runs: torch, matplotlib and rerun take seconds to load.
"""

import argparse
import ast
import inspect
import re
import sys
from itertools import pairwise
from typing import Any

from bridge.environments import scenarios
from bridge.fork import add_place
from bridge.ports import add_options
from edge_runtime import cli
from edge_runtime.cli import Subcommand, add_public_key, command, program, run_cli
from trainer import experiments as plan
from trainer.environments import CONDITIONS
from trainer.human import FIELDS, HumanModelConfig
from trainer.learner.config import LearnerConfig
from trainer.person import HUMANS, add_person
from trainer.training.config import (
    CURVE_FILE,
    DEFAULTS,
    EXTENT,
    MOST_THREADS,
    PRESETS,
    SETTINGS,
    TYPED,
    RunConfig,
)
from trainer.util import DEVICES, PERIOD_S, kept

Group = argparse.ArgumentParser | argparse._ArgumentGroup
MOST_SEEDS = 1000


@command(
    "trainer.training.command:run",
    "python -m trainer train --scenario left_turn --steps 4000 --out runs/phil_1",
    "python -m trainer train --steps 8000 --out runs/phil_1 --resume",
    "python -m trainer train --human web --out runs/mine",
    "python -m trainer train --set    # lists the settings",
)
def train(parser: argparse.ArgumentParser) -> None:
    what = parser.add_argument_group("what to train")
    add = what.add_argument
    add_scenario(what)
    add_fields(what, DEFAULTS, algorithm="NAME")
    one_or_several = what.add_mutually_exclusive_group()
    add_options(one_or_several, "--seed")
    several = "train a run for each seed, such as 1-5, side by side, in RUN_DIR/seed_N"
    one_or_several.add_argument("--seeds", type=seeds, metavar="FIRST-LAST", help=several)
    add_fields(what, DEFAULTS, **dict.fromkeys(EXTENT, "N"), success="MODULE:FUNCTION")
    start = "settings to start from: this project's, or those printed in the paper"
    add("--preset", choices=list(PRESETS), default="ours", help=start)
    change = "change a setting; may be repeated; --set alone lists all settings with their "
    change += "defaults and meanings"
    add("--set", action=_Set, nargs="?", default=[], metavar="NAME=VALUE", help=change)
    add(
        "--period", action=_Set, dest="set", default=[], metavar="SECONDS",
        type=lambda text: f"period_s={cli.positive_number(text)}",
        help="control period, s (default: the environment's own; else 1 / render_fps; else"
        f" {PERIOD_S})",
    )  # fmt: skip
    add_options(what, "--latency", type=str)
    guide = parser.add_argument_group("who guides")
    whose = f"expert|MODULE:CLASS|HUMAN_DIR|{'|'.join(HUMANS)}"
    add_fields(guide, DEFAULTS, human=whose, demonstrations="PATH")
    add_person(parser)
    how = parser.add_argument_group("the run")
    how.add_argument("--out", required=True, metavar="RUN_DIR", help="directory of the run")
    on = "continue from the last checkpoint in RUN_DIR with the run's own options"
    how.add_argument("--resume", action="store_true", help=on)
    add_time_limit(how, "stop after this many minutes, at the end of the running episode")
    add_device(how)
    add_threads(how)
    for action in parser._actions:
        if action.dest in TYPED:  # Only typed options override the config of a resumed run.
            default = "none" if action.default == "" else action.default
            action.help = f"{action.help} (default: {default})"
            action.default = argparse.SUPPRESS


def _range(text: str) -> range:
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def _in_reason(seeds: range) -> bool:
    return 0 < seeds.stop - seeds.start <= MOST_SEEDS


seeds = cli.within(_range, f"a range of 1 to {MOST_SEEDS} seeds, such as 1-5", _in_reason)


class _Set(argparse.Action):
    """Collects ``--set NAME=VALUE``; ``--set`` alone lists the settings."""

    def __call__(self, parser: Any, namespace: Any, value: Any, option: str | None = None) -> None:
        if value is None:
            texts = meanings(RunConfig) | meanings(LearnerConfig)
            for name, default in SETTINGS.items():
                print(f"{f'{name}={default}':<35} {texts.get(name, '')}")
            parser.exit()
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), value])


@command(
    "trainer.person.session:run",
    "python -m trainer drive --out runs/drives",
    "python -m trainer drive --from drive.mcap --at 3s --out runs/drives",
)
def drive(parser: argparse.ArgumentParser) -> None:
    add_scenario(parser, "the scenario of the recording")
    add = parser.add_argument
    device = "how you drive: in the browser, with keyboard, touch, gamepad or wheel"
    add("--human", "--device", dest="human", choices=HUMANS, default=HUMANS[0], help=device)
    driver = "policy that drives until you take over, as in `trainer evaluate` (default: none)"
    add("--policy", metavar="POLICY", help=driver)
    add_public_key(parser)
    forked = "repeat this recorded drive until --at, then drive on from there, in each episode"
    add("--from", dest="recording", metavar="F.mcap", type="path", help=forked)
    add_place(parser)
    out = "directory of the recordings; each run of this command adds one file"
    add("--out", metavar="REC_DIR", type="path", default="runs/drives", help=out)
    number = "number of episodes (default: no end)"
    add("--episodes", type=cli.positive, metavar="N", help=number)
    add_options(parser, "--seed", help="seed; each run of this command drives other episodes")
    add_person(parser)
    add_threads(parser)


@command(
    "trainer.human.model:run",
    "python -m trainer human --scenario left_turn --out runs/human",
    "python -m trainer human --from runs/drives --out runs/me",
)
def human(parser: argparse.ArgumentParser) -> None:
    add_scenario(parser)
    add = parser.add_argument
    add("--out", required=True, metavar="HUMAN_DIR", type="path", help="directory of the model")
    add_options(parser, "--seed")
    add_fields(parser, HumanModelConfig(), **dict.fromkeys(FIELDS, "N"))
    person = "imitate a person: recordings of `trainer drive` or of `trainer train` with a person, "
    person += "their directories, or such a training run (default: imitate the scripted expert)"
    add("--from", dest="recordings", nargs="+", metavar="RECORDING", type="path", help=person)
    last = "begin no episode after this many minutes; the refining steps shrink in proportion"
    add_time_limit(parser, last)
    add_threads(parser)


@command(
    "trainer.evaluation:run",
    "python -m trainer evaluate runs/phil_1 --runs 50 --out result.json",
    "python -m trainer evaluate runs/phil_1 --condition variant --latency 50ms+-10ms,loss=1%",
)
def evaluate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    policy = "an .onnx file, a RUN_DIR, a HUMAN_DIR, expert, your own expert as "
    policy += "MODULE:CLASS, or constant:ACTION, the same action from -1 to 1 in every step"
    add("policy", metavar="POLICY", help=policy)
    add_public_key(parser)
    add_scenario(parser, "the scenario of the policy's training")
    scenes = "; ".join(f"{name}: {what.meaning}" for name, what in CONDITIONS.items())
    scenes = scenes.replace("%", "%%")
    add("--condition", choices=CONDITIONS, default="nominal", help=scenes)
    add_options(parser, "--latency", type=str)
    add_fields(parser, DEFAULTS, success="MODULE:FUNCTION")
    count = "number of episodes"
    add("--runs", type=cli.positive, default=50, metavar="N", help=count)
    add_options(parser, "--seed", help="seed of the first episode; each next episode adds 1")
    out = "write the report with the results of each episode to this file instead of stdout"
    add("--out", metavar="R.json", type="path", help=out)
    add("--video", metavar="F.mp4", type="path", help="film the episodes, as they look to a person")
    shown = "show the episodes in the rerun viewer: spawn opens a window, serve a page on this "
    shown += "machine, F.rrd is a file to write"
    add("--rerun", metavar="spawn|serve|F.rrd", help=shown)


@command(
    "trainer.policy_file:run",
    "python -m trainer export runs/phil_1 --out left_turn.onnx --key keys/policy.key",
)
def export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run_dir", metavar="RUN_DIR", help="directory of a training run")
    add_scenario(parser, "the scenario of the run")
    parser.add_argument("--out", required=True, metavar="POLICY.onnx", help="policy file to write")
    parser.add_argument("--key", metavar="KEY", help="private key (PEM) that signs the policy")


@command("trainer.bench:run", "python -m trainer bench --threads 2 --out b.json")
def bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="R.json", help="also write the figures to this file")
    add_threads(parser)
    add_device(parser)


@command(
    "trainer.experiments.compute:run",
    "python -m trainer experiment status",
    "python -m trainer experiment fig7 fig9 --jobs 2 --max-minutes 60",
    "python -m trainer experiment guidance --max-minutes 60",
)
def experiment(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("what is computed").add_argument
    words = (
        f"compute the missing runs of {', '.join(plan.EXPERIMENTS)} or all (the paper's), or of "
        "the guidance table, and write the page; status (of guidance): count the finished runs; "
        "report: write the paper's page from the runs that there are"
    )
    known = [*plan.EXPERIMENTS, "all", "status", "report", *plan.STUDIES]
    add("names", nargs="+", metavar="NAME", choices=known, help=words)
    seeds = "trainings of each algorithm in each setting"
    add("--seeds", type=cli.whole_number(1, MOST_SEEDS), default=plan.DEFAULT_SEEDS, help=seeds)
    add("--scenario", choices=list(plan.TASKS), help="compute this task only (default: all)")
    add("--algorithm", choices=list(plan.LABELS), metavar="NAME", help="and this row only")
    settings = "and these settings only"
    add("--setting", nargs="+", choices=list(plan.SETTINGS), metavar="NAME", help=settings)
    quick = "train for a few steps, in RUNS/quick: a trial whose numbers mean nothing"
    add("--quick", action="store_true", help=quick)
    how = parser.add_argument_group("how it is computed")
    jobs = "processes of one thread each; 0: one for each core"
    how.add_argument("--jobs", type=cli.not_negative, default=0, metavar="N", help=jobs)
    ray = "compute on a Ray cluster instead of this machine: HOST:PORT, auto or local"
    how.add_argument("--ray", metavar="ADDRESS", help=ray)
    add_device(how)
    last = (
        "stop every run at the end of its episode after this many minutes; the same command resumes"
    )
    add_time_limit(how, last)
    where = parser.add_argument_group("where it is kept")
    results = "tables, figures and page (default: results/paper, or results/guidance)"
    where.add_argument("--results", metavar="DIR", help=results)
    runs = "checkpoints and actors (default: runs/paper, or runs/guidance)"
    where.add_argument("--runs", metavar="DIR", help=runs)
    models, place = "holds a human model: DIR/left_turn, DIR/congestion", "results/humans/paper"
    where.add_argument("--humans", default=kept(place), metavar="DIR", help=models)


@command(
    "trainer.training.curves:run",
    "python -m trainer plot runs/phil_1 runs/phil_2 runs/hi_1 runs/hi_2 --out curves.png",
)
def plot(parser: argparse.ArgumentParser) -> None:
    runs = "directory of a training run, or of several; runs of one algorithm are drawn as their "
    runs += "mean, with its 95 %% interval"
    parser.add_argument("run_dirs", metavar="RUN_DIR", nargs="+", help=runs)
    over = "draw over environment steps, or over the seconds that the human has driven"
    parser.add_argument("--x", choices=["steps", "human_s"], default="steps", help=over)
    out = f"picture to write (default: RUN_DIR/{CURVE_FILE})"
    parser.add_argument("--out", metavar="F.png", help=out)


def add_scenario(parser: Group, known: str = "") -> None:
    """Add ``--scenario``; ``known`` describes a default that is not ``left_turn``."""
    text = f"environment: {', '.join(scenarios())}, a gymnasium id such as Pendulum-v1, "
    text += "or MODULE:ID (MODULE is imported first)"
    text += f" (default: {known}, else left_turn)" if known else ""
    default = None if known else "left_turn"
    parser.add_argument("--scenario", default=default, metavar="NAME", help=text)


def add_threads(parser: Group) -> None:
    text = "processor threads for PyTorch; 0: PyTorch decides"
    kind = cli.whole_number(0, MOST_THREADS)
    parser.add_argument("--threads", type=kind, default=0, metavar="N", help=text)


def add_time_limit(parser: Group, what: str) -> None:
    text = f"{what} (default: no limit)"
    parser.add_argument("--max-minutes", type=cli.positive_number, metavar="MIN", help=text)


def add_fields(parser: Group, config: Any, **metavars: str) -> None:
    """Add an option for each named field of a config; the config checks the ranges."""
    texts = meanings(type(config))
    for name, metavar in metavars.items():
        option, default = f"--{name.replace('_', '-')}", getattr(config, name)
        kind = cli.not_negative if isinstance(default, int) else str
        how: dict[str, Any] = {"type": kind, "default": default, "metavar": metavar}
        if isinstance(default, bool):
            how = {"action": "store_true"}
        parser.add_argument(option, help=texts[name].removeprefix("whether "), **how)


def meanings(config: type) -> dict[str, str]:
    """Return the first sentence of each field's docstring, by the field's name."""
    (definition,) = ast.parse(inspect.getsource(config)).body
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for field, text in pairwise(definition.body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            assert isinstance(field.target, ast.Name)
            docstring = " ".join(ast.literal_eval(text.value).replace("``", "").split())
            sentence = re.split(r"\. (?=[A-Z(])|\.$", docstring)[0]
            is_word = sentence[1:2].islower() or sentence[1:2] == " "
            texts[field.target.id] = sentence[0].lower() + sentence[1:] if is_word else sentence
    return texts


def add_device(parser: Group) -> None:
    text = "device of the neural networks"
    parser.add_argument("--device", choices=DEVICES, default=DEVICES[0], help=text)


COMMANDS: dict[str, tuple[Subcommand, str]] = {
    "train": (train, "train a policy with human guidance"),
    "drive": (drive, "drive yourself, or take over from a policy; recorded"),
    "human": (human, "train the human model from interventions (DAgger)"),
    "evaluate": (evaluate, "drive test episodes with a policy and report its success"),
    "export": (export, "write the policy file of a training run"),
    "plot": (plot, "draw the learning curve of training runs"),
    "bench": (bench, "measure the speed of learner, environments and training"),
    "experiment": (experiment, "run the paper's experiments or another table"),
}

main = program(
    "python -m trainer",
    "Trains driving policies with human guidance, evaluates and exports them.",
    COMMANDS,
    "python -m trainer train --scenario left_turn --episodes 120 --out runs/phil_1",
    "python -m trainer evaluate runs/phil_1 --runs 50",
)

if __name__ == "__main__":
    sys.exit(run_cli(main))
