"""``python -m hil_tests accept``: check whether a policy may drive a vehicle over a network.

Each check's row is written to a file in DIR at once, so that the same command goes on after ^C or a
kill. The report replaces that file: the next call begins anew.
"""

from __future__ import annotations

import shlex
import sys
import time
from argparse import Namespace
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.config import convert, load_config
from edge_runtime.files import check_writable, write_atomic, write_json
from edge_runtime.policy import MAX_POLICY_MIB, load_policy, policy_id_of
from edge_runtime.util import UserError, open_regular, printable, read_bytes, read_json, read_toml
from edge_runtime.vehicles import vehicle_limits
from hil_tests.accept import page
from hil_tests.accept.checks import GATES, Check, Found, Job, table
from hil_tests.accept.page import FAILED, NOT_TRIED, PASSED
from hil_tests.campaign import choose
from hil_tests.envelope import UntoldError
from trainer.environments import CONDITIONS, make_environment
from trainer.evaluation import load_driver
from trainer.util import claimed

REJECTED = 1  # Exit status
UNFINISHED = "unfinished.json"
SURE_S = 30.0  # After this long, measured times weigh as much as the table's estimates
_KNOWN = read_toml(Path(__file__).with_name("accept.toml"), "settings")
_KINDS: dict[type, Any] = {
    int: Annotated[int, msgspec.Meta(ge=1)], float: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)],
    str: str, list: list[str], dict: dict[str, Any],
}  # fmt: skip
_CONDITION: Any = Literal[tuple(CONDITIONS)]
_SHARE = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
_FIELDS = {key: _KINDS[type(value)] for key, value in _KNOWN.items()}
_FIELDS |= dict.fromkeys(("success_link", "success_vehicle"), _SHARE)
_FIELDS["success"] = dict[_CONDITION, _SHARE]
Settings: Any = msgspec.defstruct("Settings", _FIELDS.items(), forbid_unknown_fields=True)
"""The keys of accept.toml, whose values have the types of the defaults there."""


@sigterm_as_interrupt()
def run(asked: Namespace) -> int:
    """Do the remaining checks and write the report; return 0 if nothing failed, else 1."""
    job = prepare(asked)
    with claimed(job.path):
        return judge(job)


def judge(job: Job) -> int:
    asked, (rows, seconds) = job.asked, run_checks(job)
    failed = [row for row in rows if row["result"] == FAILED]
    report: dict[str, Any] = {
        "verdict": "rejected" if failed else PASSED, "policy_id": job.policy_id,
        "policy": printable(asked.policy), "env": asked.env, "vehicle": job.config.vehicle,
        "link": str(asked.link), "board": asked.board, "quick": asked.quick,
        "created": datetime.now(UTC).isoformat(timespec="seconds"), "seconds": seconds,
        "command": printable(f"python -m hil_tests {shlex.join(sys.argv[1:])}"),
        "checks": [{key: row[key] for key in row if key != "data"} for row in rows],
        "data": {row["name"]: row["data"] for row in rows if row["data"]},
    }  # fmt: skip
    write_json(job.path / "report.json", report)
    write_atomic(job.path / "junit.xml", page.junit(report))
    write_atomic(job.path / "report.html", page.render(job.path, report).encode())
    (job.path / UNFINISHED).unlink()
    for row in failed:
        print(f"failed  {row['name']}: {row['why']}")
    print(f"{report['verdict']}: {job.path / 'report.html'}")
    return REJECTED if failed else 0


def load_settings(path: str | None, quick: bool) -> Any:
    """Read a file over the defaults. UserError for an unknown key or fault, or a wrong value."""
    values = {**_KNOWN, **(read_toml(path, "settings") if path else {})}
    try:
        settings = convert(values, Settings)
        if quick:
            settings = convert({**values, **_KNOWN["quick"], **settings.quick}, Settings)
        choose(",".join(settings.faults), "faults")
        return settings
    except UserError as error:
        raise UserError(f"settings {path}: {error}") from None


def prepare(asked: Namespace) -> Job:
    """Read and check all that the options name. Raises UserError."""
    settings, key = load_settings(asked.config, asked.quick), asked.public_key
    check_writable(f"{asked.out}/report.json")
    policy_id = policy_id_of(read_bytes(asked.policy, "policy file", MAX_POLICY_MIB))
    for path in (*settings.recordings, *([key] if key else [])):
        try:
            open_regular(path).close()
        except (OSError, ValueError) as error:
            raise UserError(str(error)) from None
    flags = {"policy": asked.policy, "vehicle": asked.vehicle}
    config = load_config(settings.edge or None, flags, opens_link=False)
    if config.tls:
        raise UserError(f"{settings.edge} turns on tls; these drives are local: leave it out")
    policy, refusal = None, ""
    try:
        policy = load_policy(asked.policy, key, asked.allow_unsigned)
    except UserError as error:
        refusal = str(error)
    else:
        period_s = policy.manifest.control_period_s
        with closing(make_environment(asked.env, period_s=period_s)) as env:
            load_driver(asked.policy, env, policy.public_key)  # Checks that it fits
        vehicle_limits(config.vehicle, config.vehicle_settings, policy.manifest, config.bounds)
    trust = ["--public-key", key] if key else []
    trust += ["--allow-unsigned"] if asked.allow_unsigned else []
    return Job(asked, settings, Path(asked.out), policy_id, policy, refusal, config, trust)


def run_checks(job: Job) -> tuple[list[dict[str, Any]], float]:
    """Do the remaining checks; return all rows, with `data` for the page, and the seconds."""
    path, checks = job.path / UNFINISHED, table(job)
    what = {name: str(value) for name, value in vars(job.asked).items()}
    what |= {"policy_id": job.policy_id, "settings": str((job.settings, job.config, job.refusal))}
    what["checks"] = str([check.name for check in checks])
    progress: dict[str, Any] = {}
    with suppress(UserError):
        progress = read_json(path, "progress file")
    if progress.get("what") != what:
        progress = {"what": what, "rows": [], "seconds": 0.0}
        for name in ("report.json", "junit.xml", "report.html"):
            (job.path / name).unlink(missing_ok=True)
    rows, took_s, table_s = progress["rows"], SURE_S, SURE_S
    while left := checks[len(rows) :]:
        check, begun_s = left[0], time.monotonic()
        rows.append(row := attempt(check, job))
        if row["result"] == FAILED and check.name in GATES:
            why = f"the policy fails in: {check.name}"
            rows += [attempt(each._replace(skipped=why), job) for each in left[1:]]
        progress["seconds"] += (seconds := time.monotonic() - begun_s)
        write_json(path, progress)
        if row["result"] != NOT_TRIED:
            took_s, table_s = took_s + seconds, table_s + check.takes_s
            rest_s = sum(each.takes_s for each in checks[len(rows) :] if not each.skipped)
            line = f"{row['result']:<6}  {check.name}: {row['measured']}"
            print(f"{rest_s * took_s / table_s / 60.0:4.1f} min left  {line}", flush=True)
    return rows, progress["seconds"]


def attempt(check: Check, job: Job) -> dict[str, Any]:
    found, result, why = Found(""), NOT_TRIED, check.skipped
    if not why:
        try:
            found = check.run(job)
            result, why = FAILED if found.wrong else PASSED, found.wrong
        except UntoldError as error:
            why = str(error)
        except UserError as error:
            result, why = FAILED, str(error)
    row = {"name": check.name, "asked": check.asked, "measured": found.measured}
    texts = {**row, "result": result, "why": why}
    # A name or another program's text may hold characters that XML forbids.
    return {**{key: printable(text) for key, text in texts.items()}, "data": found.data}
