"""``python -m hil_tests accept``: may this policy drive that vehicle over that network?

Each check's rows are written to DIR as they come, so that the same command goes on after ^C or a
kill. With the report, that file goes: the next call begins anew.
"""

from __future__ import annotations

import hashlib
import shlex
import sys
import time
from argparse import Namespace
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.config import load_config
from edge_runtime.files import check_writable, make_directory, write_atomic, write_json
from edge_runtime.policy import load_policy
from edge_runtime.util import DEFAULT_PUBLIC_KEY, UserError, read_bytes, read_json
from edge_runtime.vehicles import vehicle_limits
from hil_tests.accept import checks, page
from hil_tests.accept.job import FAILED, Job, Row, load_settings, not_tried
from trainer.environments import make_environment
from trainer.evaluation import load_driver

REPORT = ("report.json", "report.html", "junit.xml")
REJECTED = 1  # Exit status
UNFINISHED = "unfinished.json"


@sigterm_as_interrupt()
def run(asked: Namespace) -> int:
    """Run what is not done yet, and write the report; 0 where nothing failed, else 1."""
    job = prepare(asked)
    rows, seconds = run_checks(job)
    is_good = not any(row.result == FAILED for row in rows)
    told = ("name", "asked", "measured", "result", "why")
    report: dict[str, Any] = {
        "verdict": "passed" if is_good else "rejected",
        "policy_id": job.policy.policy_id if job.policy else None,
        "policy": asked.policy, "env": asked.env, "vehicle": job.config.vehicle,
        "link": str(asked.link), "board": asked.board, "quick": asked.quick,
        "created": datetime.now(UTC).isoformat(timespec="seconds"), "seconds": seconds,
        "command": f"python -m hil_tests {shlex.join(sys.argv[1:])}",
        "checks": [{name: getattr(row, name) for name in told} for row in rows],
        "data": {row.name: row.data for row in rows if row.data},
    }  # fmt: skip
    write_json(job.folder / "report.json", report)
    write_atomic(job.folder / "report.html", page.render(job.folder, report, rows).encode())
    write_atomic(job.folder / "junit.xml", page.junit(report))
    (job.folder / UNFINISHED).unlink()
    for row in (row for row in rows if row.result == FAILED):
        print(f"failed  {row.name}: {row.why}")
    print(f"{report['verdict']}: {job.folder / 'report.html'}")
    return 0 if is_good else REJECTED


def prepare(asked: Namespace) -> Job:
    """Read everything that is named. UserError for what is no policy, environment and so on."""
    settings, folder = load_settings(asked.config, asked.quick), Path(asked.out)
    check_writable(folder / REPORT[0])
    read_bytes(asked.policy, "policy file", 96)
    key = asked.public_key or (
        str(DEFAULT_PUBLIC_KEY.absolute()) if DEFAULT_PUBLIC_KEY.exists() else None
    )
    for path in (*settings.recordings, *filter(None, [key])):
        read_bytes(path, "file", 1 << 12)
    flags = {"policy": asked.policy, "vehicle": asked.vehicle, "connect": "tcp/127.0.0.1:7447"}
    config = load_config(settings.edge or None, flags)
    policy, refusal = None, ""
    try:
        policy = load_policy(asked.policy, key, asked.allow_unsigned)
    except UserError as error:
        refusal = str(error)
    if policy is not None:
        period_s = policy.manifest.control_period_s
        with closing(make_environment(asked.env, period_s=period_s)) as env:
            load_driver(asked.policy, env, key)  # It is for this environment.
        vehicle_limits(config.vehicle, config.vehicle_settings, policy.manifest)
    make_directory(folder)
    return Job(asked, settings, folder, policy, refusal, config)


def run_checks(job: Job) -> tuple[list[Row], float]:
    """Do what is left of the table; return all rows, and how long they took."""
    table, place = checks.table(job), job.folder / UNFINISHED
    what = {**{n: str(v) for n, v in vars(job.asked).items()}, "command": None}
    what["settings"] = msgspec.to_builtins(job.settings)
    what["policy_id"] = hashlib.sha256(Path(job.asked.policy).read_bytes()).hexdigest()
    known: dict[str, Any] = {}
    with suppress(UserError):
        known = read_json(place, "what is done")
    if known.get("what") != what:
        known = {"what": what, "done": {}, "seconds": 0.0}
        for name in REPORT:
            (job.folder / name).unlink(missing_ok=True)
    done, rows = known["done"], []
    left_s, asked_s, took_s = sum(each.takes_s for each in table), 0.0, 0.0
    for check in table:
        left_s -= check.takes_s
        if check.name in done:
            rows += msgspec.convert(done[check.name], list[Row])
            continue
        begun_s = time.monotonic()
        found = attempt(check, job, checks.blocked_by(rows))
        rows += found
        took_s, asked_s = took_s + time.monotonic() - begun_s, asked_s + check.takes_s
        done[check.name] = msgspec.to_builtins(found)
        known["seconds"] += time.monotonic() - begun_s
        write_json(place, known)
        minutes = left_s * (took_s / asked_s if asked_s else 1.0) / 60.0
        for row in found:
            print(f"{minutes:4.1f} min left  {row.result:<9} {row.name}: {row.measured or row.why}")
    return rows, known["seconds"]


def attempt(check: checks.Check, job: Job, blocked: str) -> list[Row]:
    """Return a check's rows, and a failed one for what it could not do."""
    if blocked:
        return [not_tried(check.name, blocked)]
    try:
        return list(check.run(job))
    except UserError as error:
        return [Row(name=check.name, result="failed", why=str(error))]
