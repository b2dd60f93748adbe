"""``python hil_tests/mutation/mutants.py SESSION.sqlite...``: which mutants no test has noticed.

Prints a count for each file and every survivor; exit status 1 where one of them is not in
accepted.toml with a reason. `make mutate` calls it after cosmic-ray, which finds two further
operators here by pyproject's entry point: a statement that is not there, and a cell of a transition
table that leads elsewhere. Neither changes an import, a docstring or a definition.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ACCEPTED = Path(__file__).with_name("accepted.toml")


class StatementRemover:
    """Replaces an assignment or a call inside a function by `pass`."""

    arguments = tuple

    def mutation_positions(self, node: Any) -> Iterator[tuple]:
        """Each of its statements."""
        if node.type == "simple_stmt" and node.search_ancestor("funcdef") is not None:
            statement = node.children[0]
            if statement.type in ("expr_stmt", "atom_expr"):
                yield statement.start_pos, statement.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """The same line with `pass` in the statement's place."""
        from parso.python.tree import Keyword  # here: only cosmic-ray's environment has it

        first = node.get_first_leaf()
        node.children[0] = Keyword("pass", first.start_pos, prefix=first.prefix)
        return node


class TableTarget:
    """Sends a cell of a table of transitions to each of the other modes of its file.

    The cells are `Event.X: (_S, _D, _X)` in safety.py and `Event.X: {_D: _G}` in vehicles/core.py.
    """

    arguments = tuple

    def mutation_positions(self, node: Any) -> Iterator[tuple]:
        """Each cell, once for each other mode."""
        is_cell = node.type == "name" and node.search_ancestor("dictorsetmaker") is not None
        if is_cell and node.get_next_leaf().value != ":":
            for _ in _other_modes(node):
                yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """That other mode."""
        from parso.python.tree import Name

        return Name(_other_modes(node)[index], node.start_pos, prefix=node.prefix)


def _other_modes(node: Any) -> list[str]:
    """The modes of the file, `_S, _D, _X = ...`, without this one; none where it is no mode."""
    found = re.search(r"^(_[A-Z](?:, _[A-Z])+) = ", node.get_root_node().get_code(), re.M)
    modes = found[1].split(", ") if found else []
    return [mode for mode in modes if mode != node.value] if node.value in modes else []


def operators() -> dict[str, type]:
    """What the entry point `cosmic_ray.operator_providers` names."""
    return {"StatementRemover": StatementRemover, "TableTarget": TableTarget}


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
