"""Which signals would end this process, and that each of them can be an interrupt instead."""

from __future__ import annotations

import signal

import pytest

from edge_runtime.signals import ending_signals, sigterm_as_interrupt


@pytest.fixture
def all_at_default():
    """Every signal as a fresh process has it."""
    before = {}
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        before[number] = signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_all_that_end_a_process_are_interrupts(all_at_default):
    ending = ending_signals()
    assert {signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM} <= ending
    assert {signal.SIGUSR1, signal.SIGALRM, signal.SIGABRT, signal.SIGPIPE} <= ending
    assert not {signal.SIGCHLD, signal.SIGCONT, signal.SIGTSTP, signal.SIGSEGV} & ending
    with sigterm_as_interrupt():
        for number in ending:
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
        assert ending_signals() == set()
    assert ending_signals() == ending


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda number, frame: None])
def test_one_that_somebody_ignores_or_handles_stays_so(all_at_default, handler):
    signal.signal(signal.SIGHUP, handler)
    with sigterm_as_interrupt():
        signal.raise_signal(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is handler
