"""^C and SIGTERM, while driving and afterwards."""

from __future__ import annotations

import signal
from types import SimpleNamespace

import pytest

from trainer.person.signals import SIGNALS, quit_on_signals


@pytest.fixture
def sitting():
    return SimpleNamespace(stop=False, closed=False)


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_asks_to_stop(sitting, number):
    with quit_on_signals(sitting):
        signal.raise_signal(number)
        assert sitting.stop


def test_the_second_interrupt_is_one(sitting):
    with quit_on_signals(sitting):
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_when_the_sitting_is_over_the_first_interrupt_is_one(sitting):
    sitting.closed = True
    with quit_on_signals(sitting), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    assert not sitting.stop


def test_afterwards_all_is_as_it_was(sitting):
    before = [signal.getsignal(number) for number in SIGNALS]
    with quit_on_signals(sitting):
        assert [signal.getsignal(number) for number in SIGNALS] != before
    assert [signal.getsignal(number) for number in SIGNALS] == before
