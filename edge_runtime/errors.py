"""The one exception that a user meets."""

from edge_runtime.words import printable


class UserError(Exception):
    """Bad input. Its text is one line: what is wrong, and what would be right."""

    def __str__(self) -> str:
        """The text on one line, whatever a file name or a library put into it."""
        return printable(" ".join(super().__str__().split()))
