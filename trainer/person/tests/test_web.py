import argparse
import queue
import webbrowser
from contextlib import closing
from pathlib import Path

import aiohttp
import pytest

from trainer.environments import make_environment
from trainer.person import web
from trainer.person.tests.browser import (
    WAIT_S,
    origin,
    page,
    reads,
    say,
)
from trainer.person.web import MAX_INPUT_BYTES, Cockpit

LEFT_TURN = make_environment("left_turn")


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
        assert (await status_of(f"{origin(cockpit)}/{path}"))[0] == 404, path


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
    given = {"host": "127.0.0.1", "port": 0}
    return web.open_cockpit(argparse.Namespace(**given | options), LEFT_TURN)


def test_the_address_is_printed_and_listening_to_the_network_is_warned_of(capsys):
    for host, warned in (("127.0.0.1", False), ("0.0.0.0", True), ("127.0.0.2", True)):
        cockpit = open_web(host=host)
        cockpit.close()
        out, err = capsys.readouterr()
        assert ("warning: --host" in err) == warned
        assert out == f"cockpit: open {cockpit.url}\n"


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
    with closing(Cockpit(LEFT_TURN, host="0.0.0.0")) as cockpit:
        printed = cockpit.url.split("/")[2]
        here = cockpit.url.replace(printed, f"127.0.0.2:{cockpit.port}")
        assert (await status_of(here))[0] == 200
        assert (await status_of(here, headers={"Host": printed}))[0] == 200
        assert (await status_of(here, headers={"Host": f"evil.example:{cockpit.port}"}))[0] == 421
