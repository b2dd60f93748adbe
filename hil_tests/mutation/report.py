"""What the mutants say: a count for each module, and every survivor by name."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hil_tests.mutation.session import Mutant

_ACCEPTED = Path(__file__).with_name("accepted.toml")


def read_accepted(path: Path = _ACCEPTED) -> list[dict[str, str]]:
    """The survivors that do not matter: `module`, `was`, `became` ("*" at its end), `reason`."""
    return list(tomllib.loads(path.read_text()).get("accepted", []))


def judge(mutants: Sequence[Mutant], accepted: Sequence[dict[str, str]]) -> dict[str, Any]:
    """Counts by module, the survivors, and those of them that are accepted, with the reason."""
    rows, survived, reasoned = {}, [], []
    for module in dict.fromkeys(mutant.module for mutant in mutants):
        mine = [mutant for mutant in mutants if mutant.module == module]
        alive = [mutant for mutant in mine if mutant.outcome != "killed"]
        for mutant in alive:
            reason = _reason(mutant, accepted)
            entry = mutant._asdict()
            if reason:
                reasoned.append({**entry, "reason": reason})
            else:
                survived.append(entry)
        rows[module] = {"mutants": len(mine), "killed": len(mine) - len(alive)}
    for module, row in rows.items():
        row["accepted"] = sum(entry["module"] == module for entry in reasoned)
        row["survived"] = sum(entry["module"] == module for entry in survived)
    return {"modules": rows, "survived": survived, "accepted": reasoned}


def _reason(mutant: Mutant, accepted: Sequence[dict[str, str]]) -> str:
    for entry in accepted:
        if (
            entry["module"] == mutant.module
            and entry["was"] == mutant.was
            and _matches(mutant.became, entry["became"])
        ):
            return entry["reason"]
    return ""


def _matches(text: str, pattern: str) -> bool:
    return text.startswith(pattern[:-1]) if pattern.endswith("*") else text == pattern


def render(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = [
        "# Mutation tests of the edge runtime's core",
        "",
        "Made by `make mutate` (cosmic-ray). A mutant is the module with one small change; a test",
        "must fail for it. Accepted ones survive for the reason given.",
        "",
        "| module | mutants | killed | accepted | survived |",
        "|---|---|---|---|---|",
    ]
    for module, row in report["modules"].items():
        cells = (row[name] for name in ("mutants", "killed", "accepted", "survived"))
        lines.append(f"| {module}.py | " + " | ".join(map(str, cells)) + " |")
    for title, entries in (("Survived", report["survived"]), ("Accepted", report["accepted"])):
        if entries:
            lines += ["", f"## {title}", ""]
            lines += [_line(entry) for entry in entries]
    return "\n".join(lines) + "\n"


def _line(entry: dict[str, str]) -> str:
    reason = f": {entry['reason']}" if "reason" in entry else ""
    return f"- {entry['module']}.py: `{entry['was']}` became `{entry['became']}`{reason}"
