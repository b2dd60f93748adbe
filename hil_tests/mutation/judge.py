"""``python -m hil_tests.mutation.judge SESSION.sqlite...``: which mutants no test has noticed.

Prints a count for each file and every survivor; exit status 1 where one of them is not in
accepted.toml with a reason. `make mutate` calls it after cosmic-ray.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ACCEPTED = Path(__file__).with_name("accepted.toml")


class Mutant(NamedTuple):
    """A change of one line (or a few), and what the tests said: killed, survived, incompetent."""

    file: str
    was: str
    became: str
    outcome: str


def read_session(path: str) -> Iterator[Mutant]:
    """All mutants of a session that were not filtered out."""
    dump = subprocess.run(["cosmic-ray", "dump", path], check=True, capture_output=True, text=True)
    for item, result in map(json.loads, dump.stdout.splitlines()):
        told = result or {}
        if told.get("worker_outcome") == "skipped":
            continue
        lines = (told.get("diff") or "").splitlines()
        diff = [line for line in lines if not line.startswith(("--- ", "+++ "))]
        was, became = (" ".join(x[1:].strip() for x in diff if x[:1] == sign) for sign in "-+")
        file = str(item["mutations"][0]["module_path"])
        yield Mutant(file, was, became, str(told.get("test_outcome") or "not run"))


def read_accepted() -> list[dict[str, str]]:
    """The survivors that do not matter: `file`, `was`, `became` ("*" at its end), `reason`."""
    return list(tomllib.loads(ACCEPTED.read_text())["accepted"])


def judge(mutants: Iterable[Mutant], accepted: Sequence[dict[str, str]]) -> list[str]:
    """A line for each file with its counts, then one for each survivor that is not accepted."""
    counts: dict[str, Counter[str]] = {}
    survived = []
    for file, was, became, outcome in mutants:
        count = counts.setdefault(file, Counter())
        patterns = (one["became"] for one in accepted if (one["file"], one["was"]) == (file, was))
        if outcome != "killed" and any(_fits(became, one) for one in patterns):
            outcome = "accepted"
        count.update(["made", outcome])
        if outcome not in ("killed", "accepted"):
            survived.append(f"SURVIVED {file}: `{was}` became `{became}`")
    return [
        f"{file}: {count['made']} mutants, {count['killed']} killed, {count['accepted']} accepted"
        for file, count in counts.items()
    ] + survived


def _fits(became: str, pattern: str) -> bool:
    return became.startswith(pattern[:-1]) if pattern.endswith("*") else became == pattern


if __name__ == "__main__":
    said = judge((m for path in sys.argv[1:] for m in read_session(path)), read_accepted())
    print("\n".join(said))
    sys.exit(any(line.startswith("SURVIVED") for line in said))
