"""What the server hears from pages and shows them; with real clients."""

import asyncio
import base64
import json
import socket
import struct
import time

import aiohttp
import numpy as np

from trainer.person.interface import LET_GO
from trainer.person.web.cockpit import Cockpit
from trainer.person.web.server import VIEWS_UNDERWAY
from trainer.person.web.tests.pages import WAIT_S, hear, origin, page, say, until
from trainer.person.web.tests.readings import poll
from trainer.person.web.tests.views import first_view, view_of_step

RESET = struct.pack("ii", 1, 0)
"""SO_LINGER that closes without a good-bye."""


def test_what_a_page_holds_is_polled_and_its_closing_is_letting_go(cockpit):
    async def drive():
        async with page(cockpit) as link:
            assert not cockpit.present
            echo = await say(link)
            assert echo == {"kind": "echo", "at_ms": 12.5, "driving": True, "refused": False}
            assert cockpit.present
            assert not (await say(link, True, -0.75))["refused"]
            reading = poll(cockpit)
            assert (reading.engaged, reading.action) == (True, -0.75)
        await until(lambda: not poll(cockpit).engaged)
        assert not cockpit.present

    asyncio.run(drive())


def test_a_page_that_falls_silent_has_let_go_and_is_shown_out(cockpit):
    async def drive():
        async with page(cockpit) as link:
            await say(link)
            await say(link, True, 1.0)
            said_s = time.monotonic()
            assert cockpit.poll(said_s).engaged
            assert cockpit.poll(said_s + 0.51) == LET_GO
            message = await link.receive(timeout=WAIT_S)
            assert message.type is aiohttp.WSMsgType.CLOSE

    asyncio.run(drive())


def test_a_second_page_watches_until_the_first_is_gone(cockpit):
    async def drive():
        async with page(cockpit) as first:
            await say(first)
            async with page(cockpit) as watching:
                assert not (await say(watching))["driving"]
                await say(watching, True, 1.0)
                assert not poll(cockpit).engaged
                await say(first, True, 0.5)
                assert poll(cockpit).action == 0.5
                await first.close()
                await until(lambda: not poll(cockpit).engaged)
                assert (await say(watching))["driving"]

    asyncio.run(drive())


def test_a_view_arrives_whole(cockpit):
    async def look():
        async with page(cockpit) as link:
            cockpit.show(first_view())
            view = await hear(link, "view")
            expected = first_view()
            frames = np.frombuffer(base64.b64decode(view["frames"]), np.uint8)
            assert np.array_equal(frames.reshape(2, 45, 80), expected.frames)
            assert view["scene"] == json.loads(json.dumps(expected.scene))
            assert view["policy_action"] == 0.25
            assert view["ground"]["left_m"] == -30.0
            assert view["number"] == 1

    asyncio.run(look())


def test_a_page_that_comes_later_sees_the_newest_view(cockpit):
    async def look():
        cockpit.show(view_of_step(1))
        cockpit.show(view_of_step(2))
        async with page(cockpit) as link:
            assert (await hear(link, "view"))["step"] == 2

    asyncio.run(look())


def test_a_slow_page_gets_fewer_views_and_never_old_ones(cockpit):
    async def look():
        async with page(cockpit) as link:
            steps = []
            for step in range(1, 21):
                cockpit.show(view_of_step(step))
                if step <= VIEWS_UNDERWAY:
                    steps.append((await hear(link, "view"))["step"])
            assert steps == [1, 2]
            # It has drawn none of the two yet: whatever it says, no view comes before the echo.
            await link.send_json({"at_ms": 1.0, "action": 0.0, "engaged": False, "seen": 0})
            assert (await link.receive_json(timeout=WAIT_S))["kind"] == "echo"
            await say(link, seen=2)
            assert (await hear(link, "view"))["step"] == 20

    asyncio.run(look())


def test_a_page_that_reads_nothing_holds_nobody_up(cockpit):
    """Its views and echoes pile up in front of a closed window; the loop's thread goes on."""

    async def stare():
        reader, writer = await asyncio.open_connection("127.0.0.1", cockpit.port, limit=256)
        path = cockpit.url.partition(str(cockpit.port))[2]
        request = (
            f"GET {path}socket HTTP/1.1",
            f"Host: 127.0.0.1:{cockpit.port}",
            f"Origin: {origin(cockpit)}",
            "Connection: Upgrade",
            "Upgrade: websocket",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Key: {'A' * 22}==",
        )
        writer.write("".join(f"{line}\r\n" for line in (*request, "")).encode())
        assert b"101" in await reader.readline()
        for step in range(2000):
            cockpit.show(view_of_step(step))
        async with page(cockpit) as link:
            assert (await hear(link, "view"))["step"] == 1999
        writer.close()

    asyncio.run(stare())


def test_pages_that_are_cut_off_while_they_speak_are_no_error(cockpit, caplog):
    async def speak_and_go():
        async with page(cockpit) as link:
            for _ in range(50):
                await link.send_json({"at_ms": 1.0, "action": 0.0, "engaged": False})
            link.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            link._response.connection.transport.abort()

    async def several():
        for _ in range(10):
            await speak_and_go()
        await until(lambda: not cockpit.present)

    asyncio.run(several())
    cockpit.close()
    assert caplog.messages == []


def test_closing_tells_every_page_and_frees_the_port():
    cockpit = Cockpit()

    async def stay():
        async with page(cockpit) as link:
            await say(link)
            cockpit.close()
            assert (await link.receive_json(timeout=WAIT_S))["kind"] == "end"
            assert (await link.receive(timeout=WAIT_S)).type is aiohttp.WSMsgType.CLOSE

    asyncio.run(stay())
    cockpit.close()
    cockpit.show(first_view())
    assert poll(cockpit) == LET_GO
    Cockpit(port=cockpit.port).close()


def test_a_wish_reaches_the_loop_once(cockpit):
    async def ask():
        async with page(cockpit) as link:
            await say(link, wishes=["pause", "restart"])
            assert poll(cockpit).wishes == {"pause", "restart"}
            assert not poll(cockpit).wishes

    asyncio.run(ask())
