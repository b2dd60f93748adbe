"""The edge's end of the wire without a network: a session that only notes what is asked of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, List

import pytest

from edge_runtime import run_command
from edge_runtime.config import Config
from edge_runtime.link import Link
from edge_runtime.presence import Presence


class FakeSession:
    """Notes declarations; `routers` are those that are connected."""

    def __init__(self, fails: bool = False) -> None:
        self.routers: List[str] = []
        self.events: List[str] = []
        self.info = SimpleNamespace(routers_zid=lambda: list(self.routers))
        self._fails = fails

    def liveliness(self) -> Any:
        return self

    def declare_token(self, key: str) -> Any:
        self.events.append(f"declare {key}")
        return SimpleNamespace(undeclare=self._undeclare)

    def declare_publisher(self, key: str, **_: Any) -> Any:
        return SimpleNamespace(undeclare=self._undeclare)

    def close(self) -> None:
        self.events.append("close")

    def _undeclare(self) -> None:
        self.events.append("undeclare")
        if self._fails:
            raise OSError("gone")


def test_the_token_is_declared_again_for_each_router_that_comes():
    session: Any = FakeSession()
    presence = Presence(session, "k")
    for routers in ([], ["b", "a"], ["a", "b"], [], ["c"], ["c"]):
        session.routers = routers
        presence.refresh()
    assert session.events == ["declare k", *["undeclare", "declare k"] * 2]
    presence.undeclare()
    assert session.events[-1] == "undeclare"


def test_the_session_is_closed_even_where_nothing_can_be_undeclared():
    session: Any = FakeSession(fails=True)
    manifest: Any = None
    link = Link(session, "hunter01", manifest)
    with pytest.raises(OSError, match="gone"):
        link.close()
    assert session.events[-1] == "close"


def test_the_session_is_closed_where_the_link_cannot_be_made(monkeypatch):
    session, unused = FakeSession(), SimpleNamespace(manifest=None)

    def fail(*_: Any) -> None:
        raise OSError("no link")

    monkeypatch.setattr(run_command, "open_session", lambda **_: session)
    monkeypatch.setattr(run_command, "Link", fail)
    arguments: List[Any] = [Config(), unused, None, None, None]
    with pytest.raises(OSError, match="no link"):
        run_command._serve(*arguments)
    assert session.events == ["close"]
