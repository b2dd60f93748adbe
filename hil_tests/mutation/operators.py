"""Mutation operators that cosmic-ray does not have: it finds them by pyproject's entry point.

`StatementRemover`: a statement that is not there. `TableTarget`: a row of the transition table
that leads elsewhere. Neither changes an import, a docstring or a definition.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cosmic_ray.operators.operator import Example, Operator
from parso.python.tree import Keyword, Name

_MODES = ("_S", "_D", "_X")


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
    """Sends a row of TRANSITIONS, `(_D, Event.X): _S,`, to each of the other two modes."""

    def mutation_positions(self, node: Any) -> Iterator[tuple]:
        """Twice for each target, because there are two other modes."""
        before = node.get_previous_leaf() if node.type == "name" else None
        if before is not None and before.value == ":" and node.value in _MODES:
            yield node.start_pos, node.end_pos
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """The other mode, the first or the second."""
        others = [mode for mode in _MODES if mode != node.value]
        return Name(others[index], node.start_pos, prefix=node.prefix)

    @classmethod
    def examples(cls) -> tuple:
        """For cosmic-ray's own tests."""
        return (Example("{(_S, 1): _D}", "{(_S, 1): _S}"),)


class Provider(dict):
    """What the entry point `cosmic_ray.operator_providers` names."""

    def __init__(self) -> None:
        super().__init__(StatementRemover=StatementRemover, TableTarget=TableTarget)
