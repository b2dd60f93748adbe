"""A TCP link between two ends that can be cut, stalled and restored; threads do it."""

from __future__ import annotations

import contextlib
import socket
import threading
import time

from edge_runtime.link_probe import free_endpoint

_CHUNK = 65536
_STATE_BYTES = 20
"""More than a keep-alive and less than a state, also where Zenoh hands it over in shared memory
(then 47 bytes for each are on the link)."""


def address(endpoint: str) -> tuple[str, int]:
    """Host and port of ``tcp/HOST:PORT``."""
    host, port = endpoint.split("/", 1)[1].rsplit(":", 1)
    return host, int(port)


class Link:
    """Listens at ``endpoint`` and passes everything on to ``target``, both ``tcp/HOST:PORT``."""

    def __init__(self, target: str) -> None:
        self.endpoint = free_endpoint()
        self.last_state_s = float("-inf")
        """When the last bytes of a state went to whoever connected, monotonic s."""
        self._target = address(target)
        self._flowing = threading.Event()
        self._flowing.set()
        self._is_cut = False
        self._lock = threading.Lock()
        self._open: list[socket.socket] = []
        self._listener = socket.create_server(address(self.endpoint))
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Break every connection and refuse new ones; what was under way is lost."""
        with self._lock:
            self._is_cut = True
            self._break()

    def stall(self) -> None:
        """Keep the connections and hold what comes, as a radio link that repeats does."""
        self._flowing.clear()

    def restore(self) -> None:
        """Be a link again; what was held comes at once."""
        self._is_cut = False
        self._flowing.set()

    def close(self) -> None:
        """Break all and stop listening."""
        self._flowing.set()
        self.cut()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self._join(near)

    def _join(self, near: socket.socket) -> None:
        with self._lock:
            if self._is_cut:
                near.close()
                return
            try:
                far = socket.create_connection(self._target, timeout=1.0)
            except OSError:
                near.close()
                return
            far.settimeout(None)
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._open += [near, far]
        threading.Thread(target=self._pump, args=(near, far, False), daemon=True).start()
        threading.Thread(target=self._pump, args=(far, near, True), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, to_caller: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(_CHUNK):
                self._flowing.wait()
                sink.sendall(data)
                if to_caller and len(data) > _STATE_BYTES:
                    self.last_state_s = time.monotonic()
        _shut(source, sink)

    def _break(self) -> None:
        _shut(*self._open)
        self._open.clear()


def _shut(*ends: socket.socket) -> None:
    for end in ends:
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
        end.close()
