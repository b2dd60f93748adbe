"""``python -m hil_tests.mutation.judge SESSION.sqlite...``: which mutants no test has noticed.

Prints a count for each file and every survivor; exit status 1 where one of them is not in
accepted.toml with a reason. `make mutate` calls it after cosmic-ray.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

ACCEPTED = Path(__file__).with_name("accepted.toml")


class Mutant(NamedTuple):
    """A change of one line (or a few), and what the tests said: killed, survived, incompetent."""

    file: str
    was: str
    became: str
    outcome: str


def read_session(path: str) -> list[Mutant]:
    """All mutants of a session that were not filtered out."""
    dump = subprocess.run(["cosmic-ray", "dump", path], check=True, capture_output=True, text=True)
    pairs = map(json.loads, dump.stdout.splitlines())
    return [
        _mutant(item["mutations"][0], result or {})
        for item, result in pairs
        if (result or {}).get("worker_outcome") != "skipped"
    ]


def _mutant(mutation: dict, result: dict) -> Mutant:
    lines = (result.get("diff") or "").splitlines()
    diff = [line for line in lines if not line.startswith(("--- ", "+++ "))]
    was, became = (" ".join(line[1:].strip() for line in diff if line[:1] == sign) for sign in "-+")
    outcome = str(result.get("test_outcome") or "not run")
    return Mutant(str(mutation["module_path"]), was, became, outcome)


def read_accepted() -> list[dict[str, str]]:
    """The survivors that do not matter: `file`, `was`, `became` ("*" at its end), `reason`."""
    return list(tomllib.loads(ACCEPTED.read_text())["accepted"])


def judge(mutants: Iterable[Mutant], accepted: Sequence[dict[str, str]]) -> list[str]:
    """A line for each file with its counts, then one for each survivor that is not accepted."""
    counts: dict[str, list[int]] = {}
    survived = []
    for mutant in mutants:
        count = counts.setdefault(mutant.file, [0, 0, 0])
        count[0] += 1
        if mutant.outcome == "killed":
            count[1] += 1
        elif any(_fits(mutant, entry) for entry in accepted):
            count[2] += 1
        else:
            survived.append(f"SURVIVED {mutant.file}: `{mutant.was}` became `{mutant.became}`")
    rows = [
        f"{file}: {made} mutants, {killed} killed, {reasoned} accepted"
        for file, (made, killed, reasoned) in counts.items()
    ]
    return rows + survived


def _fits(mutant: Mutant, entry: dict[str, str]) -> bool:
    if (mutant.file, mutant.was) != (entry["file"], entry["was"]):
        return False
    pattern = entry["became"]
    if pattern.endswith("*"):
        return mutant.became.startswith(pattern[:-1])
    return mutant.became == pattern


def main(sessions: Sequence[str]) -> int:
    """Print them; 1 where one survived."""
    lines = judge((m for path in sessions for m in read_session(path)), read_accepted())
    print("\n".join(lines))
    return int(any(line.startswith("SURVIVED") for line in lines))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
