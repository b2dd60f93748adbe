"""^C and SIGTERM, while somebody heeds them and afterwards."""

from __future__ import annotations

import signal

import pytest

from trainer.signals import SIGNALS, quit_on_signals


class Work:
    """Notes that it was asked to end."""

    def __init__(self, over: bool = False) -> None:
        self.over, self.asked = over, 0

    def quit(self) -> bool:
        self.asked += 1
        return not self.over


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_asks_to_stop(number):
    work = Work()
    with quit_on_signals(work.quit):
        signal.raise_signal(number)
        assert work.asked == 1


def test_the_second_interrupt_is_one():
    work = Work()
    with quit_on_signals(work.quit):
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert work.asked == 1


def test_when_the_work_is_over_the_first_interrupt_is_one():
    with quit_on_signals(Work(over=True).quit), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_afterwards_all_is_as_it_was():
    before = [signal.getsignal(number) for number in SIGNALS]
    with quit_on_signals(Work().quit):
        assert [signal.getsignal(number) for number in SIGNALS] != before
    assert [signal.getsignal(number) for number in SIGNALS] == before
