"""Pages without a browser: a WebSocket that says and hears what the cockpit's page does."""

import asyncio
import time
from contextlib import asynccontextmanager

import aiohttp

WAIT_S = 5.0


def origin(cockpit):
    return f"http://127.0.0.1:{cockpit.port}"


@asynccontextmanager
async def page(cockpit, **more):
    """A page's WebSocket."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(
            cockpit.url + "socket", origin=more.pop("origin", origin(cockpit)), **more
        ) as link,
    ):
        yield link


async def say(link, engaged=False, action=0.0, **more):
    """Say something as a page does; the echo."""
    await link.send_json({"at_ms": 12.5, "action": action, "engaged": engaged, **more})
    return await hear(link, "echo")


async def hear(link, kind):
    """The next message of a kind."""
    while True:
        message = await link.receive_json(timeout=WAIT_S)
        if message["kind"] == kind:
            return message


async def until(condition):
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s, "did not come true"
        await asyncio.sleep(0.005)
