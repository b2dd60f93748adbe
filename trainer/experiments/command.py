"""Run the paper's experiments and hold their results against its claims; or compare guidance."""

import argparse
import time
from pathlib import Path

from edge_runtime.cli import examples, not_negative, whole_number
from edge_runtime.util import UserError
from trainer.experiments import plan
from trainer.experiments.guidance import write_guidance, write_typical
from trainer.experiments.plan import EXPERIMENTS, FOREIGN, GUIDANCE
from trainer.experiments.report import write_report
from trainer.experiments.run import FAILED, FINISHED, Store, Task, run_on_ray, run_units, say
from trainer.options import add_device, add_time_limit, check_device, deadline_s
from trainer.person.coach import TYPICAL_FILE
from trainer.util import cores

EXAMPLE = examples(
    "python -m trainer experiment status",
    "python -m trainer experiment fig7 fig9 --jobs 2 --max-minutes 60",
    "python -m trainer experiment all --scenario congestion",
    "python -m trainer experiment report",
    "python -m trainer experiment guidance --max-minutes 60",
    "python -m trainer experiment status guidance",
)
ALL, STATUS, REPORT, TYPICAL = "all", "status", "report", "typical"
MOST_SEEDS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    what = parser.add_argument_group("what is computed")
    what.add_argument(
        "names",
        nargs="+",
        metavar="NAME",
        choices=[*EXPERIMENTS, ALL, STATUS, REPORT, GUIDANCE, TYPICAL],
        help=f"compute what {', '.join(EXPERIMENTS)} or {ALL} of them need, and report; {STATUS}: "
        f"how much is done; {REPORT}: draw the figures and judge the claims from what is done; "
        f"{GUIDANCE}: "
        "compute and report the table of human guidance, which is not the paper's, or with "
        f"{STATUS} how much of it is done; "
        f"{TYPICAL}: write the curves that a person's coach shows, from both tables' records",
    )
    what.add_argument(
        "--seeds",
        type=whole_number(1, MOST_SEEDS),
        default=plan.DEFAULT_SEEDS,
        help="trainings of each algorithm in each setting; the page tells of these alone",
    )
    what.add_argument(
        "--scenario",
        choices=[*plan.SCENARIOS, *FOREIGN],
        help=f"compute this one only (default: all; {', '.join(FOREIGN)}: of {GUIDANCE})",
    )
    what.add_argument(
        "--quick",
        action="store_true",
        help="a few steps of everything, kept in RUNS/quick: a look whose numbers mean nothing",
    )
    how = parser.add_argument_group("how it is computed")
    how.add_argument(
        "--jobs",
        type=not_negative,
        default=0,
        metavar="N",
        help="processes of one thread each; 0: one a core",
    )
    how.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="compute on a Ray cluster instead of this machine: HOST:PORT, auto or local",
    )
    add_device(how)
    add_time_limit(
        how,
        "begin nothing after this time, and stop what runs after its next episode; the same "
        "command goes on from there",
    )
    where = parser.add_argument_group("where it is kept")
    for option, default, text in (
        ("--results", None, f"records, figures and report (default: results/paper, or "
         f"results/{GUIDANCE}; {TYPICAL}: the directory of both, results)"),
        ("--runs", None, f"checkpoints and actors (default: runs/paper, or runs/{GUIDANCE})"),
        ("--humans", "results/humans/paper",
         "holds the human model of each scenario: DIR/left_turn, DIR/congestion"),
    ):  # fmt: skip
        where.add_argument(option, default=default, metavar="DIR", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Compute, say how much is done, or report; returns the exit status."""
    names = list(dict.fromkeys(arguments.names))
    alone = {STATUS, REPORT, GUIDANCE, TYPICAL} & set(names)
    if len(names) > 1 and alone and set(names) != {STATUS, GUIDANCE}:
        raise UserError(
            f"{STATUS}, {REPORT}, {GUIDANCE} and {TYPICAL} stand alone, or {STATUS} with {GUIDANCE}"
        )
    if names == [TYPICAL]:
        results = Path(arguments.results or "results")
        write_typical(results, Path(arguments.humans), arguments.seeds, TYPICAL_FILE)
        print(f"wrote {TYPICAL_FILE}")
        return 0
    work, quick, place = plan.PLAN, plan.QUICK, "paper"
    if GUIDANCE in names:
        work, quick, place = plan.GUIDANCE_PLAN, plan.QUICK_GUIDANCE, GUIDANCE
    results = Path(arguments.results or f"results/{place}")
    runs, humans = Path(arguments.runs or f"runs/{place}"), Path(arguments.humans)
    store = Store(work, results, runs, humans)
    if arguments.quick:
        store = Store(quick, runs / "quick" / "results", runs / "quick", humans)
    if STATUS in names:
        counted = GUIDANCE if GUIDANCE in names else ALL
        print("\n".join(store.status_lines(counted, arguments.seeds, arguments.scenario)))
        return 0
    if names == [REPORT]:
        print(f"wrote {write_report(store, arguments.seeds)}")
        return 0
    if arguments.ray and arguments.device != "cpu":
        raise UserError("--ray computes on processors: leave out --device")
    check_device(arguments.device)
    wanted = plan.units_of(names, arguments.seeds, arguments.scenario)
    if not wanted:
        raise UserError(f"{', '.join(names)}: nothing to compute in {arguments.scenario}")
    if arguments.ray and any(unit.scenario in FOREIGN for unit in wanted):
        kinds = " or ".join(plan.SCENARIOS)
        raise UserError(f"--ray lacks {', '.join(FOREIGN)}: compute one with --scenario {kinds}")
    possible = [unit for unit in wanted if plan.is_possible(unit, humans)]
    if left_out := len(wanted) - len(possible):
        say(f"{left_out} units left out: {humans} holds no human model of their scenario")
    done, _ = store.find(possible)
    # The clock that the processes have, too.
    stop_at_s = deadline_s(arguments.max_minutes, time.time)
    left = [Task(unit, store, stop_at_s, arguments.device) for unit in possible if unit not in done]
    if left and arguments.ray:
        ends = run_on_ray(left, arguments.ray)
    else:
        ends = run_units(left, arguments.jobs or cores())
    said = "".join(f", {count} {end}" for end, count in ends.items())
    print(f"{len(done)} of {len(wanted)} units were there already{said}")
    if ends[FINISHED] < len(left):
        print("the same command goes on")
    if store.find(possible)[0]:
        write = write_guidance if names == [GUIDANCE] else write_report
        print(f"wrote {write(store, arguments.seeds)}")
    return 1 if ends[FAILED] else 0
