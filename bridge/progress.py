"""A command's progress: a bar on stderr, or a line now and then if stderr is no terminal."""

from __future__ import annotations

import sys
import time
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

LINE_INTERVAL_S = 15.0  # Between two lines of progress where stderr is no terminal


class ProgressBar:
    """Counts to ``total`` and shows live figures, e.g. ``{"success": "0.85"}``, on stderr."""

    def __init__(self, what: str, total: int, done: int = 0) -> None:
        self.what, self.total, self.done = what, total, done
        self._line_s = time.monotonic()
        self._bar = Progress(
            *(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()),
            TextColumn("{task.fields[figures]}", markup=False),
            *(TextColumn("ETA"), TimeRemainingColumn()),
            console=Console(stderr=True),
            disable=not sys.stderr.isatty(),
        )
        self._task = self._bar.add_task(what, total=total, completed=done, figures="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, text: str) -> None:
        """Show a text beside the bar; nothing without a bar."""
        self._bar.update(self._task, figures=text)

    def say(self, line: str) -> None:
        """Print a line above the bar, as it is."""
        self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def advance(self, figures: dict[str, str], count: int = 1, told: str = "") -> None:
        """Count ``count`` more and show the figures; without a bar, print ``told``."""
        self.done += count
        text = "  ".join(f"{name} {value}" for name, value in figures.items())
        self._bar.update(self._task, completed=self.done, figures=text)
        now_s = time.monotonic()
        is_due = now_s - self._line_s > LINE_INTERVAL_S or self.done >= self.total
        if self._bar.disable and (told or is_due):
            self._line_s = now_s
            self.say(told or f"{self.what}: {self.done}/{self.total}  {text}")
