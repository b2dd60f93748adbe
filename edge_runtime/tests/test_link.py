"""The edge's end of the wire without a network: a session that only notes what is asked of it."""

import contextlib
import math
import ssl
import time
from datetime import datetime, timezone
from types import SimpleNamespace
from typing import Any, List
from unittest.mock import MagicMock

import pytest
import zenoh
from hil_tests.processes import wait_until
from hil_tests.tests.shared.messages import HEALTH
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_runtime import reach, run
from edge_runtime.config import Config
from edge_runtime.link import Link, Presence, require_free
from edge_runtime.reach import Listener
from edge_runtime.tls import TlsFiles
from edge_runtime.transport import open_session
from edge_runtime.util import UserError
from edge_runtime.wire import Reason


@pytest.fixture
def session() -> Any:
    """Nobody else is there; `routers_zid` gives the routers that are connected."""
    session = MagicMock()
    session.liveliness().get.return_value = []
    session.info.routers_zid.return_value = []
    return session


def declared(session: Any) -> List[str]:
    """The tokens in order, and "" where one was taken back."""
    calls = [(name, args) for name, args, _ in session.mock_calls if "declare" in name]
    return [args[0] if args else "" for _, args in calls]


def test_the_tokens_are_declared_again_for_each_router_that_comes(session):
    listener = MagicMock()
    presence = Presence(session, "k", lambda: session, lambda: None, listener)
    claims = [presence.claim]
    for routers in ([], ["b", "a"], ["a", "b"], [], ["c"], ["c"]):
        session.info.routers_zid.return_value = routers
        presence.refresh()
        if presence.claim != claims[-1]:
            claims.append(presence.claim)
            assert listener.look.call_count == len(claims) - 1  # before it sees the tokens
    assert claims == sorted(set(claims))  # each is younger than the one before
    first, *later = [["k", f"k/{claim}"] for claim in claims]
    assert declared(session) == [*first, *(key for keys in later for key in ["", "", *keys])]
    presence.undeclare()
    assert declared(session)[-2:] == ["", ""]


@pytest.mark.parametrize(
    ("claims", "given", "rivals"),
    [
        # At first an elder one may be the leftover of a lost connection.
        (["0000000000000001-elder"] * 3, [False, True, True], 1),
        ([letter * 16 for letter in "ffefee"], [False] * 6, 2),
    ],
)
def test_of_two_runtimes_the_younger_gives_way_and_the_elder_counts(session, claims, given, rivals):
    give_way = MagicMock()
    presence = Presence(session, "k", lambda: session, give_way)
    for claim, gives in zip(claims, given):
        keys = [f"k/{presence.claim}", f"k/{claim}"]
        replies = [SimpleNamespace(ok=SimpleNamespace(key_expr=key)) for key in keys]
        session.liveliness().get.return_value = replies
        presence.look()
        assert give_way.called == gives
    assert presence.rivals == rivals


OWN_S = 250
FILES = TlsFiles("ca", "cert", "key", "edge-a", datetime.fromtimestamp(OWN_S, timezone.utc))
LOOKS = st.one_of(st.integers(0, 300), st.sampled_from(["gone", "not believed"]))
"""The second of 1970 at which the certificate expires that a look finds, or what it finds else."""


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(LOOKS, st.lists(st.floats(-10.0, 310.0)))))
def test_states_are_taken_only_while_our_certificate_holds_and_the_one_seen_last(story):
    disbelieved = ssl.SSLCertVerificationError()
    disbelieved.verify_message = "of another authority"
    found: Any = "gone"  # nobody is there yet

    def connect(*_: Any, **__: Any) -> Any:
        if found == "gone":
            raise OSError(found)
        return contextlib.nullcontext()

    def shown() -> Any:
        if found == "not believed":
            raise disbelieved
        return {"notAfter": time.strftime("%b %d %H:%M:%S %Y GMT", time.gmtime(found))}

    link = contextlib.nullcontext(SimpleNamespace(getpeercert=shown))
    context = MagicMock(wrap_socket=lambda *_, **__: link)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reach.ssl, "SSLContext", lambda kind: context)
        patch.setattr(reach.socket, "create_connection", connect)
        listener = Listener("tls/board:7447", FILES)
        until_s = -math.inf
        for found, times_s in story:
            if found != "gone":
                until_s = found if isinstance(found, int) else -math.inf
            listener.look()
            for now_s in times_s:
                refusal = listener.refusal(now_s)
                assert (refusal is None) == (now_s < min(until_s, OWN_S))
                assert refusal is None or refusal.reason is Reason.CERTIFICATE


def test_nobody_there_is_nobody_else(session):
    fail = MagicMock(side_effect=UserError("nobody answers"))
    presence = Presence(session, "k", fail, fail)
    for _ in range(2):
        presence.look()
    assert presence.rivals == 0
    require_free(fail, "hunter01")
    require_free(lambda: session, "hunter01")


def test_tokens_that_could_not_be_declared_are_tried_again(session):
    declare = session.liveliness().declare_token
    presence = Presence(session, "k", lambda: session, lambda: None)
    before = list(presence._tokens)
    session.info.routers_zid.return_value = ["router"]
    declare.side_effect = [zenoh.ZError("not now"), MagicMock(), MagicMock()]
    presence.thread.start()
    wait_until(lambda: declare.call_count == 5, "the second try")
    presence.undeclare()
    assert not presence.thread.is_alive()
    assert [token.undeclare.call_count for token in before] == [2, 2]  # one mock, once each


@pytest.fixture
def link(session) -> Link:
    return Link(session, "hunter01", MagicMock())


def test_a_link_that_gave_way_sends_nothing(session, link):
    for link.gave_way in (False, True):
        link.send("health", HEALTH)
    assert session.declare_publisher().put.call_count == 1


def test_a_link_whose_own_certificate_has_expired_ends_the_run(session, link):
    stop = MagicMock()
    link.listener = SimpleNamespace(own_until_s=time.time() + 3600.0)
    link.appear(lambda: session, stop)
    link.send("health", HEALTH)
    assert not stop.called
    link.listener.own_until_s = time.time()
    link.send("health", HEALTH)
    assert stop.called
    link.close()


def test_only_a_query_by_its_own_name_re_arms(session, link):
    rearm = MagicMock(return_value="")
    link.declare(lambda payload: None, lambda: HEALTH, rearm, 0)
    asked = dict(call.args for call in session.declare_queryable.call_args_list)
    for selector in ("phil/**", "phil/*/rearm", "phil/hunter01/*", "phil/hunter01/re$*"):
        asked["phil/hunter01/rearm"](MagicMock(key_expr=selector))
    assert not rearm.called  # somebody looked at everything that is there
    for payload in (None, b"a/0/1\xff"):
        query = MagicMock(key_expr="phil/hunter01/rearm", payload=payload)
        asked["phil/hunter01/rearm"](query)
    assert [call.args for call in rearm.call_args_list] == [("",), ("a/0/1\ufffd",)]


def test_the_session_is_closed_whatever_fails(session, link, monkeypatch):
    session.declare_publisher().undeclare.side_effect = OSError("gone")
    with pytest.raises(OSError, match="gone"):
        link.close()
    assert session.close.call_count == 1
    monkeypatch.setattr(run, "load_policy", lambda *_: MagicMock())
    monkeypatch.setattr(run, "open_session", lambda **_: session)
    monkeypatch.setattr(run, "Link", MagicMock(side_effect=OSError("no link")))
    with pytest.raises(OSError, match="no link"), contextlib.ExitStack() as unbuilt:
        run._Runtime(Config(), None, unbuilt)
    assert session.close.call_count == 3  # the one that asked for other runtimes, and its own


def test_a_host_that_cannot_be():
    with pytest.raises(UserError, match="no-such-host"):
        open_session(connect="tcp/no-such-host.invalid:1", mode="client")
    with pytest.raises(UserError, match=r"a\.\.b"):
        open_session(listen="tcp/a..b:7447", mode="router")
