"""The browser cockpit (``--human web``): a small page behind a token, a WebSocket for each page.

A thread of its own serves it; the loop only hands views over. ``Seat`` decides which page drives.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hmac
import io
import logging
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
import segno
from aiohttp import WSCloseCode, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError
from PIL import Image

from bridge.messages import plain
from bridge.rerun import BY_NAME, has_display, shades
from edge_runtime.util import UserError
from trainer.person.interface import Reading, View, controls_of
from trainer.person.takeover import Input, Seat
from trainer.scenarios.picture import HEIGHT_M, VIEW, WIDTH_M

TOKEN_BYTES = 16
MAX_INPUT_BYTES = 1024  # Of a page's message, which is half as long with 16 actions
KEEP_ALIVE_S = 10.0  # How long a connection stays open for another request
MAX_CONNECTIONS = 32  # A page opens some six for its files, and keeps one
HEADERS_S = 5.0  # A connection must show the token within this time
BACKLOG = 16
"""Connections that are accepted at once; each needs a descriptor until the door refuses it."""
LOOPBACK = ("127.0.0.1", "::1", "localhost")
EVERYWHERE = ("0.0.0.0", "::")
SOMEWHERE = ("192.0.2.1", 9)  # RFC 5737: no machine has this address
GONE_S = 2.0  # A page that is not heard for this long is disconnected, and the next one may drive
CLOSING_S = 0.5  # How long a page may take to say good-bye
VIEWS_UNDERWAY = 2
"""Views sent before the page says that it has drawn one: a slow page gets fewer, never old ones."""
TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""The address holds the token: no browser may keep it, pass it on, or frame the page."""
OPEN_THE_PRINTED_ONE = "The cockpit has another address: open the one that the trainer printed.\n"
HINTS = (
    "or slide on the pad, or use a gamepad or wheel",
    "P: pause    R: restart the episode    Backspace: discard it, or the one that has just ended"
    "    Q: quit, all is kept",
)
INPUT = msgspec.json.Decoder(Input)
_ENCODER = msgspec.json.Encoder(enc_hook=plain)
LOGGER = logging.getLogger(__name__)
# A client that speaks no HTTP is no error of the cockpit's.
LOGGER.addFilter(lambda told: not isinstance((told.exc_info or [None] * 3)[1], HttpProcessingError))


def open_cockpit(arguments: argparse.Namespace) -> Cockpit:
    """Serve the cockpit, print its address, and open it where there is a display."""
    host = arguments.host
    cockpit = Cockpit(host, arguments.port, arguments.scenario)
    if host not in LOOPBACK:
        danger = "whoever reads this network's traffic can take the wheel; ssh -L is safer"
        print(f"warning: --host {host}: {danger}", file=sys.stderr)
    print(f"cockpit: open {cockpit.url}", flush=True)
    if has_display():
        url = cockpit.one_time_url()  # In a thread, for it waits for some browsers.
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
    if cockpit.phone_url:
        print(f"on a phone in this network: {cockpit.phone_url}", flush=True)
        if sys.stdout.isatty():
            segno.make(cockpit.phone_url).terminal(compact=True)
    return cockpit


@dataclass(eq=False)
class Page:
    """One open page."""

    socket: web.WebSocketResponse
    sent: int = 0  # Number of the newest view sent
    seen: int = 0  # Number of the newest view that it has drawn
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    """There is a newer view, or room for one."""


class Cockpit:
    """A person in a browser; UserError where the address cannot be listened on.

    The loop's thread calls the public methods, which take microseconds. Everything else runs in
    the server's thread.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, scenario: str = "left_turn") -> None:
        self.controls = controls_of(scenario)
        self.help = (self.controls.help, *HINTS)
        self.seat = Seat(self.controls.rest)
        self._listener = _listen(host, port)
        self.port: int = self._listener.getsockname()[1]
        self._token = secrets.token_urlsafe(TOKEN_BYTES)
        self._one_time_token = ""
        name = socket.gethostname() if host in EVERYWHERE else host
        self._names = {*LOOPBACK, host.lower(), name.lower()}
        self.url = self._url_of(name)
        self.phone_url = None if host in LOOPBACK else self._url_of(lan_address(host))
        """For another machine in this network; None where the cockpit listens on loopback."""
        self._pages: list[Page] = []
        self._files = _page_files(self.phone_url, np.size(self.controls.rest))
        self._shown = 0
        self._newest = (0, "")  # The newest view's number and message; pages get it when they can
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._serve, name="cockpit", daemon=True)
        self._thread.start()

    def one_time_url(self) -> str:
        """Return an address for one request: all users here can read a browser's command line."""
        self._one_time_token = secrets.token_urlsafe(TOKEN_BYTES)
        return self.url.replace(self._token, self._one_time_token)

    @property
    def present(self) -> bool:
        return self.seat.is_heard(time.monotonic())

    def poll(self, now_s: float) -> Reading:
        return self.seat.poll(now_s)

    def show(self, view: View) -> None:
        self._shown += 1
        self._tell(self._take_view, self._shown, view)

    def close(self) -> None:
        """Tell the pages that it is over, and end the thread."""
        self._tell(self._closing.set)
        self._thread.join(4 * CLOSING_S)

    def _url_of(self, name: str) -> str:
        shown = f"[{name}]" if ":" in name else name
        return f"http://{shown}:{self.port}/{self._token}/"

    def _tell(self, function: Callable[..., object], *arguments: object) -> None:
        """Call something in the server's thread; nothing once that is closed."""
        with contextlib.suppress(RuntimeError):  # Closed, perhaps this very moment.
            self._loop.call_soon_threadsafe(function, *arguments)

    def _serve(self) -> None:
        with contextlib.closing(self._loop):
            self._loop.run_until_complete(self._run())

    async def _run(self) -> None:
        # An access log would hold the token.
        self._door = Door(
            self._answer, access_log=None, logger=LOGGER, keepalive_timeout=KEEP_ALIVE_S
        )
        runner = web.ServerRunner(self._door, shutdown_timeout=CLOSING_S)
        await runner.setup()
        site = web.SockSite(runner, self._listener, backlog=BACKLOG)
        await site.start()
        await self._closing.wait()
        await site.stop()
        good_byes = [_say_goodbye(page.socket) for page in self._pages]
        await asyncio.gather(*good_byes, return_exceptions=True)
        await runner.cleanup()

    def _take_view(self, number: int, view: View) -> None:
        self._newest = (number, encode_view(view, number, self.help))
        for page in self._pages:
            page.wake.set()

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        given, slash, name = request.path[1:].partition("/")
        if not self._is_asked_by_name(request):
            return _refusal(421, OPEN_THE_PRINTED_ONE)
        if self._one_time_token and _is_same(given, self._one_time_token):
            self._one_time_token = ""
            raise web.HTTPFound(f"/{self._token}/", headers=HEADERS)
        if not _is_same(given, self._token):
            return _refusal(403, OPEN_THE_PRINTED_ONE)
        self._door.has_token(request.transport)
        if name == "socket":
            return await self._talk(request)
        if not slash:  # The page's own files stand beside it only behind the slash.
            raise web.HTTPFound(request.path + "/", headers=HEADERS)
        name = name or "index.html"
        if name not in self._files:
            return _refusal(404, "no such page\n")
        kind, body = TYPES[name.rpartition(".")[2]], self._files[name]
        return web.Response(body=body, content_type=kind, charset="utf-8", headers=HEADERS)

    def _is_asked_by_name(self, request: web.BaseRequest) -> bool:
        """Whether the request names this machine; another site's name may resolve to it, too.

        A page from there would be of the same origin (DNS rebinding).
        """
        try:
            host = urlsplit(f"//{request.headers.get('Host', '')}").hostname
        except ValueError:
            return False
        # With --host 0.0.0.0 the address at which the request arrived.
        arrived_at = request.get_extra_info("sockname", ("",))[0].removeprefix("::ffff:")
        return host is not None and host in {*self._names, arrived_at}

    async def _talk(self, request: web.BaseRequest) -> web.StreamResponse:
        # A page of another site may open sockets to this machine, but cannot lie about its origin.
        if request.headers.get("Origin") != f"http://{request.host}":
            return _refusal(403, "another site's page\n")
        socket = web.WebSocketResponse(
            max_msg_size=MAX_INPUT_BYTES, compress=False, timeout=CLOSING_S
        )
        await socket.prepare(request)
        page = Page(socket)
        self._pages.append(page)
        self.seat.sit_down(page)
        sender = asyncio.create_task(self._send_views(page))
        try:
            why = await self._hear(page)
        finally:  # Before the good-byes, which take their time.
            self.seat.get_up(page)
            self._pages.remove(page)
            sender.cancel()
        await socket.close(code=why)
        return socket

    async def _hear(self, page: Page) -> WSCloseCode:
        """Hear a page until it goes, falls silent, or sends what no page of ours sends."""
        while True:
            try:
                message = await page.socket.receive(timeout=GONE_S)
            except TimeoutError:
                return WSCloseCode.GOING_AWAY
            if message.type is not WSMsgType.TEXT:
                return WSCloseCode.UNSUPPORTED_DATA
            try:
                said = INPUT.decode(message.data)
            except msgspec.MsgspecError:
                return WSCloseCode.POLICY_VIOLATION
            if said.action is not None and np.shape(said.action) != np.shape(self.controls.rest):
                return WSCloseCode.POLICY_VIOLATION
            counts = self.seat.hear(page, said, time.monotonic())
            page.seen = min(max(page.seen, said.seen), page.sent)
            page.wake.set()
            driving = self.seat.is_driver(page)
            refused = driving and not counts  # The hands must be off once.
            echo = _encode("echo", at_ms=said.at_ms, driving=driving, refused=refused)
            try:
                await page.socket.send_str(echo)
            except ConnectionError:
                return WSCloseCode.GOING_AWAY  # The connection was cut while the page spoke.

    async def _send_views(self, page: Page) -> None:
        """Show the page the newest view, until it is gone, which `_hear` notices."""
        page.wake.set()
        with contextlib.suppress(ConnectionError):
            while await page.wake.wait():
                page.wake.clear()
                number, message = self._newest
                if number > page.sent and page.sent - page.seen < VIEWS_UNDERWAY:
                    page.sent = number
                    await page.socket.send_str(message)


def _is_same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())


def _refusal(status: int, text: str) -> web.Response:
    response = web.Response(status=status, text=text, headers=HEADERS)
    response.force_close()
    return response


def _listen(host: str, port: int) -> socket.socket:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, address = found[0][0], found[0][4]
        both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        return socket.create_server(address, family=family, dualstack_ipv6=both)
    except (OSError, OverflowError, UnicodeError) as error:  # The last: no name for DNS.
        raise UserError(f"the cockpit cannot listen on {host} port {port}: {error}") from error


def _encode(kind: str, **fields: Any) -> str:
    return _ENCODER.encode({"kind": kind, **fields}).decode()


def encode_view(view: View, number: int, hints: tuple[str, ...]) -> str:
    """Encode view ``number``, from 1; ``hints`` say what to press for what, one line each.

    ``frames`` become base64 of [2, 45, 80] bytes, ``picture`` base64 of a JPEG; ``ground`` is the
    part to show.
    """
    left_m, top_m = _corner(view.scene or {})
    frames = None if view.frames is None else view.frames.tobytes()
    fields = vars(view) | {"frames": frames, "controls": controls_of(view.scenario)}
    if view.picture is not None:
        jpeg = io.BytesIO()
        Image.fromarray(view.picture).save(jpeg, "JPEG")
        fields["picture"] = jpeg.getvalue()
    ground = {"left_m": left_m, "top_m": top_m, "width_m": WIDTH_M, "height_m": HEIGHT_M}
    return _encode("view", number=number, help=hints, ground=ground, **fields)


def _corner(scene: Mapping[str, Any]) -> tuple[float, float]:
    """Where the ground shown begins, m: as the scene says, or so that the ego car is on it."""
    left_m, top_m = scene.get("view", VIEW)
    for car in scene.get("vehicles", ()):
        inside = 0.0 <= car["x"] - left_m <= WIDTH_M and 0.0 <= car["y"] - top_m <= HEIGHT_M
        if car.get("ego") and "view" not in scene and not inside:
            return car["x"] - WIDTH_M / 2, car["y"] - HEIGHT_M / 2
    return left_m, top_m


async def _say_goodbye(socket: web.WebSocketResponse) -> None:
    """Tell the page that the sitting is over, so that it does not come back."""
    await asyncio.wait_for(socket.send_str(_encode("end")), CLOSING_S)
    await socket.close(code=WSCloseCode.GOING_AWAY, message=b"over")


def lan_address(host: str) -> str:
    """Return this machine's address for others: of the route to the internet; nothing is sent."""
    if host not in EVERYWHERE:
        return host
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(SOMEWHERE)
        return str(probe.getsockname()[0])
    return socket.gethostname()  # There is no such way.


def _page_files(phone_url: str | None, actions: int) -> dict[str, bytes]:
    found = {path.name: path.read_bytes() for path in (Path(__file__).parent / "page").glob("*.*")}
    colours = "".join(
        f"--{name}: rgb{colour}; "
        + "".join(f"--{name}-{n}: rgb{one}; " for n, one in enumerate(shades(colour, actions)))
        for name, colour in BY_NAME.items()
    )
    if phone_url:
        picture = segno.make(phone_url).svg_data_uri(scale=4)
        found["index.html"] = found["index.html"].replace(
            b"<!-- phone -->",
            '<details id="phone"><summary>On a phone in this network: then close this page, or '
            "the phone only watches</summary>"
            f'<img alt="the address as a QR code" src="{picture}" /><code>{phone_url}</code>'
            "</details>".encode(),
        )
    return {**found, "colours.css": f":root {{ {colours}}}".encode()}


class Door(web.Server):
    """Limits the connections. Until a connection has shown the token, it is a stranger.

    At the limit, the oldest stranger is cut off; where there is none, the newcomer.
    """

    def __init__(self, handler: Any, **options: Any) -> None:
        super().__init__(handler, **options)
        self._inside: dict[asyncio.Transport, asyncio.TimerHandle] = {}
        """Open connections, oldest first, and the timer that cuts off a stranger."""

    def has_token(self, transport: asyncio.Transport | None) -> None:
        """Let a connection that has shown the token stay."""
        if transport in self._inside:
            self._inside[transport].cancel()

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Take in a newcomer, or cut it off."""
        self._inside = {one: timer for one, timer in self._inside.items() if not one.is_closing()}
        if len(self._inside) >= MAX_CONNECTIONS:
            strangers = (one for one, timer in self._inside.items() if not timer.cancelled())
            leaving = next(strangers, transport)
            leaving.abort()
            if leaving is transport:
                return
            del self._inside[leaving]
        super().connection_made(handler, transport)
        loop = asyncio.get_running_loop()
        self._inside[transport] = loop.call_later(HEADERS_S, transport.abort)
