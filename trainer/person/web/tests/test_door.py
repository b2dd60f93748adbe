"""Who is let in: token, origin, what may be said, and where it listens."""

import asyncio
import resource
import socket
import time
from contextlib import ExitStack, suppress

import aiohttp
import pytest

from edge_runtime.util import UserError
from trainer.person.registry import HUMANS, PersonOptions
from trainer.person.web import door
from trainer.person.web.cockpit import Cockpit
from trainer.person.web.messages import MAX_INPUT_BYTES
from trainer.person.web.tests.pages import WAIT_S, origin, page, say, until
from trainer.person.web.tests.readings import poll


async def status_of(url, **more):
    async with aiohttp.ClientSession() as session, session.get(url, **more) as answer:
        return answer.status, await answer.text(), answer.headers


def test_the_page_and_its_files_are_served_behind_the_token(cockpit):
    async def look():
        status, text, headers = await status_of(cockpit.url)
        assert status == 200
        assert "<title>PHIL cockpit</title>" in text
        assert headers["Referrer-Policy"] == "no-referrer"
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        for name in ("cockpit.js", "hands.js", "link.js", "gamepad.js", "scene.js", "cockpit.css"):
            assert (await status_of(cockpit.url + name))[0] == 200, name
        assert (await status_of(cockpit.url + "server.py"))[0] == 404
        assert (await status_of(cockpit.url + "..%2fserver.py"))[0] == 404
        assert (await status_of(cockpit.url.rstrip("/")))[0] == 200, "without the last slash"

    asyncio.run(look())


@pytest.mark.parametrize("path", ["", "wrong/", "wrong/cockpit.js", "wrong/socket", "socket"])
def test_without_the_token_nothing_is_shown(cockpit, path):
    status, text, _ = asyncio.run(status_of(f"{origin(cockpit)}/{path}"))
    assert status == 403
    assert "token" in text


@pytest.mark.parametrize(
    "words", [b"GET /\xff HTTP/1.1", b"\x16\x03\x01\x02\x00", b"GET / HTTP/9.9"]
)
def test_who_speaks_no_http_is_told_so_and_nobody_else(cockpit, caplog, words):
    with socket.create_connection(("127.0.0.1", cockpit.port), WAIT_S) as link:
        link.sendall(words + b"\r\nHost: x\r\n\r\n")
        assert b"400 Bad Request" in link.recv(200)
    cockpit.close()
    assert caplog.messages == []


@pytest.mark.parametrize("from_where", ["http://evil.example", "null", None])
def test_another_sites_page_gets_no_socket(cockpit, from_where):
    async def knock():
        async with page(cockpit, origin=from_where):
            pass

    with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
        asyncio.run(knock())
    assert refusal.value.status == 403
    assert not cockpit.present


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"at_ms": 1, "action": 1.5, "engaged": true}',
        '{"at_ms": 1, "action": NaN, "engaged": true}',
        '{"at_ms": 1, "action": 1e999, "engaged": true}',
        '{"at_ms": 1, "action": "1", "engaged": true}',
        '{"at_ms": 1, "action": 1, "engaged": true, "wishes": ["fly"]}',
        '{"at_ms": 1, "action": 1, "engaged": true, "admin": 1}',
        "[" * MAX_INPUT_BYTES,
        "x" * (MAX_INPUT_BYTES + 1),
        b"\x00",
    ],
)
def test_nonsense_closes_the_connection_and_lets_go(cockpit, text):
    async def talk_nonsense():
        async with page(cockpit) as link:
            await say(link)
            await say(link, True, 1.0)
            await (link.send_bytes if isinstance(text, bytes) else link.send_str)(text)
            while not (await link.receive(timeout=WAIT_S)).type.name.startswith("CLOS"):
                pass
        await until(lambda: not poll(cockpit).engaged)
        async with page(cockpit) as link:
            assert (await say(link))["driving"], "and it serves on"

    asyncio.run(talk_nonsense())


def test_a_port_in_use_is_a_plain_error(cockpit):
    with pytest.raises(UserError, match=f"cannot listen on 127.0.0.1 port {cockpit.port}"):
        HUMANS["web"](PersonOptions(port=cockpit.port))


def test_a_host_that_is_not_here_is_a_plain_error():
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        with pytest.raises(UserError, match="cannot listen on"):
            HUMANS["web"](PersonOptions(host="host.invalid"))


def test_the_address_is_printed_and_listening_to_the_network_is_warned_of(capsys):
    for host, warned in (("127.0.0.1", False), ("0.0.0.0", True)):
        person = HUMANS["web"](PersonOptions(host=host))
        out, err = capsys.readouterr()
        person.close()
        assert out.startswith("cockpit: open http://")
        assert ("warning: --host" in err) == warned


CROWD = 375


@pytest.fixture
def few_descriptors():
    """As many as a crowd of clients needs in this process, and the door with its pages besides."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket() as newest:
        enough = newest.fileno() + CROWD + door.MAX_CONNECTIONS + 40
    resource.setrlimit(resource.RLIMIT_NOFILE, (enough, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("few_descriptors")
@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.1\r\nHost: "])
def test_a_crowd_that_says_nothing_takes_no_descriptors_and_fills_no_log(cockpit, caplog, said):
    async def drive():
        async with page(cockpit) as link:
            await say(link)
            for _ in range(CROWD):
                stranger = idle.enter_context(
                    socket.create_connection(("127.0.0.1", cockpit.port), WAIT_S)
                )
                stranger.sendall(said)
                await say(link)  # A page that falls silent is shown out.
            assert (await status_of(cockpit.url))[0] == 200
            assert (await say(link))["driving"], "who was there first stays"

    with ExitStack() as idle:
        asyncio.run(drive())
    cockpit.close()
    assert caplog.messages == []


def test_a_full_house_of_pages_keeps_newcomers_out_and_lets_them_in_afterwards(
    cockpit, monkeypatch
):
    monkeypatch.setattr(door, "MAX_CONNECTIONS", 2)

    async def visit():
        async with page(cockpit) as first, page(cockpit) as second:
            for link in (first, second):
                await say(link)
            with pytest.raises(aiohttp.ClientError):
                await status_of(cockpit.url)
            await say(first)
        await until(lambda: not cockpit.present)
        assert (await status_of(cockpit.url))[0] == 200

    asyncio.run(visit())


@pytest.mark.parametrize("said", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: "])
def test_who_does_not_come_to_the_point_is_shown_out(cockpit, monkeypatch, said):
    monkeypatch.setattr(door, "HEADERS_S", 0.2)
    with socket.create_connection(("127.0.0.1", cockpit.port), WAIT_S) as stranger:
        stranger.sendall(said)
        began_s = time.monotonic()
        with suppress(ConnectionResetError):
            assert stranger.recv(1) == b""
        assert time.monotonic() - began_s < WAIT_S / 2


def test_a_connection_without_the_token_is_closed_with_the_answer(cockpit):
    with socket.create_connection(("127.0.0.1", cockpit.port), WAIT_S) as stranger:
        stranger.sendall(b"GET /wrong/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        answer = b""
        while part := stranger.recv(4096):
            answer += part
    assert b"403" in answer.partition(b"\r\n")[0]


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "[::1", "127.0.0.1.evil", ""]
)
def test_a_name_that_is_not_this_machines_is_refused(cockpit, host):
    """DNS rebinding: the other site's page would be of the same origin as the cockpit."""
    name = host.format(port=cockpit.port)

    async def knock():
        status, text, _ = await status_of(cockpit.url, headers={"Host": name})
        assert (status, "address" in text) == (421, True)
        with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
            async with page(cockpit, origin=f"http://{name}", headers={"Host": name}):
                pass
        assert refusal.value.status == 421

    asyncio.run(knock())


@pytest.mark.parametrize("host", ["localhost:7", "LOCALHOST", "[::1]:80", "127.0.0.1"])
def test_loopback_by_any_port_is_let_in_as_through_a_tunnel(cockpit, host):
    assert asyncio.run(status_of(cockpit.url, headers={"Host": host}))[0] == 200


@pytest.mark.parametrize("host", ["0.0.0.0", "127.0.0.2"])
def test_the_address_that_it_listens_on_is_let_in(host):
    cockpit = Cockpit(host=host)
    here = cockpit.url.replace(cockpit.url.split("/")[2], f"127.0.0.2:{cockpit.port}")
    try:
        assert asyncio.run(status_of(here))[0] == 200
        printed = {"Host": cockpit.url.split("/")[2]}
        assert asyncio.run(status_of(here, headers=printed))[0] == 200
        evil = {"Host": f"evil.example:{cockpit.port}"}
        assert asyncio.run(status_of(here, headers=evil))[0] == 421
    finally:
        cockpit.close()
