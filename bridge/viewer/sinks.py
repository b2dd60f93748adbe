"""Where a recording goes: a window, a local web page, or a file."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import rerun as rr

from bridge.viewer.blueprint import make_blueprint
from edge_runtime.cli import UserError

LOOPBACK = "127.0.0.1"
GRPC_PORT = 9876
WEB_PORT = 9090
APPLICATION = "phil_hil"


@contextlib.contextmanager
def save_to(path: str) -> Iterator[rr.RecordingStream]:
    """Record into a file that appears under its name when it is complete."""
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        recording = rr.RecordingStream(APPLICATION)
        recording.save(temporary, default_blueprint=make_blueprint(None))
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
        raise UserError("no display for a window here; use --serve or --save FILE.rrd")


@contextlib.contextmanager
def spawn_window() -> Iterator[rr.RecordingStream]:
    """Show in rerun's own window, which stays open afterwards."""
    recording = rr.RecordingStream(APPLICATION)
    recording.spawn(default_blueprint=make_blueprint(None))
    with _disconnected(recording):
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
def serve_page() -> Iterator[rr.RecordingStream]:
    """Show in a browser on this machine only: rerun's own server would bind all interfaces."""
    with _web_server():
        recording = rr.RecordingStream(APPLICATION)
        url = f"rerun+http://{LOOPBACK}:{GRPC_PORT}/proxy"
        recording.connect_grpc(url, default_blueprint=make_blueprint(None))
        print(f"open http://{LOOPBACK}:{WEB_PORT}/?url={quote(url, safe='')}", flush=True)
        with _disconnected(recording):
            yield recording


@contextlib.contextmanager
def _web_server() -> Iterator[None]:
    command = [sys.executable, "-m", "rerun", "--serve-web", "--bind", LOOPBACK]
    command += ["--port", str(GRPC_PORT), "--web-viewer-port", str(WEB_PORT)]
    # A group of its own: the module starts the real server as a child, which must end with it.
    server = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield
    finally:
        os.killpg(server.pid, signal.SIGTERM)
        server.wait()


@contextlib.contextmanager
def _disconnected(recording: rr.RecordingStream) -> Iterator[None]:
    try:
        yield
    finally:
        recording.flush(timeout_sec=5.0)
        recording.disconnect()
