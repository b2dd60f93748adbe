"""``--human web``: device and display in one, served by a thread of its own."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import secrets
import socket
import sys
import threading
import time
from typing import TYPE_CHECKING

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from edge_runtime.util import UserError
from trainer.person.interface import KEY_HELP, Person, Reading, View
from trainer.person.web.seat import Seat
from trainer.person.web.server import CLOSING_S, LOOPBACK, Server

if TYPE_CHECKING:
    from trainer.person.registry import PersonOptions

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
