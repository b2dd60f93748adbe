"""Numbers and foreign text in sentences."""

from __future__ import annotations

__all__ = ["counted", "printable"]


def counted(count: int, noun: str) -> str:
    """``count`` of what ``noun`` names, in its regular plural but for one: "1 step", "2 steps"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def printable(text: str) -> str:
    """The text, with what a terminal would act upon written as its escape, as ``repr`` does."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
