"""The cockpit's HTTP side: one small page behind a token, and a WebSocket for each page.

Everything here runs in the event loop of the cockpit's own thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import itertools
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from importlib.resources import files
from types import MappingProxyType
from urllib.parse import urlsplit

import msgspec
from aiohttp import WSCloseCode, WSMsgType, web

from bridge.rerun import BY_NAME
from trainer.person.interface import View
from trainer.person.web.door import Door
from trainer.person.web.messages import END, MAX_INPUT_BYTES, decode_input, encode_echo, encode_view
from trainer.person.web.seat import Seat

LOOPBACK = ("127.0.0.1", "::1", "localhost")
GONE_S = 2.0
"""A page that is not heard for this long is shown out, and the next one may drive."""
CLOSING_S = 0.5
"""How long a page may take to say good-bye."""
VIEWS_UNDERWAY = 2
"""Views sent before the page says that it has drawn one: a slow page gets fewer, never old ones."""
TYPES = MappingProxyType({"html": "text/html", "css": "text/css", "js": "text/javascript"})
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""The address holds the token: it shall not be kept, passed on, or framed."""
NO_TOKEN = "This address holds no token, or an old one: open the one that the trainer printed.\n"
NO_NAME = "The cockpit has another name: open the address that the trainer printed.\n"
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass
class Page:
    """One open page."""

    number: int
    socket: web.WebSocketResponse
    sent: int = 0
    """Number of the newest view sent."""
    seen: int = 0
    """Number of the newest view that it has drawn."""
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    """There is a newer view, or room for one."""


class Server:
    """Serves pages, hears them for the seat, and shows them the newest view.

    Args:
        token: what the address must hold.
        seat: who drives.
        names: hosts by which it is asked for, besides loopback's.
    """

    def __init__(self, token: str, seat: Seat, names: tuple[str, ...] = ()) -> None:
        self._token, self._seat = token.encode(), seat
        self._names = {*LOOPBACK, *(name.lower() for name in names)}
        self.door = Door()
        self._pages: dict[int, Page] = {}
        self._numbers = itertools.count(1)
        self._files = _page_files()
        self._newest: tuple[int, View, float] | None = None
        self._encoded: tuple[int, str] = (0, "")

    def application(self) -> web.Application:
        """What aiohttp is to run."""
        app = web.Application(middlewares=[self._check])
        app.router.add_get("/{token}", _with_slash)
        app.router.add_get("/{token}/socket", self._talk)
        app.router.add_get("/{token}/{file:[a-z.]*}", self._file)
        return app

    def show(self, number: int, view: View, shown_s: float) -> None:
        """Take the newest view; pages get it when they can."""
        self._newest = (number, view, shown_s)
        for page in self._pages.values():
            page.wake.set()

    async def close(self) -> None:
        """Tell every page that the sitting is over."""
        pages = list(self._pages.values())
        await asyncio.gather(*(_say_goodbye(page.socket) for page in pages), return_exceptions=True)

    @web.middleware
    async def _check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        given = request.path.partition("/")[2].partition("/")[0]
        if not self._is_asked_by_name(request):
            return _refusal(421, NO_NAME)
        if not hmac.compare_digest(given.encode(), self._token):
            return _refusal(403, NO_TOKEN)
        self.door.has_token(request.transport)
        return await handler(request)

    def _is_asked_by_name(self, request: web.Request) -> bool:
        """Whether the request names this machine. Another site's name may resolve to it, too: a
        page from there would be of the same origin (DNS rebinding).
        """
        try:
            host = urlsplit(f"//{request.headers.get('Host', '')}").hostname
        except ValueError:
            return False
        # With --host 0.0.0.0 the address at which the request arrived.
        arrived_at = request.get_extra_info("sockname", ("",))[0].removeprefix("::ffff:")
        return host is not None and host in {*self._names, arrived_at}

    async def _file(self, request: web.Request) -> web.Response:
        name = request.match_info["file"] or "index.html"
        if name not in self._files:
            raise web.HTTPNotFound
        kind = TYPES[name.rpartition(".")[2]]
        return web.Response(
            body=self._files[name], content_type=kind, charset="utf-8", headers=HEADERS
        )

    async def _talk(self, request: web.Request) -> web.StreamResponse:
        # A page of another site may open sockets to this machine, but cannot lie about its origin.
        if request.headers.get("Origin") != f"http://{request.host}":
            return web.Response(status=403, text="another site's page\n", headers=HEADERS)
        socket = web.WebSocketResponse(
            max_msg_size=MAX_INPUT_BYTES, compress=False, timeout=CLOSING_S
        )
        await socket.prepare(request)
        page = Page(next(self._numbers), socket)
        self._pages[page.number] = page
        self._seat.sit_down(page.number)
        sender = asyncio.create_task(self._keep_shown(page))
        try:
            why = await self._listen(page)
        finally:
            # Before the good-byes, which take their time.
            self._seat.get_up(page.number)
            del self._pages[page.number]
            sender.cancel()
        await socket.close(code=why)
        return socket

    async def _listen(self, page: Page) -> WSCloseCode:
        """Hear a page until it goes, falls silent, or says what no page of ours says."""
        while True:
            try:
                message = await page.socket.receive(timeout=GONE_S)
            except TimeoutError:
                return WSCloseCode.GOING_AWAY
            if message.type is not WSMsgType.TEXT:
                return WSCloseCode.UNSUPPORTED_DATA
            try:
                said = decode_input(message.data)
            except msgspec.MsgspecError:
                return WSCloseCode.POLICY_VIOLATION
            counts = self._seat.hear(page.number, said, time.monotonic())
            page.seen = min(max(page.seen, said.seen), page.sent)
            page.wake.set()
            driving = self._seat.is_driver(page.number)
            refused = driving and not counts
            try:
                await page.socket.send_str(encode_echo(said.at_ms, driving, refused))
            except ConnectionError:
                return WSCloseCode.GOING_AWAY  # To nobody: it was cut off while it spoke.

    async def _keep_shown(self, page: Page) -> None:
        """Show the page the newest view, until it is gone; who hears it notices that."""
        with contextlib.suppress(ConnectionError):
            await self._send_views(page)

    async def _send_views(self, page: Page) -> None:
        page.wake.set()
        while True:
            await page.wake.wait()
            page.wake.clear()
            newest = self._newest
            if newest is None or newest[0] <= page.sent:
                continue
            if page.sent - page.seen >= VIEWS_UNDERWAY:
                continue
            page.sent = newest[0]
            await page.socket.send_str(self._encode(*newest))

    def _encode(self, number: int, view: View, shown_s: float) -> str:
        """The view's message, made once for all pages."""
        if self._encoded[0] != number:
            self._encoded = (number, encode_view(view, number, shown_s))
        return self._encoded[1]


def _refusal(status: int, text: str) -> web.Response:
    """An answer after which the connection is closed."""
    response = web.Response(status=status, text=text, headers=HEADERS)
    response.force_close()
    return response


async def _with_slash(request: web.Request) -> web.Response:
    """The page's own files stand beside it only behind the slash."""
    raise web.HTTPFound(request.path + "/", headers=HEADERS)


async def _say_goodbye(socket: web.WebSocketResponse) -> None:
    await asyncio.wait_for(socket.send_str(END), CLOSING_S)
    await socket.close(code=WSCloseCode.GOING_AWAY, message=b"over")


def _page_files() -> dict[str, bytes]:
    folder = files("trainer.person.web") / "page"
    found = {entry.name: entry.read_bytes() for entry in folder.iterdir() if "." in entry.name}
    colours = "".join(f"--{name}: rgb{colour}; " for name, colour in BY_NAME.items())
    return {**found, "colours.css": f":root {{ {colours}}}".encode()}
