"""Where a recording goes: a window, a local web page, or a file."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple
from urllib.parse import quote

import rerun as rr
import rerun.blueprint as rrb

from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import behind_link, check_writable, make_directory
from edge_runtime.util import UserError
from viewing.viewer import END_S, LOOPBACK, Viewer, ViewerGone, flush, free_port

GRPC_PORT = 9876
WEB_PORT = 9090
SPAWN, SERVE = "spawn", "serve"
SUFFIX = ".rrd"


class Sink(NamedTuple):
    """``spawn`` (a window), ``serve`` (a page on loopback), or the file's path."""

    kind: str
    path: str = ""

    @property
    def is_live(self) -> bool:
        """Whether somebody looks while it is made."""
        return not self.path


def read_sink(word: str) -> Sink:
    """The sink that a word names: ``spawn``, ``serve``, or a path that ends in .rrd.

    Raises:
        UserError: it names none.
    """
    if word in (SPAWN, SERVE):
        return Sink(word)
    if not word.endswith(SUFFIX):
        raise UserError(f"{word!r} is neither {SPAWN} nor {SERVE} nor a file FILE{SUFFIX}")
    return Sink("save", word)


def check_sink(sink: Sink) -> None:
    """Say at once, not after long work, that nothing could be shown: UserError."""
    if sink.path:
        check_writable(sink.path)
    elif sink.kind == SERVE:
        check_ports()
    else:
        check_display()


@contextlib.contextmanager
def open_sink(
    sink: Sink, application: str, blueprint: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """A recording that goes there; ``application`` keeps layouts of different kinds apart.

    SIGTERM raises KeyboardInterrupt meanwhile, unless the command has another use for it: a file
    is to be finished, and a server not to be left behind.

    Raises:
        ViewerGone: there is none any more, or none has come.
    """
    recording = rr.RecordingStream(application)
    with sigterm_as_interrupt(), _opened(recording, sink, blueprint):
        yield recording


def _opened(
    recording: rr.RecordingStream, sink: Sink, blueprint: rrb.Blueprint
) -> AbstractContextManager[rr.RecordingStream]:
    if sink.path:
        return save_to(recording, sink.path, blueprint)
    return (serve_page if sink.kind == SERVE else spawn_window)(recording, blueprint)


@contextlib.contextmanager
def save_to(
    recording: rr.RecordingStream, path: str, blueprint: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """Record into a file that appears under its name when it is complete."""
    target = behind_link(path)
    make_directory(target.parent)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        recording.save(temporary, default_blueprint=blueprint)
        try:
            yield recording
        finally:
            recording.flush()
            recording.disconnect()  # Writes the footer.
            os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def check_display() -> None:
    """Raise UserError where no window could open."""
    displays = (os.environ.get("DISPLAY"), os.environ.get("WAYLAND_DISPLAY"))
    if sys.platform.startswith("linux") and not any(displays):
        raise UserError("no display for a window here: serve a page, or save a file")


@contextlib.contextmanager
def spawn_window(
    recording: rr.RecordingStream, blueprint: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """Show in rerun's own window, which stays open afterwards."""
    port = free_port()
    viewer = Viewer(["--port", str(port), "--expect-data-soon"], [port])
    with _connected(recording, viewer, port, blueprint):
        yield recording


def check_ports() -> None:
    """Raise UserError where the page could not be served: a view of somebody else is there."""
    for port in (GRPC_PORT, WEB_PORT):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOOPBACK, port))
            except OSError:
                raise UserError(f"port {port} is in use; end the other rerun first") from None


@contextlib.contextmanager
def serve_page(
    recording: rr.RecordingStream, blueprint: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """Show in a browser on this machine only."""
    options = ["--serve-web", "--port", str(GRPC_PORT), "--web-viewer-port", str(WEB_PORT)]
    viewer = Viewer(options, [GRPC_PORT, WEB_PORT])
    try:
        with _connected(recording, viewer, GRPC_PORT, blueprint) as url:
            print(f"open http://{LOOPBACK}:{WEB_PORT}/?url={quote(url, safe='')}", flush=True)
            yield recording
    finally:
        viewer.end()


@contextlib.contextmanager
def _connected(
    recording: rr.RecordingStream, viewer: Viewer, port: int, blueprint: rrb.Blueprint
) -> Iterator[str]:
    """Draw for a viewer, at the address that is yielded; ViewerGone where it does not last."""
    url = f"rerun+http://{LOOPBACK}:{port}/proxy"
    recording.connect_grpc(url, default_blueprint=blueprint)
    try:
        try:
            yield url
        finally:
            flush(recording)
    except ViewerGone as gone:
        why = viewer.last_words(END_S) or gone.why
        viewer.end()
        raise ViewerGone(why) from None
    finally:
        viewer.leave(recording)
