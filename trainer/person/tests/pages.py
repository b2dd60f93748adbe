"""Pages without a browser: a WebSocket that says and hears what the cockpit's page does."""

import asyncio
import time
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import cache

import aiohttp

from trainer.drivers import make_environment
from trainer.person.interface import View

WAIT_S, PATIENCE_S = 5.0, 10.0


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


LIVE = "document.body.dataset.link === 'live'"
READY = f"{LIVE} && document.getElementById('scenario').textContent"
TWO_HEARTBEATS = "new Promise((done) => setTimeout(done, 200))"
WHY = "document.getElementById('why').textContent"
YOU = "document.querySelector('.bar.human output').textContent"


def poll(cockpit):
    return cockpit.poll(time.monotonic())


async def reads(cockpit, condition):
    """Poll until the reading is as wanted; that reading."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition(reading := poll(cockpit)):
        assert time.monotonic() < end_s, reading
        await asyncio.sleep(0.005)
    return reading


@cache
def first_view(scenario: str = "left_turn") -> View:
    """What a person sees of a scenario's first moment."""
    env = make_environment(scenario)
    frames, info = env.reset(seed=3)
    return View(
        scenario=scenario,
        scene=env.scene(),
        frames=frames,
        policy_action=0.25,
        human_action=-0.5,
        applied_action=0.25,
        control="policy",
        speed_mps=info["speed_mps"],
        distance_m=info["distance_m"],
        goal_m=env.config.goal_m,
        episode=1,
        step=0,
        time_s=0.0,
    )


def view_of_step(step: int) -> View:
    """The same, told apart by its step."""
    return replace(first_view(), step=step)


class Tunnel:
    """A TCP connection passed on to a port of this machine, until it is lost."""

    def __init__(self, port):
        self._to = port
        self._ways = []

    async def __aenter__(self):
        self._server = await asyncio.start_server(self._join, "127.0.0.1")
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_):
        self._server.close()
        self.cut()

    def cut(self):
        """Close what is open; what comes afterwards is passed on."""
        for _, writer in self._ways:
            writer.transport.abort()
        self._ways.clear()

    def swallow(self):
        """Pass on nothing of what is open, and close nothing either."""
        for task, _ in self._ways:
            task.cancel()

    async def _join(self, reader, writer):
        there = await asyncio.open_connection("127.0.0.1", self._to)
        for source, sink in ((reader, there[1]), (there[0], writer)):
            self._ways.append((asyncio.create_task(self._pass_on(source, sink)), sink))

    @staticmethod
    async def _pass_on(source, sink):
        try:
            while data := await source.read(65536):
                sink.write(data)
            sink.close()
        except ConnectionError:
            sink.transport.abort()
