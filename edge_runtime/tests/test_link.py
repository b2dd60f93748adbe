"""The edge's end of the wire without a network: a session that only notes what is asked of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, List

import pytest

from edge_runtime import run_command
from edge_runtime.config import Config
from edge_runtime.errors import UserError
from edge_runtime.link import Link
from edge_runtime.presence import Presence, require_free
from edge_runtime.wire import Health

HEALTH = Health(
    vehicle_id="hunter01", vehicle="none", mode="standby", reason="", needs_rearm=False,
    accepted=0, superseded=0, rejected={}, deadline_misses=0, safe_stops=0, policy_id="p",
    inference_ms={}, uptime_s=0.0, sent_ns=0,
)  # fmt: skip


class FakeSession:
    """Notes declarations; `routers` are those that are connected."""

    def __init__(self, fails: bool = False) -> None:
        self.routers: List[str] = []
        self.sent = 0
        self.events: List[str] = []
        self.info = SimpleNamespace(routers_zid=lambda: list(self.routers))
        self._fails = fails

    def liveliness(self) -> Any:
        return self

    def get(self, *_: Any, **__: Any) -> list:
        return []

    def declare_token(self, key: str) -> Any:
        self.events.append(f"declare {key}")
        return SimpleNamespace(undeclare=self._undeclare)

    def declare_publisher(self, key: str, **_: Any) -> Any:
        return SimpleNamespace(undeclare=self._undeclare, put=self._put)

    def close(self) -> None:
        self.events.append("close")

    def _put(self, payload: bytes) -> None:
        self.sent += 1

    def _undeclare(self) -> None:
        self.events.append("undeclare")
        if self._fails:
            raise OSError("gone")


def make_presence(session: Any, give_way: Any = None, open_client: Any = None) -> Presence:
    client: Any = open_client or Router().open
    return Presence(session, "k", client, give_way or (lambda: None))


def test_the_tokens_are_declared_again_for_each_router_that_comes():
    session: Any = FakeSession()
    presence = make_presence(session)
    claims = [presence.claim]
    for routers in ([], ["b", "a"], ["a", "b"], [], ["c"], ["c"]):
        session.routers = routers
        if presence.refresh():
            claims.append(presence.claim)
    assert claims == sorted(set(claims))  # each is younger than the one before
    expected = [["declare k", f"declare k/{claim}"] for claim in claims]
    gone = ["undeclare", "undeclare"]
    assert session.events == [*expected[0], *gone, *expected[1], *gone, *expected[2]]
    presence.undeclare()
    assert session.events[-2:] == gone


class Router:
    """What a client session hears of a router that knows these tokens."""

    def __init__(self) -> None:
        self.tokens: List[str] = []

    def open(self) -> Any:
        ok = [SimpleNamespace(ok=SimpleNamespace(key_expr=token)) for token in self.tokens]
        liveliness = SimpleNamespace(get=lambda selector, timeout: ok)
        return SimpleNamespace(liveliness=lambda: liveliness, close=lambda: None)


def test_the_younger_of_two_gives_way_at_the_second_look():
    session: Any = FakeSession()
    router, calls = Router(), []
    presence = make_presence(session, lambda: calls.append("way"), router.open)
    router.tokens = [f"k/{presence.claim}", "k/0000000000000001-elder"]
    presence.look()
    assert calls == []  # it may be the leftover of a lost connection
    presence.look()
    presence.look()
    assert calls == ["way"]
    assert presence.rivals == 1


def test_the_elder_of_two_goes_on_and_counts():
    session: Any = FakeSession()
    router, calls = Router(), []
    presence = make_presence(session, lambda: calls.append("way"), router.open)
    for claim in ("f" * 16, "f" * 16, "e" * 16, "f" * 16, "e" * 16, "e" * 16):
        router.tokens = [f"k/{presence.claim}", f"k/{claim}"]
        presence.look()
    assert (calls, presence.rivals) == ([], 2)


def test_nobody_there_is_nobody_else():
    session: Any = FakeSession()

    def fail() -> Any:
        raise UserError("nobody answers")

    presence = make_presence(session, open_client=fail)
    presence.look()
    presence.look()
    assert presence.rivals == 0
    assert not require_free(fail, "k", "hunter01")
    assert require_free(Router().open, "k", "hunter01")


def test_a_muted_link_sends_nothing():
    session: Any = FakeSession()
    manifest: Any = None
    link = Link(session, "hunter01", manifest)
    link.send("health", HEALTH)
    assert session.sent == 1
    link.mute()
    link.send("health", HEALTH)
    assert session.sent == 1


def test_only_a_query_by_its_own_name_re_arms():
    session: Any = FakeSession()
    manifest: Any = None
    asked: dict = {}
    session.declare_subscriber = lambda key, handler: None
    session.declare_queryable = asked.__setitem__
    calls: List[str] = []

    def rearm() -> str:
        calls.append("rearm")
        return ""

    Link(session, "hunter01", manifest).declare(lambda payload: None, lambda: HEALTH, rearm)
    for selector in ("phil/**", "phil/*/rearm", "phil/hunter01/*", "phil/hunter01/re$*"):
        asked["phil/hunter01/rearm"](query_of(selector))
    assert calls == []  # somebody looked at everything that is there
    asked["phil/hunter01/rearm"](query_of("phil/hunter01/rearm"))
    assert calls == ["rearm"]


def query_of(selector: str) -> Any:
    return SimpleNamespace(key_expr=selector, reply=lambda *_, **__: None)


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
    arguments: List[Any] = [Config(), None, unused, None, None, None]
    with pytest.raises(OSError, match="no link"):
        run_command._serve(*arguments)
    assert session.events == ["close"] * 2  # the one that asked for other runtimes, and its own
