"""The browser cockpit (``--human web``): a small page behind a token, a WebSocket for each page.

A thread of its own serves it; the loop only hands over. ``seat.py`` decides which page drives.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import itertools
import logging
import secrets
import socket
import sys
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from importlib.resources import files
from types import MappingProxyType
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import msgspec
from aiohttp import WSCloseCode, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from bridge.rerun import BY_NAME
from edge_runtime.util import UserError
from trainer.person.interface import KEY_HELP, Person, Reading, View
from trainer.person.seat import END, MAX_INPUT_BYTES, Seat, decode_input, encode_echo, encode_view

if TYPE_CHECKING:
    from trainer.person.interface import PersonOptions
TOKEN_BYTES = 16
KEEP_ALIVE_S = 10.0
"""How long a connection stays open for another request."""
HELP = (
    "Space: take over without driving",
    "or slide on the pad, or use a gamepad or wheel",
    "P: pause    R: restart the episode    Q: quit",
    "Backspace: discard the episode, or the one that has just ended",
)
LOGGER = logging.getLogger(__name__)
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
MAX_CONNECTIONS = 32
"""A page opens some six for its files, and keeps one."""
HEADERS_S = 5.0
"""Within which a connection must have shown the token."""
ACCEPT_AGAIN_S = 0.5
"""After the process has run out of descriptors, whoever holds them."""


def _is_ours(record: logging.LogRecord) -> bool:
    """Whether it is an error of the cockpit's, and not of somebody who speaks no HTTP to it."""
    return record.exc_info is None or not isinstance(record.exc_info[1], HttpProcessingError)


LOGGER.addFilter(_is_ours)


class Cockpit:
    """A person in a browser: ``Device`` and ``Display``.

    A thread of its own serves the page; ``poll`` and ``show`` only hand over, in microseconds.

    Args:
        host: where to listen.
        port: at which port; 0: any free one.
        scenario: decides the keys.

    Raises:
        UserError: the address cannot be listened on.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, scenario: str = "left_turn") -> None:
        self.help = (f"hold to take over    {KEY_HELP[scenario]}", *HELP)
        self.seat = Seat()
        self._listener = _listen(host, port)
        self.port: int = self._listener.getsockname()[1]
        token = secrets.token_urlsafe(TOKEN_BYTES)
        name = _name(host)
        shown = f"[{name}]" if ":" in name else name
        self.url = f"http://{shown}:{self.port}/{token}/"
        self._server = Server(token, self.seat, (host, name))
        self._shown = 0
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._serve, name="cockpit", daemon=True)
        self._thread.start()

    @property
    def present(self) -> bool:
        """Whether a page has the wheel and is heard."""
        return self.seat.is_heard(time.monotonic())

    def poll(self, now_s: float) -> Reading:
        """What the driving page said last; nothing, if that is half a second ago."""
        return self.seat.poll(now_s)

    def show(self, view: View) -> None:
        """Show the newest view to every page."""
        self._shown += 1
        self._tell(self._server.show, self._shown, view, time.monotonic())

    def close(self) -> None:
        """Tell the pages that it is over, and end the thread."""
        self._tell(self._closing.set)
        self._thread.join(4 * CLOSING_S)

    def _tell(self, function: object, *arguments: object) -> None:
        """Call something in the server's thread; nothing once that is closed."""
        with contextlib.suppress(RuntimeError):  # Closed, perhaps this very moment.
            self._loop.call_soon_threadsafe(function, *arguments)  # type: ignore[arg-type]

    def _serve(self) -> None:
        try:
            self._loop.run_until_complete(self._run())
        finally:
            self._loop.close()

    async def _run(self) -> None:
        runner = web.AppRunner(
            self._server.application(),
            # The log would hold the token.
            access_log=None,
            logger=LOGGER,
            handle_signals=False,
            shutdown_timeout=CLOSING_S,
            keepalive_timeout=KEEP_ALIVE_S,
        )
        await runner.setup()
        assert runner.server is not None
        with self._listener:
            accepting = asyncio.create_task(self._server.door.let_in(self._listener, runner.server))
            await self._closing.wait()
            accepting.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await accepting
        await self._server.close()
        await runner.cleanup()


def open_cockpit(options: PersonOptions) -> Person:
    """Serve the cockpit and print its address."""
    cockpit = Cockpit(options.host, options.port, options.scenario)
    if options.host not in LOOPBACK:
        print(
            f"warning: --host {options.host}: whoever reads this network's traffic can take the "
            f"wheel; safer: leave it out, and ssh -L {cockpit.port}:127.0.0.1:{cockpit.port} from "
            "the browser's machine",
            file=sys.stderr,
        )
    print(f"cockpit: open {cockpit.url}", flush=True)
    return Person(cockpit, cockpit)


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        try:
            # A port of a sitting just ended may be taken again at once.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen()
            listener.setblocking(False)
        except OSError:
            listener.close()
            raise
    # A name that is none for DNS is a UnicodeError.
    except (OSError, OverflowError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            reason += "; without --port any that is free will do"
        raise UserError(f"the cockpit cannot listen on {host} port {port}: {reason}") from error
    return listener


def _name(host: str) -> str:
    """By what name a browser elsewhere finds the cockpit."""
    return socket.gethostname() if host in ("0.0.0.0", "::") else host


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
    folder = files("trainer.person") / "page"
    found = {entry.name: entry.read_bytes() for entry in folder.iterdir() if "." in entry.name}
    colours = "".join(f"--{name}: rgb{colour}; " for name, colour in BY_NAME.items())
    return {**found, "colours.css": f":root {{ {colours}}}".encode()}


class Door:
    """Accepts connections; a stranger is one that has not shown the token yet.

    Where it is full, the stranger that has stood there longest goes; without one, whoever comes.
    """

    def __init__(self) -> None:
        self._inside: dict[asyncio.Transport, asyncio.TimerHandle] = {}
        """Open connections in the order in which they came, and when they are shown out."""

    def has_token(self, transport: asyncio.Transport | None) -> None:
        """A connection has shown the token: it may stay."""
        if transport in self._inside:
            self._inside[transport].cancel()

    async def let_in(self, listener: socket.socket, server: web.Server) -> None:
        """Accept for ``server``, until cancelled. ``listener`` does not block."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(listener)
            except OSError:
                await asyncio.sleep(ACCEPT_AGAIN_S)
                continue
            if not self._has_room():
                connection.close()
                continue
            transport, _ = await loop.connect_accepted_socket(server, connection)
            self._inside[transport] = loop.call_later(HEADERS_S, transport.abort)

    def _has_room(self) -> bool:
        for gone in [each for each in self._inside if each.is_closing()]:
            self._inside.pop(gone).cancel()
        if len(self._inside) < MAX_CONNECTIONS:
            return True
        strangers = (each for each, timer in self._inside.items() if not timer.cancelled())
        longest = next(strangers, None)
        if longest is None:
            return False
        self._inside.pop(longest).cancel()
        longest.abort()
        return True
