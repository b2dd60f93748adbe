import argparse
import asyncio
import itertools
import os
import queue
import resource
import socket
import time
import webbrowser
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import aiohttp
import pytest

from trainer.person import web
from trainer.person.interface import open_person
from trainer.person.tests.browser import (
    WAIT_S,
    hear,
    origin,
    page,
    reads,
    say,
    view_of_step,
)
from trainer.person.web import MAX_INPUT_BYTES, Cockpit


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


async def status_of(url, **more):
    async with aiohttp.ClientSession() as session, session.get(url, **more) as answer:
        return answer.status, await answer.text(), answer.headers


async def test_the_page_and_its_files_are_served_behind_the_token(cockpit):
    status, _, headers = await status_of(cockpit.url)
    assert (status, headers["Referrer-Policy"]) == (200, "no-referrer")
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    served = [path.name for path in (Path(web.__file__).parent / "page").glob("*.[jc]s*")]
    for name in (*served, "server.py", "..%2fserver.py"):
        assert (await status_of(cockpit.url + name))[0] == (200 if name in served else 404), name
    for path in ("", "wrong/", "wrong/cockpit.js", "wrong/socket", "socket"):
        assert (await status_of(f"{origin(cockpit)}/{path}"))[0] == 403, path


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (b"\x16\x03\x01\x02\x00", b"400 Bad Request"),
        (b"OPTIONS * HTTP/1.1", b"421 "),
        (b"GET /wrong/ HTTP/1.1\r\nHost: 127.0.0.1", b"403"),  # no token
    ],
)
def test_who_is_refused_is_disconnected_and_the_log_stays_empty(cockpit, caplog, words, answer):
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
        "{}",
        *(f'{{"at_ms": 1, "engaged": true, "action": {wrong}}}' for wrong in (
            "1.5", "NaN", "[0.5, 0.9]", '1, "wishes": ["fly"]',
        )),
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
        assert ("warning: --host" in err) == warned
        assert (f"phone in this network: {cockpit.phone_url}\n" in out) == warned


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
        assert (await status_of(url))[0] == 200
        assert (await status_of(url))[0] == 403
        assert (await status_of(cockpit.url))[0] == 200


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
async def test_a_crowd_that_says_little_takes_no_descriptors_and_fills_no_log(cockpit, caplog):
    there = ("127.0.0.1", cockpit.port)
    with ExitStack() as idle:
        async with page(cockpit) as link:
            await say(link)
            for _ in range(CROWD):
                idle.enter_context(socket.create_connection(there, WAIT_S)).sendall(b"GET /")
                await say(link)  # A page that falls silent is disconnected.
            assert (await status_of(cockpit.url))[0] == 200
            assert (await say(link))["driving"], "the page that was there first stays"
    cockpit.close()
    assert caplog.messages == []


def test_a_client_that_sends_no_whole_request_is_cut_off(cockpit, monkeypatch):
    monkeypatch.setattr(web, "HEADERS_S", 0.2)
    with socket.create_connection(("127.0.0.1", cockpit.port), WAIT_S) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ")
        began_s = time.monotonic()
        with suppress(ConnectionResetError):
            assert stranger.recv(1) == b""
        assert time.monotonic() - began_s < WAIT_S / 2


@pytest.mark.parametrize("host", ["evil.example:{port}", "[::1", "127.0.0.1.evil"])
async def test_a_name_that_is_not_this_machines_is_refused(cockpit, host):
    """DNS rebinding: the other site's page would be of the same origin as the cockpit."""
    headers = {"Host": host.format(port=cockpit.port)}
    assert (await status_of(cockpit.url, headers=headers))[0] == 421
    assert await refusal(cockpit, origin=f"http://{headers['Host']}", headers=headers) == 421
    # Loopback is let in by any port, as through a tunnel.
    for here in ("LOCALHOST:7", "[::1]:80"):
        assert (await status_of(cockpit.url, headers={"Host": here}))[0] == 200


async def test_the_address_that_it_listens_on_is_let_in():
    with closing(Cockpit(host="0.0.0.0")) as cockpit:
        printed = cockpit.url.split("/")[2]
        here = cockpit.url.replace(printed, f"127.0.0.2:{cockpit.port}")
        assert (await status_of(here))[0] == 200
        assert (await status_of(here, headers={"Host": printed}))[0] == 200
        assert (await status_of(here, headers={"Host": f"evil.example:{cockpit.port}"}))[0] == 421
