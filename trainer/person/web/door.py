"""How many may come in, and how long a stranger may stand in the door.

aiohttp bounds the size of a request's headers, neither the time they take nor the connections.
"""

from __future__ import annotations

import asyncio
import socket

from aiohttp import web

MAX_CONNECTIONS = 32
"""A page opens some six for its files, and keeps one."""
HEADERS_S = 5.0
"""Within which a connection must have shown the token."""
ACCEPT_AGAIN_S = 0.5
"""After the process has run out of descriptors, whoever holds them."""


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
