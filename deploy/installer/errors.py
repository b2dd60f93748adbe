"""The one exception that a user meets, as in edge_runtime, which is not there yet."""

from __future__ import annotations


class _OneLineError(Exception):
    def __str__(self) -> str:
        """The text on one line, whatever a file name or the system put into it."""
        line = " ".join(super().__str__().split())
        # What a terminal would act upon is written as its escape.
        return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


class UserError(_OneLineError):
    """Bad input. Its text is one line: what is wrong, and what would be right."""


class UnhealthyError(_OneLineError):
    """A release that may not run here. Its text says why, on one line."""
