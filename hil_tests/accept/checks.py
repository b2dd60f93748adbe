"""The table of checks: each tests one property of policy, link, vehicle or board."""

from __future__ import annotations

import contextlib
import shlex
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from bridge import replay as replaying
from bridge.environments import NOMINAL
from bridge.network import LatencySpec
from bridge.outcomes import GOAL, Estimate, success_estimate
from bridge.recording import Recording, valid_messages
from deploy.bundle import UNATTENDED
from edge_runtime.config import BUILT_IN, NONE, Config
from edge_runtime.policy import Policy
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError, counted, parse_json, read_json
from edge_runtime.wire import Command
from hil_tests.campaign import missed_in
from hil_tests.envelope import Drivers, UntoldError
from hil_tests.faults.rows import Row as Fault
from hil_tests.faults.run import ROWS, run_faults
from hil_tests.processes import Process, operator
from trainer.evaluation import NO_NETWORK, evaluate
from trainer.util import fitting

SIGNATURE, INFERENCE = GATES = ("signature and manifest", "inference time")
"""A policy that fails in one of these is not driven."""
DRIVE, DRIVE_FILE, VEHICLE_ID = "link: round trip in real time", "drive.mcap", "accept"
DISTURBED_TRIES = 3
START_S, EPISODE_S, CHECK_S, CONFORMANCE_S = 60.0, 120.0, 300.0, 600.0  # At most
AXES = {"delay": ("delay_ms", 1000.0, 25.0, "ms"), "loss": ("loss_percent", 50.0, 1.0, "%")}
"""Network axes, worsened each way: setting, largest value tried, resolution, unit."""
REALTIME = ("--clock", "realtime", "--latency")


class Found(NamedTuple):
    """A check's measurement, and its failure (empty if it passed), in words."""

    measured: str
    wrong: str = ""
    data: dict[str, Any] | None = None  # For the page


class Check(NamedTuple):
    """A row of the table. A UserError of ``run`` fails it; UntoldError: it cannot be tried."""

    name: str
    asked: str
    takes_s: float  # About, on two idle cores
    run: Callable[[Job], Found]
    skipped: str = ""  # Why it is not tried


@dataclass
class Job:
    """The policy to judge and how. ``policy`` is None if it may not drive; ``refusal`` says why."""

    asked: Namespace
    settings: Any  # The keys of accept.toml
    path: Path  # DIR
    policy_id: str
    policy: Policy | None
    refusal: str
    config: Config  # With the vehicle
    trust: list[str]  # Options of a command that reads the policy

    @property
    def period_s(self) -> float:
        return self.policy.manifest.control_period_s if self.policy else 0.0

    @property
    def edge(self) -> list[str]:
        return ["--config", self.settings.edge] if self.settings.edge else []

    def drivers(self, condition: str = NOMINAL) -> Drivers:
        return Drivers(self.asked.policy, self.asked.env, condition, self.asked.public_key, 0)

    def share(self, drivers: Drivers, link: LatencySpec) -> Estimate:
        """Return the success behind a network, in virtual time."""
        results = drivers.drive(link, range(self.settings.runs))
        return success_estimate(sum(each.outcome == GOAL for each in results), len(results))

    def drive(
        self, episodes: int, *more: object, record: Path | None = None, vehicle: str = NONE
    ) -> dict[str, Any]:
        """Drive over the wire, and return the simulator's report; an operator re-arms a vehicle."""
        out, endpoint = self.path / "drive.json", free_endpoint()
        us, env = ("--vehicle-id", VEHICLE_ID), ("--env", self.asked.env, "--period", self.period_s)
        simulate = ("bridge", "simulate", "--listen", endpoint, *us, *env, "--episodes", episodes)
        run = ("edge_runtime", "run", "--connect", endpoint, *us, "--policy", self.asked.policy)
        with contextlib.ExitStack() as stack:
            start = stack.enter_context
            simulator = start(Process(*simulate, "--out", out, *more))
            if record:
                record.unlink(missing_ok=True)
                to = ("--out", record, "--wait-s", START_S, "--connect", endpoint, *us)
                start(Process("bridge", "record", *to, ready="recording"))
            # Last, because its start begins the drive.
            start(Process(*run, *self.trust, *self.edge, "--vehicle", vehicle, ready="ready"))
            if vehicle != NONE:
                start(operator(endpoint, VEHICLE_ID))
            simulator.succeed(START_S + episodes * EPISODE_S)
        return read_json(out, "report")


def table(job: Job) -> list[Check]:
    """Return all checks in order; those of GATES come first."""
    ask, link, vehicle = job.settings, job.asked.link, job.config.vehicle
    unlinked = "no --link is declared" if link == NO_NETWORK else ""
    unnamed = "no --vehicle is named" if vehicle == NONE else ""
    share_s, points = 6.0 + 0.04 * ask.runs, 3 if job.asked.quick else 9
    replays = {"these drives": job.path / DRIVE_FILE, **{each: each for each in ask.recordings}}
    return [
        Check(SIGNATURE, "signed by the known key; manifest and graph agree", 1.0, trusted),
        Check(INFERENCE, f"p99 at most {ask.inference_share:g} T", 4.0, inference),
        Check("over the wire as in process", f"the same end of {counted(ask.wire_runs, 'drive')}",
              12.0 + 2.0 * ask.wire_runs, over_the_wire),
        *(Check(f"success, {condition}", at_least(least), share_s,
                partial(success, condition, NO_NETWORK, least))
          for condition, least in ask.success.items()),
        Check("link: success", at_least(ask.success_link), share_s,
              partial(success, NOMINAL, link, ask.success_link), unlinked),
        *(Check(f"link: distance to the limit of {axis}", f"{at_least(ask.success_link)} with"
                f" {getattr(ask, f'margin_{field}'):g} {unit} more each way", share_s * points,
                partial(distance, axis)) for axis, (field, _, _, unit) in AXES.items()),
        Check(DRIVE, f"p99 from state sent to command received at most {ask.round_trip_s:g} s",
              10.0 + 9.0 * ask.drives, in_real_time),
        *(Check(f"replay of {name}", "this policy made it, and answers as it did then", 4.0,
                partial(replay, path)) for name, path in replays.items()),
        Check("driver's conformance", "every rule kept", 30.0, conformance, unnamed),
        Check("drives with the vehicle", f"no fault; {at_least(ask.success_vehicle)} to the goal",
              10.0 + 12.0 * ask.vehicle_drives, with_vehicle, unnamed),
        *(Check(f"fault {row.name}", f"{row.done}: {row.expected}", 3.0 + 2.5 * ask.tries,
                partial(fault, row), left_out(row, job)) for row in ROWS),
    ]  # fmt: skip


def at_least(share: float) -> str:
    return f"at least {100 * share:g} %"


def trusted(job: Job) -> Found:
    return Found(job.policy.trust if job.policy else "refused", job.refusal)


def inference(job: Job) -> Found:
    """Run ``edge_runtime check`` here, or on the board by ssh with a copy of the policy."""
    command = [sys.executable, "-m", "edge_runtime", "check", job.asked.policy, *job.trust]
    if (board := job.asked.board) is not None:
        check = f"{shlex.quote(job.settings.board_command)} check $p --allow-unsigned"
        there = f"p=$(mktemp) && cat > $p && {check}; s=$?; rm -f $p; exit $s"
        command = ["ssh", *UNATTENDED, "--", board, there]
    try:
        policy = Path(job.asked.policy).read_bytes()
        done = subprocess.run(command, input=policy, capture_output=True, timeout=CHECK_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(str(error)) from None
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise UserError(last.removeprefix("error: ") or f"it ended with status {done.returncode}")
    with fitting("check reports no inference time"):
        times_ms = parse_json(done.stdout, "the report of check")["inference_ms"]
        p50_ms, p99_ms = (float(times_ms[name]) for name in ("p50", "p99"))
    most_ms = 1e3 * job.settings.inference_share * job.period_s
    measured = f"p50 {p50_ms:.2f}, p99 {p99_ms:.2f} ms on {board or 'this machine'}"
    return Found(measured, "" if p99_ms <= most_ms else f"that is over {most_ms:.0f} ms")


def over_the_wire(job: Job) -> Found:
    asked, count = job.asked, job.settings.wire_runs
    episodes = evaluate(asked.policy, asked.env, runs=count, public_key=asked.public_key).episodes
    for _ in range(DISTURBED_TRIES):
        report = job.drive(count)
        if not report["wall_clock_stalls"]:  # Otherwise this machine stalled.
            break
    here = [(each.outcome, each.steps) for each in episodes]
    there = [(each["outcome"], each["steps"]) for each in report["per_episode"]]
    ends = zip(range(count), there, here, strict=True)
    apart = [f"seed {seed}: {a} over the wire, {b} here" for seed, a, b in ends if a != b]
    return Found(f"{count - len(apart)} of {count}", "; ".join(apart))


def success(condition: str, link: LatencySpec, least: float, job: Job) -> Found:
    """Judge the share by the lower end of its interval."""
    try:
        drivers = job.drivers(condition)
    except UserError:
        if condition == NOMINAL:
            raise
        raise UntoldError("the environment has no such scene") from None
    with drivers:
        share = job.share(drivers, link)
    wrong = f"the lower end of its interval is below {100 * least:g} %" if share.low < least else ""
    return Found(f"{share.as_share()} % of {share.size} drives", wrong)


def network_at(link: LatencySpec, field: str, value: float) -> LatencySpec:
    """Return the link with a setting shifted to another mean over both ways."""
    more, ways = value - mean_of(link, field), (link.up, link.down)
    up, down = (replace(way, **{field: max(0.0, getattr(way, field) + more)}) for way in ways)
    return LatencySpec(up, down, f"{link}, {field} {value:g}")


def mean_of(link: LatencySpec, field: str) -> float:
    return float(getattr(link.up, field) + getattr(link.down, field)) / 2


def distance(axis: str, job: Job) -> Found:
    """Judge the link with the margin on top; search for the limit, too, unless ``--quick``.

    The limit is the largest value with enough success.
    """
    (field, most, step, unit), link, least = AXES[axis], job.asked.link, job.settings.success_link
    declared, points = mean_of(link, field), dict[float, Estimate]()
    worse = declared + getattr(job.settings, f"margin_{field}")
    with job.drivers() as drivers:

        def holds(value: float) -> bool:
            points[value] = job.share(drivers, network_at(link, field, value))
            return points[value].low >= least

        held = {value for value in {0.0, declared, worse} if holds(value)}
        limit, beyond = max(held, default=None), min({*points} - held, default=most)
        while limit is not None and beyond - limit > step and not job.asked.quick:
            middle = step * round((limit + beyond) / 2 / step)
            limit, beyond = (middle, beyond) if holds(middle) else (limit, middle)
    bears = "nothing" if limit is None else f"{'at least ' * job.asked.quick}{limit:g} {unit}"
    wrong = f"the policy bears {bears}, the link has {declared:g} {unit}"
    data = {"points": points, "declared": declared, "limit": limit, "least": least}
    measured = f"{points[worse].as_share()} % at {worse:g} {unit}; bears {bears}"
    return Found(measured, "" if {declared, worse} <= held else wrong, data)


def in_real_time(job: Job) -> Found:
    """Drive behind the link, recorded; ``edge_ms`` is from state received to command sent."""
    record = job.path / DRIVE_FILE
    for _ in range(DISTURBED_TRIES):
        report = job.drive(job.settings.drives, *REALTIME, job.asked.link, record=record)
        if not replay(record, job).wrong:  # If this machine stalls, stops may differ.
            break
    latency, ends = report["latency_ms"], [each["outcome"] for each in report["per_episode"]]
    heard = (message for _, message in valid_messages(Recording(record), VEHICLE_ID))
    answers = (each for each in heard if isinstance(each, Command) and each.inference_ns)
    times_ms = [round((each.sent_ns - each.received_ns) * 1e-6, 3) for each in answers]
    data = {"outcomes": ends, "edge_ms": times_ms, "period_ms": 1e3 * job.period_s}
    if not times_ms or latency["p99"] is None:
        return Found(", ".join(ends), "no state was answered")
    wrong = f"over {job.settings.round_trip_s:g} s; no safety rule stops for a constant delay"
    measured = f"p50 {latency['p50']:.1f}, p99 {latency['p99']:.1f} ms; {', '.join(ends)}"
    is_late = latency["p99"] > 1e3 * job.settings.round_trip_s
    measured += f"; {counted(report['safe_stops'], 'safe stop')}"
    return Found(measured, wrong if is_late else "", data)


def replay(path: str | Path, job: Job) -> Found:
    assert job.policy is not None
    drive = replaying.RecordedDrive(Path(path), None)
    report = replaying.report_on(drive, job.policy, replaying.replay(drive, job.policy, job.config))
    others = [each[:12] for each in report["recorded_policy_ids"] if each != job.policy_id]
    wrong = [f"policy {', '.join(others)} made it"] if others else []
    wrong += [f"{report['different']} answers differ"] if report["different"] else []
    measured = f"{report['compared'] - report['different']} of {report['compared']} the same"
    return Found(measured, "; ".join(wrong))


def conformance(job: Job) -> Found:
    out = job.path / "conformance.json"
    out.unlink(missing_ok=True)
    words = ("--vehicle", job.config.vehicle, *job.edge, "--period-s", job.period_s, "--out", out)
    with Process("hil_tests", "conformance", *words) as process:
        process.wait(CONFORMANCE_S)
        if not out.exists():  # The driver could not be opened.
            process.succeed()
    rules = read_json(out, "report")["rules"]
    broken = [rule for rule, wrong in rules.items() if wrong]
    wrong = f"broken: {'; '.join(broken)}" if broken else ""
    return Found(f"{len(rules) - len(broken)} of {len(rules)} rules", wrong)


def with_vehicle(job: Job) -> Found:
    loop = (*REALTIME, job.asked.link, "--loop", "vehicle")
    report = job.drive(job.settings.vehicle_drives, *loop, vehicle=job.config.vehicle)
    wrong, share = list(report["vehicle"]["faults"]), report["success_rate"]
    if share is not None and share < job.settings.success_vehicle:
        wrong.append("too few reach the goal")
    ends = ", ".join(each["outcome"] for each in report["per_episode"])
    return Found(f"{ends}; {counted(report['safe_stops'], 'safe stop')}", "; ".join(wrong))


def left_out(row: Fault, job: Job) -> str:
    """Return why a fault is not tried; empty where it is."""
    if not any(fnmatch(row.name, each) for each in job.settings.faults):
        return "not among the settings' faults"
    is_hunters, vehicle = row.rig.get("vehicle") == "hunter", job.config.vehicle
    return "not this vehicle's" if is_hunters and vehicle not in (NONE, *BUILT_IN) else ""


def fault(row: Fault, job: Job) -> Found:
    """Do a fault, and once more if it was missed, because this machine may have stalled.

    A crash or an unsafe command is never the machine's fault.
    """
    measured, policy, key = list[str](), Path(job.asked.policy), job.asked.public_key
    for _ in range(2):
        (report,) = run_faults([row], job.settings.tries, policy, public_key=key)["rows"]
        missed = missed_in(report)
        if measured or not missed or report["unsafe"] or report["crashes"]:
            break
        measured = [f"at first {missed[0]}"]
    for kind in ("reaction", "recovery"):
        if report[f"{kind}_ms"]:
            limit_ms = report[f"{kind}_limit_ms"]
            most = f" of {limit_ms:.0f}" if limit_ms is not None else ""
            measured.append(f"{kind} {report[f'{kind}_ms']['max']:.0f}{most} ms")
    return Found(", ".join(measured), "; ".join(missed))
