"""The progress bar of ``bridge simulate``; only where a person watches."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bridge.command_hold import Decision


class EpisodeBar:
    """Shows the episodes done and what the vehicle does at the moment."""

    def __init__(self, progress: Progress, episodes: int) -> None:
        self._progress = progress
        self._task = progress.add_task("waiting for an edge runtime", total=episodes)

    def tick(self, episode: int, step: int, decision: Decision) -> None:
        """Show one tick."""
        doing = f"braking: {decision.brake_reason}" if decision.brake_reason else "driving"
        self._progress.update(
            self._task, completed=episode, description=f"step {step:3d}  {doing[:40]}"
        )

    def done(self, episodes: int) -> None:
        """Show how many episodes are done."""
        self._progress.update(self._task, completed=episodes)


@contextlib.contextmanager
def episode_bar(episodes: int) -> Iterator[EpisodeBar]:
    """Show a bar on stderr while the block runs; nothing if stderr is no terminal."""
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
