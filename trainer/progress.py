"""Progress for long work: a bar on a terminal, a line now and then in a log."""

from __future__ import annotations

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

LINE_INTERVAL_S = 15.0


class ProgressBar:
    """Counts to ``total`` and shows a few live figures; written to stderr.

    Use as a context manager and call ``advance`` with the figures, e.g. ``{"success": "0.85"}``.
    """

    def __init__(self, what: str, total: int, done: int = 0) -> None:
        self.what, self.total, self.done = what, total, done
        self._began_s = self._line_s = time.monotonic()
        self._began_at = done
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[figures]}"),
                TextColumn("ETA"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._task = self._bar.add_task(what, total=total, completed=done, figures="")

    def __enter__(self) -> ProgressBar:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def advance(self, figures: dict[str, str], count: int = 1) -> None:
        """``count`` more are done; ``figures`` are shown as name and value."""
        self.done += count
        text = "  ".join(f"{name} {value}" for name, value in figures.items())
        if self._bar:
            self._bar.update(self._task, completed=self.done, figures=text)
        elif time.monotonic() - self._line_s > LINE_INTERVAL_S or self.done == self.total:
            self._line_s = time.monotonic()
            line = f"{self.what}: {self.done}/{self.total}  {text}  ETA {self._eta_s():.0f} s"
            print(line, file=sys.stderr, flush=True)

    def _eta_s(self) -> float:
        elapsed_s = time.monotonic() - self._began_s
        return elapsed_s / max(self.done - self._began_at, 1) * (self.total - self.done)
