"""The commands of ``python -m trainer``: their options, and where what runs them is.

That loads torch, matplotlib or rerun, which take seconds; ``--help`` need not wait for them.
"""

import argparse
from typing import Any

from bridge.fork import add_place
from bridge.rerun import add_sink
from edge_runtime import cli
from edge_runtime.cli import add_public_key, command
from trainer import options
from trainer.environments import CONDITIONS
from trainer.experiments import plan
from trainer.human.config import FIELDS, HumanModelConfig
from trainer.learner.config import ALGORITHMS
from trainer.person.interface import HUMANS, add_person
from trainer.training.config import CURVE_FILE, EXTENT, PRESETS, RunConfig
from trainer.util import PERIOD_S, kept

DEFAULTS = RunConfig()


@command(
    "trainer.training.command:run",
    "python -m trainer train --scenario left_turn --steps 4000 --out runs/phil_1",
    "python -m trainer train --resume --out runs/phil_1",
    "python -m trainer train --steps 8000 --out runs/phil_1 --resume",
    "python -m trainer train --human web --rerun mine.rrd --out runs/mine",
    "python -m trainer train --scenario congestion --algorithm phil_td3 --seed 1 \\\n"
    "    --human runs/human_congestion --set batch_size=64 --max-minutes 30 --out runs/phil_2",
    "python -m trainer train --set    # lists the settings",
)
def train(parser: argparse.ArgumentParser) -> None:
    parser.register("action", None, _Noted)
    what = parser.add_argument_group("what is trained")
    add = what.add_argument
    options.add_scenario(what)
    rows = f"the learner: {', '.join(ALGORITHMS)}, one of an installed package, or module:ROW"
    add("--algorithm", default=DEFAULTS.algorithm, metavar="NAME", help=rows)
    options.add_seed(what, "everything that is drawn at random")
    options.add_fields(what, DEFAULTS, *EXTENT)
    start = "the settings to start from: this project's, or the paper's as they are printed"
    add("--preset", choices=list(PRESETS), default="ours", help=start)
    file = "take options and settings from this file, as a run's own config.toml; options on "
    file += "the command line win, but no setting may come from both"
    add("--config", metavar="F.toml", help=file)
    change = "change a setting, as often as you like; without a value: list all with their "
    change += "defaults and meanings"
    add("--set", action=_Set, nargs="?", default=[], metavar="NAME=VALUE", help=change)
    add(
        "--period", action=_Set, dest="set", default=[], metavar="SECONDS",
        type=lambda text: f"period_s={cli.positive_number(text)}",
        help="seconds of a step (default: what the environment says, else its render_fps, else"
        f" {PERIOD_S})",
    )  # fmt: skip
    options.add_latency(what, "the network between policy and vehicle, also in validation")
    guide = parser.add_argument_group("the human")
    whose = f"expert|module:Class|HUMAN_DIR|{'|'.join(HUMANS)}"
    known = "the scripted expert, a model trained by `trainer human`, or you"
    guide.add_argument("--human", default=DEFAULTS.human, metavar=whose, help=known)
    add_person(parser)
    how = parser.add_argument_group("the run")
    how.add_argument("--out", required=True, metavar="RUN_DIR", help="the directory of the run")
    on = "go on from RUN_DIR's checkpoint, with its options"
    how.add_argument("--resume", action="store_true", help=on)
    options.add_time_limit(how, "stop after the episode that passes this time")
    options.add_device(how)
    options.add_threads(how)
    shown = "show the run in rerun: in a window, on a page on this machine, or into a file"
    how.add_argument("--rerun", metavar="spawn|serve|F.rrd", help=shown)


class _Noted(argparse._StoreAction):
    """Stores an option's value, and that it was given: such a value wins over ``--config``."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: str | None = None) -> None:
        super().__call__(parser, namespace, values, option)
        namespace.given = {*getattr(namespace, "given", ()), self.dest}


class _Set(argparse.Action):
    """``--set NAME=VALUE``, collected; ``--set`` alone lists the settings, as --help does options.

    Other options need not be there for that.
    """

    def __call__(self, parser: Any, namespace: Any, value: Any, option: str | None = None) -> None:
        if value is None:
            from trainer.training.command import setting_lines

            print("\n".join(setting_lines()))
            parser.exit()
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), value])


@command(
    "trainer.person.session:run",
    "python -m trainer drive --out runs/drives",
    "python -m trainer drive --policy runs/phil_1 --out runs/drives",
    "python -m trainer drive --from drive.mcap --at 3s --out runs/drives",
)
def drive(parser: argparse.ArgumentParser) -> None:
    options.add_scenario(parser, "what was recorded")
    add = parser.add_argument
    device = "what your hands are on: the browser takes keyboard, touch, gamepad and wheel"
    add("--human", "--device", dest="human", choices=HUMANS, default=HUMANS[0], help=device)
    driver = "what drives until you take over: see `trainer evaluate` (default: you drive alone)"
    add("--policy", metavar="POLICY", help=driver)
    add_public_key(parser)
    forked = "each episode repeats this recorded drive until --at, and goes on from there"
    add("--from", dest="recording", metavar="F.mcap", type="path", help=forked)
    add_place(parser)
    out = "the directory of the recordings; sittings add up there"
    add("--out", metavar="REC_DIR", type="path", default="runs/drives", help=out)
    add("--episodes", type=cli.positive, metavar="N", help="stop after so many (default: no end)")
    options.add_seed(parser, "the episodes, which are others in every sitting")
    add_person(parser)
    options.add_threads(parser)


@command(
    "trainer.human.dagger:run",
    "python -m trainer human --scenario left_turn --out runs/human",
    "python -m trainer human --scenario congestion --frames 2 --out runs/human_congestion",
    "python -m trainer human --from runs/drives --out runs/me",
)
def human(parser: argparse.ArgumentParser) -> None:
    options.add_scenario(parser)
    add = parser.add_argument
    add("--out", required=True, metavar="HUMAN_DIR", type="path", help="the directory of the model")
    options.add_seed(parser, "everything that is drawn at random")
    options.add_fields(parser, HumanModelConfig(), *FIELDS)
    person = "imitate a person: recordings of `trainer drive` or of `trainer train` with a person, "
    person += "their directories, or such a training run (default: the scripted expert)"
    add("--from", dest="recordings", nargs="+", metavar="RECORDING", type="path", help=person)
    last = "begin no episode after this time; the refining steps shrink in proportion to the "
    options.add_time_limit(parser, f"{last}episodes")
    options.add_threads(parser)


@command(
    "trainer.evaluation:run",
    "python -m trainer evaluate expert --runs 20",
    "python -m trainer evaluate constant:0 --scenario congestion",
    "python -m trainer evaluate runs/phil_1 --runs 50 --out result.json",
    "python -m trainer evaluate runs/phil_1 --condition variant --latency 50ms+-10ms,loss=1%",
)
def evaluate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    policy = "an .onnx file, a RUN_DIR, a HUMAN_DIR, the word expert, module:Class of another one, "
    policy += "or constant:ACTION for one action from -1 to 1 throughout"
    add("policy", metavar="POLICY", help=policy)
    add_public_key(parser)
    options.add_scenario(parser, "what the policy was trained in")
    scenes = "; ".join(f"{name}: {what.meaning}" for name, what in CONDITIONS.items())
    scenes = scenes.replace("%", "%%")
    add("--condition", choices=CONDITIONS, default="nominal", help=scenes)
    options.add_latency(parser, "the network between policy and vehicle")
    count = "how many episodes are driven"
    add("--runs", type=cli.positive, default=50, metavar="N", help=count)
    options.add_seed(parser, "the first episode; each next one has one more")
    out = "write the report, with each episode, to this file instead of printing it"
    add("--out", metavar="R.json", type="path", help=out)


@command(
    "trainer.policy_file:run",
    "python -m trainer export runs/phil_1 --out left_turn.onnx --key keys/policy.key",
)
def export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run_dir", metavar="RUN_DIR", help="the directory of a training run")
    options.add_scenario(parser, "what the run was trained in")
    parser.add_argument("--out", required=True, metavar="POLICY.onnx", help="the policy file")
    parser.add_argument("--key", metavar="KEY", help="the private key (PEM) to sign it with")


@command(
    "trainer.view:run",
    "python -m trainer view runs/drives --serve",
    "python -m trainer view runs/mine/sittings/sitting-0001.mcap --save sitting.rrd",
)
def view(parser: argparse.ArgumentParser) -> None:
    what = "sitting-NNNN.mcap, a directory of such, or a run that a person guided"
    parser.add_argument("recordings", metavar="RECORDING", type="path", nargs="+", help=what)
    add_sink(parser)


@command(
    "trainer.bench:run",
    "python -m trainer bench --quick --threads 1",
    "python -m trainer bench --threads 2 --out b.json",
)
def bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="R.json", help="also write the figures to this file")
    parser.add_argument("--quick", action="store_true", help="take few rounds: a look only")
    options.add_threads(parser)


@command(
    "trainer.experiments.command:run",
    "python -m trainer experiment status",
    "python -m trainer experiment fig7 fig9 --jobs 2 --max-minutes 60",
    "python -m trainer experiment all --scenario congestion",
    "python -m trainer experiment report",
    "python -m trainer experiment guidance --max-minutes 60",
    "python -m trainer experiment status guidance",
)
def experiment(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("what is computed").add_argument
    words = (
        f"compute the missing runs of {', '.join(plan.EXPERIMENTS)} or all (the paper's), or of "
        "the guidance table, and write the page; status (of guidance): count the finished runs; "
        "report: write the paper's page from the runs that there are; typical: write the curves "
        "that the coach of the cockpit shows"
    )
    known = [*plan.EXPERIMENTS, *plan.WORDS, *plan.STUDIES]
    add("names", nargs="+", metavar="NAME", choices=known, help=words)
    seeds = "trainings of each algorithm in each setting"
    add("--seeds", type=cli.whole_number(1, 1000), default=plan.DEFAULT_SEEDS, help=seeds)
    one = f"compute this task only (default: all; {', '.join(plan.FOREIGN)}: of guidance)"
    add("--scenario", choices=[*plan.SCENARIOS, *plan.FOREIGN], help=one)
    quick = "train for a few steps, in RUNS/quick: a trial whose numbers mean nothing"
    add("--quick", action="store_true", help=quick)
    how = parser.add_argument_group("how it is computed")
    jobs = "processes of one thread each; 0: one for each core"
    how.add_argument("--jobs", type=cli.not_negative, default=0, metavar="N", help=jobs)
    ray = "compute on a Ray cluster instead of this machine: HOST:PORT, auto or local"
    how.add_argument("--ray", metavar="ADDRESS", help=ray)
    options.add_device(how)
    last = "stop every run after its next episode once this time is over; the same command resumes"
    options.add_time_limit(how, last)
    where = parser.add_argument_group("where it is kept")
    for option, default, text in (
        ("--results", None, "tables, figures and page (default: results/paper, or "
         "results/guidance; typical: the directory of both, results)"),
        ("--runs", None, "checkpoints and actors (default: runs/paper, or runs/guidance)"),
        ("--humans", kept("results/humans/paper"),
         "holds the human model of each scenario: DIR/left_turn, DIR/congestion"),
    ):  # fmt: skip
        where.add_argument(option, default=default, metavar="DIR", help=text)


@command(
    "trainer.pictures:run",
    "python -m trainer plot runs/phil_1",
    "python -m trainer plot runs/phil_1 runs/phil_2 runs/phil_3 --out curves.png",
)
def plot(parser: argparse.ArgumentParser) -> None:
    runs = "directory of a training run; several are drawn thinly, and their mean"
    parser.add_argument("run_dirs", metavar="RUN_DIR", nargs="+", help=runs)
    out = f"the picture (default: RUN_DIR/{CURVE_FILE})"
    parser.add_argument("--out", type=_png, metavar="F.png", help=out)


def _png(out: str) -> str:
    if not out.endswith(".png"):
        raise argparse.ArgumentTypeError(f"{out}: a picture is a .png")
    return out
