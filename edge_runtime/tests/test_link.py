"""The edge's end of the wire without a network: a session that only notes what is asked of it."""

from __future__ import annotations

import contextlib
import socketserver
import threading
import time
from types import SimpleNamespace
from typing import Any, List

import pytest

from edge_runtime import log, run
from edge_runtime.config import Config
from edge_runtime.link import Link, Presence, require_free
from edge_runtime.run import Waiting
from edge_runtime.transport import look, open_session
from edge_runtime.util import UserError
from edge_runtime.wire import Health

HEALTH = Health(
    vehicle_id="hunter01", vehicle="none", mode="standby", reason="", needs_rearm=False,
    accepted=0, superseded=0, rejected={}, deadline_misses=0, safe_stops=0, policy_id="p",
    inference_ms={}, uptime_s=0.0, sent_ns=0,
)  # fmt: skip
NO_MANIFEST: Any = None


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


def make_presence(session: Any, calls: Any = None, open_client: Any = None) -> Presence:
    client: Any = open_client or Router().open
    return Presence(session, "k", client, lambda: calls.append("way"))


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
    router, calls = Router(), []
    presence = make_presence(FakeSession(), calls, router.open)
    router.tokens = [f"k/{presence.claim}", "k/0000000000000001-elder"]
    presence.look()
    assert calls == []  # it may be the leftover of a lost connection
    presence.look()
    presence.look()
    assert (calls, presence.rivals) == (["way"], 1)


def test_the_elder_of_two_goes_on_and_counts():
    router, calls = Router(), []
    presence = make_presence(FakeSession(), calls, router.open)
    for claim in ("f" * 16, "f" * 16, "e" * 16, "f" * 16, "e" * 16, "e" * 16):
        router.tokens = [f"k/{presence.claim}", f"k/{claim}"]
        presence.look()
    assert (calls, presence.rivals) == ([], 2)


def test_nobody_there_is_nobody_else():
    def fail() -> Any:
        raise UserError("nobody answers")

    presence = make_presence(FakeSession(), open_client=fail)
    presence.look()
    presence.look()
    assert presence.rivals == 0
    assert not require_free(fail, "hunter01")
    assert require_free(Router().open, "hunter01")


def test_a_link_that_gave_way_sends_nothing():
    session: Any = FakeSession()
    link = Link(session, "hunter01", NO_MANIFEST)
    link.send("health", HEALTH)
    link.gave_way = True
    link.send("health", HEALTH)
    assert session.sent == 1


def test_only_a_query_by_its_own_name_re_arms():
    session: Any = FakeSession()
    asked: dict = {}
    session.declare_subscriber = lambda key, handler: None
    session.declare_queryable = asked.__setitem__
    calls: List[str] = []

    def rearm() -> str:
        calls.append("rearm")
        return ""

    link = Link(session, "hunter01", NO_MANIFEST)
    link.declare(lambda payload: None, lambda: HEALTH, rearm)

    def ask(selector: str) -> None:
        query = SimpleNamespace(key_expr=selector, reply=lambda *_, **__: None)
        asked["phil/hunter01/rearm"](query)

    for selector in ("phil/**", "phil/*/rearm", "phil/hunter01/*", "phil/hunter01/re$*"):
        ask(selector)
    assert calls == []  # somebody looked at everything that is there
    ask("phil/hunter01/rearm")
    assert calls == ["rearm"]


def test_the_session_is_closed_even_where_nothing_can_be_undeclared():
    session: Any = FakeSession(fails=True)
    with pytest.raises(OSError, match="gone"):
        Link(session, "hunter01", NO_MANIFEST).close()
    assert session.events[-1] == "close"


def test_the_session_is_closed_where_the_link_cannot_be_made(monkeypatch):
    session, stop = FakeSession(), None
    policy = SimpleNamespace(manifest=SimpleNamespace(action=[], task=""))

    def fail(*_: Any) -> None:
        raise OSError("no link")

    monkeypatch.setattr(run, "load_policy", lambda *_: policy)
    monkeypatch.setattr(run, "open_session", lambda **_: session)
    monkeypatch.setattr(run, "Link", fail)
    with pytest.raises(OSError, match="no link"):
        run._drive(Config(), stop)  # type: ignore[arg-type]
    assert session.events == ["close"] * 2  # the one that asked for other runtimes, and its own


@contextlib.contextmanager
def server(answer):
    """Answers each connection with these bytes, then closes it."""

    class Answers(socketserver.BaseRequestHandler):
        def handle(self):
            self.request.recv(1)
            self.request.sendall(answer)

    with socketserver.TCPServer(("127.0.0.1", 0), Answers) as listening:
        threading.Thread(target=listening.serve_forever, daemon=True).start()
        yield f"tcp/127.0.0.1:{listening.server_address[1]}"
        listening.shutdown()


def test_a_host_that_does_not_exist_and_a_name_that_cannot_be():
    for endpoint in ("tcp/no-such-host.invalid:1", "tcp/a..b:7447", "udp/a..b:7447"):
        answers, why = look(endpoint, None)
        assert not answers
        assert f"host '{endpoint[4:].split(':')[0]}' cannot be resolved" in why
    with pytest.raises(UserError, match=r"host 'a\.\.b' of endpoint .* cannot be resolved"):
        open_session(listen="tcp/a..b:7447", mode="router")


TLS_ALERT = b"\x15\x03\x03\x00\x02\x02\x28"  # TLS 1.2, fatal, handshake failure


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (TLS_ALERT, "listens with TLS and wants --tls"),
        (b"SSH-2.0-OpenSSH_9.6\r\n", "answers, but not as a simulator"),
    ],
)
def test_a_server_that_speaks_tls_and_one_that_speaks_something_else(answer, words):
    with server(answer) as endpoint:
        assert words in look(endpoint, None)[1]


@pytest.fixture
def said(monkeypatch) -> List[str]:
    """Why it waits, of each line in the log."""
    lines: List[str] = []
    monkeypatch.setattr(log, "event", lambda level, name, **fields: lines.append(fields["why"]))
    return lines


def test_it_is_said_at_once_and_every_five_seconds_until_a_state_came(said):
    heard: List[str] = []
    look = Waiting(lambda: bool(heard), lambda: f"because {len(said)}").look
    assert [look(now_s) for now_s in (100.0, 100.1, 104.9)] == [True] * 3
    assert said == ["because 0"]
    assert [look(now_s) for now_s in (105.0, 109.9)] == [True] * 2
    assert said == ["because 0", "because 1"]
    heard.append("a state")
    assert not look(110.0)
    assert len(said) == 2


def test_a_state_that_comes_during_the_look_is_not_waited_for(said):
    heard: List[str] = []

    def why() -> str:
        heard.append("a state")
        return "too late"

    assert Waiting(lambda: bool(heard), why).look(0.0)
    assert said == []


def test_one_that_is_linked_has_time_for_its_first_state(said):
    one = Waiting(lambda: False, lambda: "why")
    one.next_s = time.monotonic() + 5.0
    one.start()
    time.sleep(0.3)
    assert said == []
    one.ended.set()
