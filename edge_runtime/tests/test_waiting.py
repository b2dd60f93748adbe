"""Why there is no link, by real sockets; and when it is said, in made-up time."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import List

import pytest

from edge_runtime import log, waiting
from edge_runtime.errors import UserError
from edge_runtime.link_probe import why_no_link
from edge_runtime.transport import free_endpoint, open_session
from edge_runtime.waiting import Waiting


@contextlib.contextmanager
def server(answer):
    """Accepts on loopback and answers each connection with these bytes, then closes it."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def run():
            with contextlib.suppress(OSError):
                while True:
                    link, _ = listening.accept()
                    with link:
                        link.recv(1)
                        link.sendall(answer)

        threading.Thread(target=run, daemon=True).start()
        yield f"tcp/127.0.0.1:{listening.getsockname()[1]}"


def test_a_host_that_does_not_exist_and_a_name_that_cannot_be():
    assert "host 'no-such-host.invalid' cannot be" in why_no_link(
        "tcp/no-such-host.invalid:1", None
    )
    assert "host 'a..b' cannot be resolved" in why_no_link("tcp/a..b:7447", None)
    assert "host 'a..b' cannot be resolved" in why_no_link("udp/a..b:7447", None)
    with pytest.raises(UserError, match=r"host 'a\.\.b' of endpoint .* cannot be resolved"):
        open_session(listen="tcp/a..b:7447", mode="router")


def test_a_port_where_nobody_listens():
    endpoint = free_endpoint()
    port = endpoint.rsplit(":", 1)[1]
    assert why_no_link(endpoint, None) == (
        f"nobody listens on port {port} of 127.0.0.1 (connection refused)"
    )


def test_a_server_that_speaks_tls_and_one_that_speaks_something_else():
    alert = b"\x15\x03\x03\x00\x02\x02\x28"  # TLS 1.2, fatal, handshake failure
    with server(alert) as endpoint:
        assert "listens with TLS and wants --tls" in why_no_link(endpoint, None)
    with server(b"SSH-2.0-OpenSSH_9.6\r\n") as endpoint:
        assert "answers, but not as a simulator" in why_no_link(endpoint, None)


def test_it_is_said_at_once_and_every_five_seconds_until_a_state_came(monkeypatch):
    said: List[str] = []
    heard: List[str] = []
    monkeypatch.setattr(log, "event", lambda level, name, **fields: said.append(fields["why"]))
    look = Waiting(lambda: bool(heard), lambda: f"because {len(said)}").look
    assert [look(now_s) for now_s in (100.0, 100.1, 104.9)] == [True] * 3
    assert said == ["because 0"]
    assert look(105.0)
    assert look(109.9)
    assert said == ["because 0", "because 1"]
    heard.append("a state")
    assert not look(110.0)
    assert len(said) == 2


def test_a_state_that_comes_during_the_look_is_not_waited_for(monkeypatch):
    said: List[dict] = []
    heard: List[str] = []
    monkeypatch.setattr(log, "event", lambda *_, **fields: said.append(fields))

    def why():
        heard.append("a state")
        return "too late"

    assert Waiting(lambda: bool(heard), why).look(0.0)
    assert said == []


def test_one_that_is_linked_has_time_for_its_first_state(monkeypatch):
    said = threading.Event()
    monkeypatch.setattr(waiting.log, "event", lambda *_, **fields: said.set())
    one = Waiting(lambda: False, lambda: "why")
    one.start(is_linked=True)
    assert not said.wait(0.3)
    one.stop()
