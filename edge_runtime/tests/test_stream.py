"""The stream's thread: periods, a command that gets too old, a wake, a process that was held up."""

import contextlib
import math
import time

import pytest
from hil_tests.processes import wait_until

from edge_runtime.vehicles import stream
from edge_runtime.vehicles.stream import Stream


@pytest.fixture
def started():
    """Starts streams that note when they sent, and pause at the first; ended with the test."""
    with contextlib.ExitStack() as ends:

        def make(late_at_s=lambda: math.inf, pause_s=0.0):
            sent = []

            def send():
                sent.append(time.monotonic())
                time.sleep(0.0 if sent[1:] else pause_s)
                return True

            running = Stream("test", send, late_at_s)
            ends.callback(running.stop)
            running.start()
            return running, sent

        yield make


def test_it_sends_fifty_times_a_second_and_after_a_pause_once_for_all_missed_periods(started):
    _, sent = started(pause_s=0.3)
    wait_until(lambda: len(sent) > 21, "0.4 s of sending")
    # A machine that pauses loses periods; nothing may make it send more often than asked.
    assert sent[21] - sent[1] > 0.33


def test_a_stop_and_a_command_that_gets_too_old_do_not_wait_for_the_period(started, monkeypatch):
    monkeypatch.setattr(stream, "PERIOD_S", 60.0)
    late_s = time.monotonic() + 0.2
    running, sent = started(lambda: late_s if time.monotonic() < late_s else math.inf)
    wait_until(lambda: len(sent) == 2, "one more, at the command's end")
    assert sent[1] >= late_s
    running.wake()
    wait_until(lambda: len(sent) == 3, "one more, woken")


def test_what_was_held_up_is_followed_at_once(started, monkeypatch):
    monkeypatch.setattr(stream, "PERIOD_S", 0.6)
    _, sent = started(pause_s=0.7)
    wait_until(lambda: len(sent) >= 2, "the next")
    assert sent[1] - sent[0] < 1.1  # the next period would have come 1.2 s after the first
