"""``trainer train --rerun``: opens the view around a run. The only door to rerun in the trainer."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bridge.rerun.sinks import Sink, check_sink, flush, open_sink, read_sink
from edge_runtime.cli import sigterm_as_interrupt
from trainer.training.metrics import EpisodeMetrics
from trainer.training.run import TrainingRun
from trainer.viewer.background import Background, Draw
from trainer.viewer.blueprint import (
    APPLICATION,
    EPISODES,
    SITTING_APPLICATION,
    SITTINGS,
    make_blueprint,
)
from trainer.viewer.sittings import Shown
from trainer.viewer.training_log import TrainingLog
from trainer.viewer.watcher import Watcher

OnEpisode = Callable[[EpisodeMetrics], None]


def check_word(word: str) -> Sink:
    """The sink that ``--rerun`` names; UserError where nothing could be shown there."""
    sink = read_sink(word)
    check_sink(sink)
    return sink


@contextmanager
def watched(run: TrainingRun, sink: Sink) -> Iterator[OnEpisode]:
    """Show a run for as long as it lasts; what it yields is to be called after each episode."""

    @contextmanager
    def opened() -> Iterator[Draw]:
        with open_sink(sink, APPLICATION, make_blueprint(None, EPISODES)) as recording:
            yield TrainingLog(recording, EPISODES).draw

    # Here, as signals are the main thread's.
    with sigterm_as_interrupt():
        background = Background(opened)
        watcher = Watcher(run, background.put)
        run.on_step = watcher.on_step
        try:
            yield watcher.on_episode
        finally:
            run.on_step = None
            watcher.close()
            background.close()
            if background.dropped:
                print(f"{background.dropped} entries came faster than drawn", file=sys.stderr)


@contextmanager
def show_sittings(paths: Iterable[Path], sink: Sink) -> Iterator[Shown]:
    """Draw recorded sittings; what it yields says how much there was."""
    shown = Shown()
    with open_sink(sink, SITTING_APPLICATION, make_blueprint(None, SITTINGS)) as recording:
        log = TrainingLog(recording, SITTINGS)
        for entry in shown.entries(paths):
            log.draw(entry)
        flush(recording)
        yield shown
