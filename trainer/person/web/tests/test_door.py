"""Who is let in: token, origin, what may be said, and where it listens."""

import asyncio
import socket

import aiohttp
import pytest

from edge_runtime.errors import UserError
from trainer.person.registry import HUMANS, PersonOptions
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
