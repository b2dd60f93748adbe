"""A TCP relay to be cut, stalled, throttled and restored."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time

LOOPBACK = "127.0.0.1"
_CHUNK_BYTES = 4096  # Small, so that a throttled relay hands over bit by bit
_STATE_BYTES = 20
"""More than a keep-alive and less than a state, also where Zenoh hands it over in shared memory
(then 47 bytes for each are on the link)."""


class Relay:
    """Passes TCP on from ``endpoint`` to ``target``, an endpoint of this machine."""

    def __init__(self, target: str) -> None:
        self.last_state_s = -math.inf
        """When the last bytes of a state went to whoever connected, monotonic s."""
        self._target = (LOOPBACK, int(target.rpartition(":")[2]))
        self._flowing = threading.Event()
        self._flowing.set()
        self._is_cut = False
        self._bytes_per_s = math.inf
        self._lock = threading.Lock()
        self._open: list[socket.socket] = []
        self._listener = socket.create_server((LOOPBACK, 0))
        self.endpoint = f"tcp/{LOOPBACK}:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Break every connection and refuse new ones; what was under way is lost."""
        with self._lock:
            self._is_cut = True
            while self._open:
                _shut(self._open.pop())

    def stall(self) -> None:
        """Keep the connections and hold what comes, as a radio link that repeats does."""
        self._flowing.clear()

    def throttle(self, bytes_per_s: float) -> None:
        """Hand no more to whoever connected; what is not handed over yet waits."""
        self._bytes_per_s = bytes_per_s

    def restore(self) -> None:
        """Pass all on again; what was held comes at once."""
        self._is_cut, self._bytes_per_s = False, math.inf
        self._flowing.set()

    def close(self) -> None:
        self._flowing.set()
        self.cut()
        _shut(self._listener)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                self._join(self._listener.accept()[0])

    def _join(self, near: socket.socket) -> None:
        with self._lock:
            try:
                if self._is_cut:
                    raise ConnectionError
                far = socket.create_connection(self._target, timeout=1.0)
            except OSError:
                near.close()
                return
            far.settimeout(None)
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._open += [near, far]
        for pair in ((near, far, False), (far, near, True)):
            threading.Thread(target=self._pump, args=pair, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, to_caller: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(_CHUNK_BYTES):
                self._flowing.wait()
                if to_caller:
                    time.sleep(len(data) / self._bytes_per_s)
                sink.sendall(data)
                if to_caller and len(data) > _STATE_BYTES:
                    self.last_state_s = time.monotonic()
        _shut(source)
        _shut(sink)


def _shut(end: socket.socket) -> None:
    with contextlib.suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()
