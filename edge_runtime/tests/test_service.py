"""What a service needs: lines for machines, priority, the board watched."""

from __future__ import annotations

import json
import os
import threading
from typing import Any

from edge_runtime import log, realtime
from edge_runtime.board import look
from edge_runtime.flood import Flood


def test_a_flood_is_one_line_a_second_for_each_kind():
    flood = Flood()
    assert flood.admit("stale", 5.0) == 0
    assert [flood.admit("stale", 5.0 + tenth / 10) for tenth in range(1, 10)] == [None] * 9
    assert flood.admit("schema", 5.5) == 0
    assert flood.admit("stale", 6.0) == 9
    assert flood.admit("stale", 7.5) == 0


def test_the_hottest_sensor_counts_and_a_silent_one_does_not(tmp_path):
    for name, text in {"0": "41500\n", "1": "63250\n", "2": ""}.items():
        (tmp_path / f"thermal_zone{name}").mkdir()
        (tmp_path / f"thermal_zone{name}" / "temp").write_text(text)
    assert look(tmp_path).temperature_c == 63.25
    board = look(tmp_path / "none", tmp_path / "none")
    assert (board.temperature_c, board.rss_mb) == (None, 0.0)
    assert look().rss_mb > 10.0


def test_what_the_system_refuses_is_named_and_the_rest_applied(monkeypatch):
    asked: dict = {}

    def refuse(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cpus: asked.update(cpus=cpus))
    monkeypatch.setattr(realtime, "_lock_memory", lambda _: asked.update(locked=True))
    assert realtime.configure(50, [1], True) == ["realtime_priority"]
    assert asked == {"cpus": [1], "locked": True}
    assert realtime.configure(0, [1, 7], False) == ["cpus"]
    assert realtime.configure(0, [], False) == []


def test_lines_as_text_and_the_fields_of_json(capfd):
    for log_format in log.FORMATS:
        log.configure("info", log_format)
        log.event("debug", "unseen")
        log.event("warning", "mode", was="drive", detail="two words", level="no level")
        log.close()
    text, line = capfd.readouterr().err.splitlines()
    assert text.endswith("Z WARNING mode was=drive detail='two words' level='no level'")
    fields = json.loads(line)
    assert fields.pop("time").endswith("Z")
    assert fields == {"level": "warning", "event": "mode", "was": "drive", "detail": "two words"}


def test_a_reader_of_the_log_that_stands_still_holds_nobody(monkeypatch):
    written = threading.Event()
    monkeypatch.setattr(log, "_FLUSH_S", 0.05)
    log.configure("info")
    (handler,) = log._LOGGER.handlers
    monkeypatch.setattr(handler._target, "handle", lambda record: written.wait(20.0))  # type: ignore[attr-defined]
    for _ in range(log._WAITING_LINES + 50):
        log.event("info", "line")
    log.close()
    written.set()
