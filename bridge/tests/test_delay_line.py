"""The timer thread: what goes wrong on it is heard."""

from __future__ import annotations

import time

import pytest

from bridge.delay_line import DelayLine
from edge_runtime.tests.harness import wait_until


def test_what_an_action_raises_reaches_the_caller():
    def fail():
        raise ValueError("no link")

    line = DelayLine()
    line.push(time.monotonic(), fail)
    wait_until(lambda: not line._thread.is_alive(), "the line to end")
    with pytest.raises(ValueError, match="no link"):
        line.push(time.monotonic(), fail)
    with pytest.raises(ValueError, match="no link"):
        line.close()
