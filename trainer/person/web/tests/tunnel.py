"""A connection that can be lost, as over ``ssh -L``."""

import asyncio


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
