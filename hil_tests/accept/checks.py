"""The table of checks: each asks one thing of policy, link, vehicle or board, and gives rows."""

from __future__ import annotations

import io
import shlex
import subprocess
import sys
import tarfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from bridge.environments import NOMINAL
from bridge.network import LatencySpec
from bridge.outcomes import Estimate, settled
from bridge.recording import Recording, valid_messages
from bridge.replay import DEFAULT_TOLERANCE, RecordedDrive, report_replay
from deploy.bundle import UNATTENDED
from edge_runtime.config import NONE
from edge_runtime.policy import SIGNATURE_SUFFIX
from edge_runtime.util import UserError, counted, parse_json, read_json
from edge_runtime.vehicles.hunter import open_bus, parse_bus
from edge_runtime.wire import Command
from hil_tests.accept.job import (
    NOT_TRIED,
    PASSED,
    VEHICLE_ID,
    Job,
    Row,
    judged,
    not_tried,
)
from hil_tests.envelope import UntoldError
from hil_tests.faults.rig import free_bus
from hil_tests.faults.run import ROWS, run_faults
from hil_tests.processes import Process
from trainer.environments import make_environment
from trainer.evaluation import drive_episodes, load_driver
from trainer.util import cores

NO_NETWORK = LatencySpec()
SIGNATURE, INFERENCE = GATES = ("signature and manifest", "inference time")
"""What fails here is not driven."""
DRIVE, DRIVE_FILE = "drives in real time", "drive.mcap"
CONFORMANCE_S, CHECK_S = 600.0, 300.0
DISTURBED_TRIES = 3
AT_ONCE = 8  # Faults between two writes of what is done
AXES = {"delay": ("delay_ms", 1000.0, 25.0, "ms"), "loss": ("loss_percent", 50.0, 1.0, "%")}
"""What of a network gets worse each way: field, the most that is tried, resolution, unit."""


class Check(NamedTuple):
    """A line of the table: what it gives, and about how long it takes on two idle cores, s."""

    name: str
    run: Callable[[Job], Iterable[Row]]
    takes_s: float


def table(job: Job) -> list[Check]:
    """Return all checks in order, those that end the others first."""
    runs, sweep, drives = job.settings.runs, job.settings.sweep_runs, job.settings.drives
    recordings = [(f"replay of {Path(path).name}", path) for path in job.settings.recordings]
    recordings.insert(0, ("replay of these drives", str(job.folder / DRIVE_FILE)))
    return [
        Check(SIGNATURE, signature, 1.0),
        Check(INFERENCE, inference, 3.0),
        Check("over the wire as in process", over_the_wire, 8.0 + job.settings.wire_runs),
        *(Check(f"success, {condition}", partial(success, condition), 6.0 + 0.05 * runs)
          for condition in job.settings.success),
        Check("success behind the link", behind_the_link, 6.0 + 0.05 * runs),
        *(Check(f"distance to the limit of {axis}", partial(distance, axis),
                8.0 + 0.06 * sweep * (2 if job.asked.quick else 9)) for axis in AXES),
        Check(DRIVE, in_real_time, 10.0 + 9.0 * drives),
        *(Check(name, partial(replayed, name, path), 4.0) for name, path in recordings),
        Check("driver's conformance", conformance, 40.0 * job.has_vehicle),
        Check("drives with the vehicle", with_vehicle,
              (10.0 + 12.0 * job.settings.vehicle_drives) * job.has_vehicle),
        *faults(job),
    ]  # fmt: skip


def signature(job: Job) -> Iterator[Row]:
    asked = "signed by the known key; manifest, graph and answers agree"
    policy = job.policy
    told = f"{policy.trust}, policy_id {policy.policy_id[:12]}" if policy else "refused"
    yield judged(policy is not None, SIGNATURE, asked, told, job.refusal)


def inference(job: Job) -> Iterator[Row]:
    most_ms = 1e3 * job.settings.inference_share * job.period_s
    where = job.asked.board or "this machine"
    asked = f"p99 at most {most_ms:.0f} ms on {where} (T is {1e3 * job.period_s:.0f} ms)"
    try:
        found = check_there(job)["inference_ms"]
    except UserError as error:
        yield judged(False, INFERENCE, asked, "", str(error))
        return
    told = f"p50 {found['p50']:.2f}, p99 {found['p99']:.2f} ms"
    why = f"p99 {found['p99']:.1f} ms is too slow"
    yield judged(found["p99"] <= most_ms, INFERENCE, asked, told, why, **found)


def check_there(job: Job) -> dict[str, Any]:
    """Return the report of ``edge_runtime check``, from here or from the board by ssh."""
    command, sent = [sys.executable, "-m", "edge_runtime"], None
    words, board = ["check", job.asked.policy, *job.trust], job.asked.board
    if board:
        policy, key = Path(job.asked.policy), job.policy and job.policy.public_key
        files = {"p.onnx": policy, "p.onnx.sig": Path(f"{policy}{SIGNATURE_SUFFIX}")}
        files |= {"policy.pub": Path(key)} if key else {}
        sent = _tar({name: path for name, path in files.items() if path.exists()})
        trust = ["--public-key", "policy.pub"] if key else ["--allow-unsigned"]
        check = shlex.join([job.settings.board_command, "check", "p.onnx", *trust])
        there = f"d=$(mktemp -d) && cd $d && tar -xf - && {check}; s=$?; rm -rf $d; exit $s"
        command, words = ["ssh", *UNATTENDED, "--", board], [there]
    try:
        done = subprocess.run([*command, *words], input=sent, capture_output=True, timeout=CHECK_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(f"{board or 'check'}: {error}") from None
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise UserError(said[-1] if said else f"it ended with status {done.returncode}")
    return parse_json(done.stdout, "the report of check")


def _tar(files: dict[str, Path]) -> bytes:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for name, path in files.items():
            archive.add(path, name)
    return packed.getvalue()


def over_the_wire(job: Job) -> Iterator[Row]:
    count, asked = job.settings.wire_runs, job.asked
    for _ in range(DISTURBED_TRIES):
        report = job.drive(count)
        if not report["wall_clock_stalls"]:  # Else the machine itself stood still.
            break
    with closing(make_environment(asked.env, period_s=job.period_s)) as env:
        driver, _ = load_driver(asked.policy, env, asked.public_key)
        here = drive_episodes(env, driver, range(count))
    outcomes = settled(each.outcome for each in here)
    ours = [(outcome, each.steps) for outcome, each in zip(outcomes, here, strict=True)]
    theirs = [(each["outcome"], each["steps"]) for each in report["per_episode"]]
    apart = [seed for seed in range(count) if ours[seed] != theirs[seed]]
    first = ", ".join(f"seed {s}: {theirs[s]} over the wire, {ours[s]} here" for s in apart[:1])
    ask = f"outcome and length of each of {counted(count, 'drive')} the same"
    yield judged(not apart, "over the wire as in process", ask, f"{count - len(apart)} same", first)


def share_row(name: str, least: float, share: Estimate, why: str = "", **data: Any) -> Row:
    """Judge a share by the lower end of its interval."""
    asked, told = f"95 % sure of at least {least:.0%}", f"{share.as_share()} % of {share.size}"
    why = why or f"the drives show no more than {share.low:.1%}"
    return judged(share.low >= least, name, asked, told, why, share=share, least=least, **data)


def success(condition: str, job: Job) -> Iterator[Row]:
    name = f"success, {condition}"
    try:
        with job.driving(condition) as share:
            found = share(NO_NETWORK, job.settings.runs)
    except UntoldError as error:
        yield not_tried(name, str(error))
    except UserError as error:
        if condition == NOMINAL:
            raise
        yield not_tried(name, str(error))  # An environment need not have the scene.
    else:
        yield share_row(name, job.settings.success[condition], found)


def behind_the_link(job: Job) -> Iterator[Row]:
    name, link = "success behind the link", job.link
    if link == NO_NETWORK:
        yield not_tried(name, "no --link is declared")
        return
    with job.driving() as share:
        found = share(link, job.settings.runs)
    yield share_row(f"{name}", job.settings.success_link, found, link=str(link))


def network_at(link: LatencySpec, field: str, value: float) -> LatencySpec:
    """Return the link with another mean of a setting over both ways."""
    more = value - mean_of(link, field)
    up, down = (
        replace(way, **{field: max(0.0, getattr(way, field) + more)})
        for way in (link.up, link.down)
    )
    return LatencySpec(up, down, f"{link}, {field} {value:g}")


def mean_of(link: LatencySpec, field: str) -> float:
    return (getattr(link.up, field) + getattr(link.down, field)) / 2


def distance(axis: str, job: Job) -> Iterator[Row]:
    """Judge the network that is worse by the margin; look for the limit unless it is to be quick.

    The limit is the largest value found up to which the lower end of the interval is high enough.
    """
    field, most, step, unit = AXES[axis]
    declared, least = mean_of(job.link, field), job.settings.success_link
    margin = getattr(job.settings, f"margin_{field}")
    points: dict[float, Estimate] = {}
    with job.driving() as share:

        def holds(value: float) -> bool:
            points[value] = share(network_at(job.link, field, value), job.settings.sweep_runs)
            return points[value].low >= least

        is_good = holds(declared + margin)
        known = [declared + margin] if is_good else [v for v in {declared, 0.0} if holds(v)]
        low, high = max(known, default=None), most if is_good else declared + margin
        while low is not None and high - low > step and not job.asked.quick:
            middle = step * round((low + high) / 2 / step)
            low, high = (middle, high) if holds(middle) else (low, middle)
    name = f"distance to the limit of {axis}"
    asked = f"{least:.0%} also with {margin:g} {unit} more each way"
    told = f"at {declared + margin:g} {unit}: {points[declared + margin].as_share()} %"
    found = "no" if low is None else f"{'at least ' * job.asked.quick}{low:g} {unit}"
    why = f"it bears {found} {axis} each way, the link has {declared:g} {unit}"
    data = {"points": points, "declared": declared, "limit": low, "least": least}
    yield judged(is_good, name, asked, f"{told}; limit {found}", why, unit=unit, **data)


def in_real_time(job: Job) -> Iterator[Row]:
    count, path = job.settings.drives, job.folder / DRIVE_FILE
    options = ("--clock", "realtime", "--latency", str(job.link))
    report = job.drive(count, *options, record=path)
    latency, most_ms = report["latency_ms"], 1e3 * job.settings.round_trip_s
    asked = f"p99 from state sent to command received at most {most_ms:.0f} ms"
    told = f"no command in {counted(count, 'drive')}"
    if latency["p99"] is not None:
        told = "p50 {p50:.1f}, p99 {p99:.1f} ms".format(**latency)
    ends = [each["outcome"] for each in report["per_episode"]]
    told += f"; {', '.join(ends)}; {counted(report['safe_stops'], 'safe stop')}"
    is_good = latency["p99"] is not None and latency["p99"] <= most_ms
    why = "the car would follow what it was told too long ago; no rule stops a steady delay"
    yield judged(is_good, DRIVE, asked, told, why, edge_ms=edge_times_ms(path), outcomes=ends,
                 period_ms=1e3 * job.period_s)  # fmt: skip


def edge_times_ms(path: Path) -> list[float]:
    """Return how long the edge runtime took for each answer of the policy, ms."""
    messages = (message for _, message in valid_messages(Recording(path), VEHICLE_ID))
    answers = (each for each in messages if isinstance(each, Command) and each.inference_ns)
    return [round((each.sent_ns - each.received_ns) * 1e-6, 3) for each in answers]


def replayed(name: str, path: str, job: Job) -> Iterator[Row]:
    assert job.policy is not None
    asked = f"this policy made it; each answer within {DEFAULT_TOLERANCE:g}"
    report = report_replay(RecordedDrive(Path(path), None), job.policy, job.config)
    own, makers = job.policy.policy_id, report["recorded_policy_ids"]
    others = [f"policy {each[:12]} made it" for each in makers if each != own]
    wrong = (
        [*others, f"{report['different']} answers differ"] if others or report["different"] else []
    )
    told = f"{report['compared'] - report['different']} of {report['compared']} the same"
    yield judged(not wrong, name, asked, told, "; ".join(wrong))


def conformance(job: Job) -> Iterator[Row]:
    name = "driver's conformance"
    if not job.has_vehicle:
        yield not_tried(name, "no --vehicle is named")
        return
    out = job.folder / "conformance.json"
    out.unlink(missing_ok=True)
    words = [*job.vehicle_options(), "--period-s", str(job.period_s), "--out", str(out)]
    with Process("hil_tests", "conformance", *words) as process:
        process.wait(CONFORMANCE_S)
        if not out.exists():  # It could not be opened.
            process.succeed()
    rules = read_json(out, "report")["rules"]
    broken = [rule for rule, wrong in rules.items() if wrong]
    told = f"{len(rules) - len(broken)} of {counted(len(rules), 'rule')} kept"
    yield judged(not broken, name, "every rule kept", told, f"broken: {'; '.join(broken)}")


def with_vehicle(job: Job) -> Iterator[Row]:
    name, count = "drives with the vehicle", job.settings.vehicle_drives
    if not job.has_vehicle:
        yield not_tried(name, "no --vehicle is named")
        return
    options = ("--clock", "realtime", "--loop", "vehicle", "--latency", str(job.link))
    report = job.drive(count, *options, vehicle=True)
    faults, least = report["vehicle"]["faults"], job.settings.success_vehicle
    share = report["success_rate"]
    told = f"{'unknown' if share is None else f'{share:.0%}'} of {counted(count, 'drive')}"
    wrong = [f"{each} ({times} times)" for each, times in faults.items()]
    wrong += ["too few reach the goal"] * (share is not None and share < least)
    asked = f"no fault of the vehicle; {least:.0%} reach the goal"
    yield judged(not wrong, name, asked, told, "; ".join(wrong))


def faults(job: Job) -> Iterator[Check]:
    """Make a check of each few faults; those that need the machine for themselves come last."""
    rows = sorted(ROWS, key=lambda row: row.alone)
    due = [row for row in rows if any(fnmatch(row.name, each) for each in job.settings.faults)]
    reasons = {row.name: "not among the settings' faults" for row in rows if row not in due}
    if job.config.vehicle not in (NONE, "hunter"):
        reasons |= {row.name: "the vehicle is no Hunter" for row in due if _is_hunter(row)}
    elif not _has_multicast():
        reasons |= {row.name: "no multicast on this machine" for row in due if _is_hunter(row)}
    due = [row for row in due if row.name not in reasons]
    for first in range(0, len(due), AT_ONCE):
        some = due[first : first + AT_ONCE]
        takes_s = (1.5 + 1.2 * job.settings.tries) * len(some)
        yield Check(f"faults from {some[0].name}", partial(_do, some), takes_s)
    left = [not_tried(f"fault {name}", why) for name, why in reasons.items()]
    yield Check("other faults", lambda _: left, 0.0)


def _is_hunter(row: Any) -> bool:
    return row.rig.get("vehicle") == "hunter"


def _has_multicast() -> bool:
    with suppress(Exception), open_bus(parse_bus(free_bus())):
        return True
    return False


def _do(rows: list[Any], job: Job) -> Iterator[Row]:
    asked, tries = job.asked, job.settings.tries
    report = run_faults(rows, tries, Path(asked.policy), jobs=cores(), public_key=asked.public_key)
    for row in report["rows"]:
        times = [(kind, row[f"{kind}_ms"].get("max")) for kind in ("reaction", "recovery")]
        told = ", ".join(f"{kind} {ms:.0f} ms" for kind, ms in times if ms is not None)
        limits = [(kind, row[f"{kind}_limit_ms"]) for kind in ("reaction", "recovery")]
        within = ", ".join(f"{kind} within {ms:.0f} ms" for kind, ms in limits if ms is not None)
        wrong = [*row["wrong"], *row["unsafe"], *row["crashes"]]
        wrong += ["too late"] * bool(row["reaction_late"] + row["recovery_late"])
        ask = f"{row['done']}: {row['expected']}" + f" ({within})" * bool(within)
        yield judged(
            row["passed"], f"fault {row['name']}", ask, told or "as asked", "; ".join(wrong)
        )


def blocked_by(rows: Iterable[Row]) -> str:
    """Return why nothing more is tried; empty where all is well so far."""
    failed = [
        row.name for row in rows if row.name in GATES and row.result not in (PASSED, NOT_TRIED)
    ]
    return f"a policy that fails in {failed[0]} is not driven" if failed else ""
