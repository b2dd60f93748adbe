"""The browser cockpit (``--human web``): a small page behind a token, a WebSocket for each page.

A thread of its own serves it; the loop only hands views over. ``Seat`` decides which page drives.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
from aiohttp import WSCloseCode, WSMsgType, web
from PIL import Image

from bridge.messages import plain
from bridge.rerun import BY_NAME, has_display, shades
from edge_runtime.util import UserError
from trainer.person import Amount, Input, Reading, Seat, View, amount

PAGE = Path(__file__).parent / "page"
TOKEN_BYTES = 16
MAX_INPUT_BYTES = 1024  # Of a page's message, which is half as long with 16 actions
LOOPBACK = ("127.0.0.1", "::1", "localhost")
EVERYWHERE = ("0.0.0.0", "::")
SOMEWHERE = ("192.0.2.1", 9)  # RFC 5737: no machine has this address
GONE_S = 2.0  # A page that sends nothing for this long is disconnected; the next may drive
CLOSING_S = 0.5  # How long a page may take to say good-bye
VIEWS_UNDERWAY = 2
"""Views sent before the page says that it has drawn one: a slow page gets fewer, never old ones."""
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""The address holds the token: no browser may keep it, pass it on, or frame the page."""
RESERVED = {"p", "r", "q", "escape", "backspace", "space"}  # Keys of the wishes, and Space
INPUT = msgspec.json.Decoder(Input)
_ENCODER = msgspec.json.Encoder(enc_hook=plain)


@dataclass(frozen=True)
class Controls:
    keys: Mapping[str, Amount]
    """Key, in small letters as ``up`` or ``w`` -> what pressing it fully adds to ``rest``."""
    rest: Amount  # Hands off
    rate_per_s: float  # How quickly a key presses
    names: tuple[str, ...]  # Of the actions


def controls_of(env: Any) -> Controls:
    """Return the controls of an environment; UserError where a person cannot drive it."""
    if not getattr(env, "can_be_seen", True):
        raise UserError(f"a person cannot see {env.scenario}: it has no render() and no scene()")
    if not env.keys:
        raise UserError(f"a person cannot drive {env.scenario}: several actions, and no keys")
    keys = {
        name.lower().removeprefix("arrow").removeprefix("key"): amount(held - env.rest_action)
        for name, held in env.keys.items()
    }
    if taken := ", ".join(sorted(RESERVED & keys.keys())):
        raise UserError(f"{env.scenario} uses the keys {taken}, which the cockpit reserves")
    return Controls(keys, amount(env.rest_action), env.key_rate_per_s, tuple(env.action_names))


def open_cockpit(arguments: argparse.Namespace, env: Any) -> Cockpit:
    """Serve the cockpit, print its address, and open it where there is a display."""
    host = arguments.host
    cockpit = Cockpit(env, host, arguments.port)
    if host not in LOOPBACK:
        danger = "whoever reads this network's traffic can take the wheel; ssh -L is safer"
        print(f"warning: --host {host}: {danger}", file=sys.stderr)
    print(f"cockpit: open {cockpit.url}", flush=True)
    if has_display():
        url = cockpit.one_time_url()  # In a thread, since some browsers block.
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
    return cockpit


@dataclass(eq=False)
class Page:
    socket: web.WebSocketResponse
    sent: int = 0  # Number of the newest view sent
    seen: int = 0  # Number of the newest view that it has drawn
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    """There is a newer view, or room for one."""


class Cockpit:
    """Serves the browser: reads the person's device and shows views.

    The loop's thread calls the public methods, once a control period; none blocks. All else runs in
    the server's thread. Raises UserError where the address cannot be listened on.
    """

    def __init__(self, env: Any, host: str = "127.0.0.1", port: int = 0) -> None:
        self.controls = controls_of(env)
        self.seat = Seat(self.controls.rest)
        self._listener = _listen(host, port)
        self.port: int = self._listener.getsockname()[1]
        self._token, self._once = secrets.token_urlsafe(TOKEN_BYTES), ""
        address = lan_address(host)
        self._names = {*LOOPBACK, host.lower(), address, socket.gethostname().lower()}
        shown = f"[{address}]" if ":" in address else address
        self._origin = f"http://{shown}:{self.port}"
        self.url = f"{self._origin}/{self._token}/"
        self._pages: list[Page] = []
        self._newest = (0, "")  # The newest view's number and message; pages get it when they can
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._serve, name="cockpit", daemon=True)
        self._thread.start()

    def one_time_url(self) -> str:
        """Return an address for one request: all users here can read a browser's command line."""
        self._once = secrets.token_urlsafe(TOKEN_BYTES)
        return f"{self._origin}/once/{self._once}"

    @property
    def present(self) -> bool:
        """Whether a page drives; an episode waits for one."""
        return self.seat.is_heard(time.monotonic())

    def poll(self, now_s: float) -> Reading:
        """Return the reading at ``now_s`` (``time.monotonic``); hands off without a browser."""
        return self.seat.poll(now_s)

    def show(self, view: View) -> None:
        self._tell(self._take_view, view)

    def close(self) -> None:
        """Tell the pages that the sitting is over, end the thread; a second call does nothing."""
        self._tell(self._closing.set)
        self._thread.join(4 * CLOSING_S)

    def _tell(self, function: Callable[..., object], *arguments: object) -> None:
        """Call a function in the server's thread; do nothing once that is closed."""
        with contextlib.suppress(RuntimeError):  # The loop is closed.
            self._loop.call_soon_threadsafe(function, *arguments)

    def _serve(self) -> None:
        with contextlib.closing(self._loop):
            self._loop.run_until_complete(self._run())

    async def _run(self) -> None:
        app, here = web.Application(middlewares=[self._guard]), f"/{self._token}/"
        app.router.add_get("/once/{word}", self._let_in_once)
        app.router.add_get(here, self._index)
        app.router.add_get(f"{here}socket", self._talk)
        app.router.add_get(f"{here}colours.css", self._colours)
        app.router.add_static(here, PAGE)
        # An access log would hold the token.
        runner = web.AppRunner(
            app, access_log=None, shutdown_timeout=CLOSING_S, keepalive_timeout=10.0
        )
        await runner.setup()
        await web.SockSite(runner, self._listener).start()
        await self._closing.wait()
        good_byes = [_say_goodbye(page.socket) for page in self._pages]
        await asyncio.gather(*good_byes, return_exceptions=True)
        await runner.cleanup()

    def _take_view(self, view: View) -> None:
        number = self._newest[0] + 1
        self._newest = (number, encode_view(view, number, self.controls))
        for page in self._pages:
            page.wake.set()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Refuse a request that does not name this machine; another site's name may resolve to it.

        A page from there would be of the same origin (DNS rebinding).
        """
        with contextlib.suppress(ValueError):
            host = urlsplit(f"//{request.headers.get('Host', '')}").hostname
            # With --host 0.0.0.0 the address at which the request arrived.
            arrived_at = request.get_extra_info("sockname", ("",))[0].removeprefix("::ffff:")
            if host in {*self._names, arrived_at}:
                response: web.StreamResponse = await handler(request)
                response.headers.update(HEADERS)
                return response
        raise web.HTTPMisdirectedRequest

    async def _let_in_once(self, request: web.Request) -> web.StreamResponse:
        if not self._once or request.match_info["word"] != self._once:
            raise web.HTTPForbidden
        self._once = ""
        raise web.HTTPFound(f"/{self._token}/", headers=HEADERS)

    async def _index(self, request: web.Request) -> web.StreamResponse:
        return web.FileResponse(PAGE / "index.html")

    async def _colours(self, request: web.Request) -> web.StreamResponse:
        actions = np.size(self.controls.rest)
        named = dict(BY_NAME)
        for name, colour in BY_NAME.items():
            shaded = enumerate(shades(colour, actions))
            named |= {f"{name}-{number}": shade for number, shade in shaded}
        lines = "".join(f"--{name}: rgb{colour}; " for name, colour in named.items())
        return web.Response(text=f":root {{ {lines}}}", content_type="text/css")

    async def _talk(self, request: web.Request) -> web.StreamResponse:
        # A page of another site may open sockets to this machine, but cannot lie about its origin.
        if request.headers.get("Origin") != f"http://{request.host}":
            raise web.HTTPForbidden(text="another site's page\n")
        socket = web.WebSocketResponse(
            max_msg_size=MAX_INPUT_BYTES, compress=False, timeout=CLOSING_S
        )
        await socket.prepare(request)
        page = Page(socket)
        self._pages.append(page)
        self.seat.sit_down(page)
        sender = asyncio.create_task(self._send_views(page))
        try:
            close_code = await self._hear(page)
        finally:  # Before the close, which takes time.
            self.seat.get_up(page)
            self._pages.remove(page)
            sender.cancel()
        await socket.close(code=close_code)
        return socket

    async def _hear(self, page: Page) -> WSCloseCode:
        """Read a page's messages until it leaves, falls silent, or sends an invalid one."""
        while True:
            try:
                message = await page.socket.receive(timeout=GONE_S)
            except TimeoutError:
                return WSCloseCode.GOING_AWAY
            if message.type is not WSMsgType.TEXT:
                return WSCloseCode.UNSUPPORTED_DATA
            try:
                sent = INPUT.decode(message.data)
            except msgspec.MsgspecError:
                return WSCloseCode.POLICY_VIOLATION
            if sent.action is not None and np.shape(sent.action) != np.shape(self.controls.rest):
                return WSCloseCode.POLICY_VIOLATION
            accepted = self.seat.hear(page, sent, time.monotonic())
            page.seen = min(max(page.seen, sent.seen), page.sent)
            page.wake.set()
            driving = self.seat.is_driver(page)
            refused = driving and not accepted  # The hands must be off once.
            echo = _encode("echo", at_ms=sent.at_ms, driving=driving, refused=refused)
            try:
                await page.socket.send_str(echo)
            except ConnectionError:
                return WSCloseCode.GOING_AWAY  # The connection was cut while the page spoke.

    async def _send_views(self, page: Page) -> None:
        """Send the page the newest view whenever it has room; `_hear` ends this task."""
        page.wake.set()
        with contextlib.suppress(ConnectionError):
            while await page.wake.wait():
                page.wake.clear()
                number, message = self._newest
                if number > page.sent and page.sent - page.seen < VIEWS_UNDERWAY:
                    page.sent = number
                    await page.socket.send_str(message)


def _listen(host: str, port: int) -> socket.socket:
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        return socket.create_server(addresses[0][4], family=addresses[0][0])
    except (OSError, OverflowError, UnicodeError) as error:  # UnicodeError: an invalid DNS name.
        raise UserError(f"the cockpit cannot listen on {host} port {port}: {error}") from error


def _encode(kind: str, **fields: Any) -> str:
    return _ENCODER.encode({"kind": kind, **fields}).decode()


def encode_view(view: View, number: int, controls: Controls) -> str:
    """Encode view ``number``, from 1.

    ``frames`` become base64 of [2, 45, 80] bytes, ``picture`` of a JPEG.
    """
    frames = None if view.frames is None else view.frames.tobytes()
    fields = vars(view) | {"frames": frames, "controls": controls}
    if view.picture is not None:
        jpeg = io.BytesIO()
        Image.fromarray(view.picture).save(jpeg, "JPEG")
        fields["picture"] = jpeg.getvalue()
    return _encode("view", number=number, **fields)


async def _say_goodbye(socket: web.WebSocketResponse) -> None:
    """Tell the page that the sitting is over, so that it does not come back."""
    await asyncio.wait_for(socket.send_str(_encode("end")), CLOSING_S)
    await socket.close(code=WSCloseCode.GOING_AWAY, message=b"over")


def lan_address(host: str) -> str:
    """Return this machine's address on its route to the internet; nothing is sent."""
    if host not in EVERYWHERE:
        return host
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(SOMEWHERE)
        return str(probe.getsockname()[0])
    return socket.gethostname()  # No route
