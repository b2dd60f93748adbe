"""How ``bridge simulate`` goes: a bar where a person watches, else a line an episode."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from edge_runtime.latency.command_hold import Decision
from edge_runtime.util import printable


class EpisodeBar:
    """Shows the episodes done and what the vehicle does at the moment."""

    def __init__(self, progress: Progress, episodes: int) -> None:
        self._progress = progress
        self._task = progress.add_task("waiting for an edge runtime", total=episodes)
        self._waits_for = ""

    def tick(self, episode: int, step: int, decision: Decision, waits_for: str = "") -> None:
        """Show one tick; ``waits_for`` is the command that the vehicle needs to drive again."""
        reason = printable(decision.brake_reason)
        doing = f"braking: {reason}" if reason else "driving"
        self._progress.update(
            self._task, completed=episode, description=f"step {step:3d}  {doing[:40]}"
        )
        if waits_for and not self._waits_for:
            self._say(f"the vehicle stands until it is re-armed: {waits_for}")
        self._waits_for = waits_for

    def done(self, episodes: int, told: str) -> None:
        """Show how many episodes are done, and without a bar what became of the last one."""
        self._progress.update(self._task, completed=episodes)
        if self._progress.disable:
            self._say(told)

    def _say(self, line: str) -> None:
        """Print a line above the bar, as it is."""
        self._progress.console.print(line, markup=False, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def episode_bar(episodes: int) -> Iterator[EpisodeBar]:
    """Show a bar on stderr while the block runs; lines if stderr is no terminal."""
    with _progress("episodes") as progress:
        yield EpisodeBar(progress, episodes)


@contextlib.contextmanager
def count_bar(unit: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a bar like ``episode_bar``; call what it yields with how many are done."""
    with _progress(unit) as progress:
        task = progress.add_task("replaying", total=total)
        yield lambda done: progress.update(task, completed=done)


def _progress(unit: str) -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty())
