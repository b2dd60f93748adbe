"""Mutation operators that cosmic-ray does not have: it finds them by pyproject's entry point.

`StatementRemover`: a statement that is not there. `TableTarget`: a cell of a transition table that
leads elsewhere. Neither changes an import, a docstring or a definition.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from cosmic_ray.operators.operator import Example, Operator
from parso.python.tree import Keyword, Name


class StatementRemover(Operator):
    """Replaces an assignment or a call inside a function by `pass`."""

    def mutation_positions(self, node: Any) -> Iterator[tuple]:
        """Each of its statements."""
        if node.type != "simple_stmt" or node.search_ancestor("funcdef") is None:
            return
        statement = node.children[0]
        if statement.type in ("expr_stmt", "atom_expr"):
            yield statement.start_pos, statement.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """The same line with `pass` in the statement's place."""
        first = node.get_first_leaf()
        node.children[0] = Keyword("pass", first.start_pos, prefix=first.prefix)
        return node

    @classmethod
    def examples(cls) -> tuple:
        """For cosmic-ray's own tests."""
        return (Example("def f():\n    g()\n", "def f():\n    pass\n"),)


class TableTarget(Operator):
    """Sends a cell of a table of transitions to each of the other modes of its file.

    The cells are `Event.X: (_S, _D, _X)` in safety.py and `Event.X: {_D: _G}` in vehicles/core.py.
    """

    def mutation_positions(self, node: Any) -> Iterator[tuple]:
        """Each cell, once for each other mode."""
        is_cell = node.type == "name" and node.search_ancestor("dictorsetmaker") is not None
        if is_cell and node.get_next_leaf().value != ":":
            for _ in _other_modes(node):
                yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """That other mode."""
        return Name(_other_modes(node)[index], node.start_pos, prefix=node.prefix)

    @classmethod
    def examples(cls) -> tuple:
        """For cosmic-ray's own tests."""
        modes = "_S, _D = Mode\n"
        return (
            Example(modes + "T = {1: (_D,)}", modes + "T = {1: (_S,)}"),
            Example(modes + "T = {1: {_S: _D}}", modes + "T = {1: {_S: _S}}"),
        )


def _other_modes(node: Any) -> list[str]:
    """The modes of the file, `_S, _D, _X = ...`, without this one; none where it is no mode."""
    found = re.search(r"^(_[A-Z](?:, _[A-Z])+) = ", node.get_root_node().get_code(), re.M)
    modes = found[1].split(", ") if found else []
    return [mode for mode in modes if mode != node.value] if node.value in modes else []


class Provider(dict):
    """What the entry point `cosmic_ray.operator_providers` names."""

    def __init__(self) -> None:
        super().__init__(StatementRemover=StatementRemover, TableTarget=TableTarget)
