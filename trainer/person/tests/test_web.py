import argparse
import asyncio
import base64
import itertools
import json
import os
import queue
import resource
import socket
import time
import webbrowser
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import urlsplit

import aiohttp
import numpy as np
import pytest
import segno

from hil_tests.testing.browser import (
    WAIT_S,
    first_view,
    hear,
    origin,
    page,
    poll,
    reads,
    say,
    view_of_step,
)
from hil_tests.testing.people import LET_GO
from trainer.person import web
from trainer.person.interface import open_person
from trainer.person.web import MAX_INPUT_BYTES, Cockpit


async def test_what_a_page_holds_or_wishes_is_polled_and_its_closing_is_letting_go(cockpit):
    async with page(cockpit) as link:
        assert not cockpit.present
        echo = await say(link)
        assert echo == {"kind": "echo", "at_ms": 12.5, "driving": True, "refused": False}
        assert cockpit.present
        assert not (await say(link, True, -0.75, wishes=["pause", "restart"]))["refused"]
        reading = poll(cockpit)
        assert (reading.engaged, reading.action) == (True, -0.75)
        assert reading.wishes == {"pause", "restart"}
        assert not poll(cockpit).wishes
    await reads(cockpit, lambda reading: not reading.engaged)
    assert not cockpit.present


async def test_a_page_that_falls_silent_has_let_go_and_is_disconnected(cockpit, monkeypatch):
    monkeypatch.setattr(web, "GONE_S", 0.6)
    async with page(cockpit) as link:
        await say(link)
        await say(link, True, 1.0)
        said_s = time.monotonic()
        assert cockpit.poll(said_s).engaged
        assert cockpit.poll(said_s + 0.51) == LET_GO
        assert (await link.receive(timeout=WAIT_S)).type is aiohttp.WSMsgType.CLOSE


async def test_a_second_page_watches_until_the_first_is_gone(cockpit):
    async with page(cockpit) as first, page(cockpit) as watching:
        await say(first)
        assert not (await say(watching))["driving"]
        await say(watching, True, 1.0)
        assert not poll(cockpit).engaged
        await say(first, True, 0.5)
        assert poll(cockpit).action == 0.5
        await first.close()
        await reads(cockpit, lambda reading: not reading.engaged)
        assert (await say(watching))["driving"]


async def test_a_view_arrives_whole_and_a_page_that_comes_later_sees_the_newest(cockpit):
    expected = first_view()
    async with page(cockpit) as link:
        cockpit.show(expected)
        view = await hear(link, "view")
    frames = np.frombuffer(base64.b64decode(view["frames"]), np.uint8)
    assert frames.tobytes() == np.array(expected.frames).tobytes()
    assert view["scene"] == json.loads(json.dumps(expected.scene))
    seen = view["policy_action"], view["ground"]["left_m"], view["number"]
    assert seen == (0.25, -30.0, 1)
    for step in (1, 2):
        cockpit.show(view_of_step(step))
    async with page(cockpit) as link:
        assert (await hear(link, "view"))["step"] == 2


async def test_a_page_that_reads_nothing_holds_nobody_up(cockpit):
    """Its views and echoes pile up in front of a closed window; the loop's thread goes on."""
    reader, writer = await asyncio.open_connection("127.0.0.1", cockpit.port, limit=256)
    path = cockpit.url.partition(str(cockpit.port))[2]
    request = (
        f"GET {path}socket HTTP/1.1\r\nHost: 127.0.0.1:{cockpit.port}\r\n"
        f"Origin: {origin(cockpit)}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\n\r\n"
    )
    writer.write(request.encode())
    assert b"101" in await reader.readline()
    for step in range(2000):
        cockpit.show(view_of_step(step))
    async with page(cockpit) as link:
        assert (await hear(link, "view"))["step"] == 1999
    writer.close()


async def test_closing_tells_every_page_and_frees_the_port():
    cockpit = Cockpit()
    async with page(cockpit) as link:
        await say(link)
        cockpit.close()
        assert (await link.receive_json(timeout=WAIT_S))["kind"] == "end"
        assert (await link.receive(timeout=WAIT_S)).type is aiohttp.WSMsgType.CLOSE
    cockpit.close()
    cockpit.show(first_view())
    assert poll(cockpit) == LET_GO
    Cockpit(port=cockpit.port).close()


async def status_of(url, **more):
    async with aiohttp.ClientSession() as session, session.get(url, **more) as answer:
        return answer.status, await answer.text(), answer.headers


async def test_the_page_and_its_files_are_served_behind_the_token(cockpit):
    status, text, headers = await status_of(cockpit.url)
    assert (status, "<title>PHIL cockpit</title>" in text) == (200, True)
    assert 'rel="icon" href="data:' in text, "else browsers ask for one outside of the token"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert (headers["Cache-Control"], headers["X-Content-Type-Options"]) == ("no-store", "nosniff")
    served = [path.name for path in (Path(web.__file__).parent / "page").glob("*.[jc]s*")]
    for name in (*served, "server.py", "..%2fserver.py"):
        assert (await status_of(cockpit.url + name))[0] == (200 if name in served else 404), name
    assert (await status_of(cockpit.url.rstrip("/")))[0] == 200, "without the last slash"
    for path in ("", "wrong/", "wrong/cockpit.js", "wrong/socket", "socket"):
        status, text, _ = await status_of(f"{origin(cockpit)}/{path}")
        assert (status, "token" in text) == (403, True), path


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (b"GET /\xff HTTP/1.1", b"400 Bad Request"),
        (b"\x16\x03\x01\x02\x00", b"400 Bad Request"),
        (b"GET / HTTP/9.9", b"400 Bad Request"),
        (b"OPTIONS * HTTP/1.1", b"421 "),
        (b"GET /wrong/ HTTP/1.1\r\nHost: 127.0.0.1", b"403"),  # no token
    ],
)
def test_who_is_refused_is_told_so_and_disconnected_and_the_log_stays_empty(
    cockpit, caplog, words, answer
):
    with socket.create_connection(("127.0.0.1", cockpit.port), WAIT_S) as link:
        link.sendall(words + (b"" if b"Host" in words else b"\r\nHost: x") + b"\r\n\r\n")
        told = b""
        while part := link.recv(4096):
            told += part
    assert answer in told.partition(b"\r\n")[0]
    cockpit.close()
    assert caplog.messages == []


async def refusal(cockpit, **more):
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        async with page(cockpit, **more):
            pass
    return refused.value.status


async def test_another_sites_page_gets_no_socket(cockpit):
    for from_where in ("http://evil.example", "null", None):
        assert await refusal(cockpit, origin=from_where) == 403
    assert not cockpit.present


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        *(f'{{"at_ms": 1, "engaged": true, "action": {wrong}}}' for wrong in (
            "1.5", "NaN", "1e999", "[0.5, 0.9]", '"1"', '1, "wishes": ["fly"]', '1, "admin": 1',
        )),
        "[" * MAX_INPUT_BYTES,
        "x" * (MAX_INPUT_BYTES + 1),
        b"\x00",
    ],
)  # fmt: skip
async def test_nonsense_closes_the_connection_and_lets_go(cockpit, text):
    async with page(cockpit) as link:
        await say(link)
        await say(link, True, 1.0)
        await (link.send_bytes if isinstance(text, bytes) else link.send_str)(text)
        while not (await link.receive(timeout=WAIT_S)).type.name.startswith("CLOS"):
            pass
        assert link.close_code != aiohttp.WSCloseCode.GOING_AWAY, "it was its silence"
    await reads(cockpit, lambda reading: not reading.engaged)
    async with page(cockpit) as link:
        assert (await say(link))["driving"], "and it serves on"


def open_web(**options):
    given = {"human": "web", "scenario": "left_turn", "speed": 1.0}
    return open_person(argparse.Namespace(**given, **{"host": "127.0.0.1", "port": 0, **options}))


def test_the_address_is_printed_and_listening_to_the_network_is_warned_of(capsys):
    for host, warned in (("127.0.0.1", False), ("0.0.0.0", True), ("127.0.0.2", True)):
        cockpit = open_web(host=host)
        cockpit.close()
        out, err = capsys.readouterr()
        assert out.startswith("cockpit: open http://")
        assert ("warning: --host" in err) == warned
        assert (f"phone in this network: {cockpit.phone_url}\n" in out) == warned
    assert cockpit.phone_url == cockpit.url


async def test_where_there_is_a_display_the_browser_opens_by_an_address_for_one_request(
    monkeypatch,
):
    opened: queue.Queue[str] = queue.Queue()
    monkeypatch.setattr(webbrowser, "open", opened.put)
    open_web().close()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    with closing(open_web()) as cockpit:
        url = opened.get(timeout=WAIT_S)
        assert opened.empty(), "no browser without a display"
        assert cockpit.url not in url, "every user of this machine can read a command line"
        status, text, _ = await status_of(url)
        assert (status, "<title>PHIL cockpit</title>" in text) == (200, True)
        assert (await status_of(url))[0] == 403
        assert (await status_of(cockpit.url))[0] == 200


async def test_a_phone_gets_in_by_the_address_in_the_code_and_loopback_shows_none(
    cockpit, monkeypatch
):
    make = Mock(wraps=segno.make)
    monkeypatch.setattr(segno, "make", make)
    with closing(Cockpit("0.0.0.0")) as open_to_all:
        make.assert_called_once_with(open_to_all.phone_url)
        status, text, _ = await status_of(open_to_all.phone_url)
    assert status == 200
    assert 'src="data:image/svg' in text
    assert str(open_to_all.phone_url) in text
    assert urlsplit(open_to_all.phone_url).hostname not in ("0.0.0.0", *web.LOOPBACK)
    assert "data:image" not in (await status_of(cockpit.url))[1]


CROWD = 375


@pytest.fixture
def few_descriptors():
    """As many as a crowd of clients needs in this process, and the door with its pages besides."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    held = {int(name) for name in os.listdir("/dev/fd")}  # By earlier tests, anywhere.
    free = (number for number in itertools.count() if number not in held)
    enough = next(itertools.islice(free, CROWD + web.MAX_CONNECTIONS + 40, None))
    resource.setrlimit(resource.RLIMIT_NOFILE, (enough, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("few_descriptors")
@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.1\r\nHost: "])
async def test_a_crowd_that_says_nothing_takes_no_descriptors_and_fills_no_log(
    cockpit, caplog, said
):
    there = ("127.0.0.1", cockpit.port)
    with ExitStack() as idle:
        async with page(cockpit) as link:
            await say(link)
            for _ in range(CROWD):
                idle.enter_context(socket.create_connection(there, WAIT_S)).sendall(said)
                await say(link)  # A page that falls silent is disconnected.
            assert (await status_of(cockpit.url))[0] == 200
            assert (await say(link))["driving"], "the page that was there first stays"
    cockpit.close()
    assert caplog.messages == []


@pytest.mark.parametrize("said", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: "])
def test_a_client_that_sends_no_whole_request_is_cut_off(cockpit, monkeypatch, said):
    monkeypatch.setattr(web, "HEADERS_S", 0.2)
    with socket.create_connection(("127.0.0.1", cockpit.port), WAIT_S) as stranger:
        stranger.sendall(said)
        began_s = time.monotonic()
        with suppress(ConnectionResetError):
            assert stranger.recv(1) == b""
        assert time.monotonic() - began_s < WAIT_S / 2


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "[::1", "127.0.0.1.evil", ""]
)
async def test_a_name_that_is_not_this_machines_is_refused(cockpit, host):
    """DNS rebinding: the other site's page would be of the same origin as the cockpit."""
    headers = {"Host": host.format(port=cockpit.port)}
    status, text, _ = await status_of(cockpit.url, headers=headers)
    assert (status, "address" in text) == (421, True)
    assert await refusal(cockpit, origin=f"http://{headers['Host']}", headers=headers) == 421
    # Loopback is let in by any port, as through a tunnel.
    for here in ("localhost:7", "LOCALHOST", "[::1]:80", "127.0.0.1"):
        assert (await status_of(cockpit.url, headers={"Host": here}))[0] == 200


@pytest.mark.parametrize("host", ["0.0.0.0", "127.0.0.2"])
async def test_the_address_that_it_listens_on_is_let_in(host):
    with closing(Cockpit(host=host)) as cockpit:
        printed = cockpit.url.split("/")[2]
        here = cockpit.url.replace(printed, f"127.0.0.2:{cockpit.port}")
        assert (await status_of(here))[0] == 200
        assert (await status_of(here, headers={"Host": printed}))[0] == 200
        assert (await status_of(here, headers={"Host": f"evil.example:{cockpit.port}"}))[0] == 421
