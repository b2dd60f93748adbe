"""Run the paper's experiments and hold their results against its claims; or compare guidance."""

import argparse
import time
from pathlib import Path

from edge_runtime.util import UserError
from trainer.experiments import plan
from trainer.experiments.guidance import write_guidance, write_typical
from trainer.experiments.plan import ALL, FOREIGN, GUIDANCE, REPORT, STATUS, TYPICAL
from trainer.experiments.report import write_report
from trainer.experiments.run import FAILED, FINISHED, Store, Task, run_on_ray, run_units, say
from trainer.options import check_device, deadline_s
from trainer.person.coach import TYPICAL_FILE
from trainer.util import cores, kept


def run(arguments: argparse.Namespace) -> int:
    """Compute, say how much is done, or report; returns the exit status."""
    names = list(dict.fromkeys(arguments.names))
    alone = {STATUS, REPORT, GUIDANCE, TYPICAL} & set(names)
    if len(names) > 1 and alone and set(names) != {STATUS, GUIDANCE}:
        raise UserError(
            f"{STATUS}, {REPORT}, {GUIDANCE} and {TYPICAL} stand alone, or {STATUS} with {GUIDANCE}"
        )
    if names == [TYPICAL]:
        results = Path(arguments.results or kept("results"))
        write_typical(results, Path(arguments.humans), arguments.seeds, TYPICAL_FILE)
        print(f"wrote {TYPICAL_FILE}")
        return 0
    work, quick, place = plan.PLAN, plan.QUICK, "paper"
    if GUIDANCE in names:
        work, quick, place = plan.GUIDANCE_PLAN, plan.QUICK_GUIDANCE, GUIDANCE
    results = Path(arguments.results or kept(f"results/{place}"))
    runs, humans = Path(arguments.runs or kept(f"runs/{place}")), Path(arguments.humans)
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
