"""Colours of all views, and the sink of a view: window, page or file.

Window and page are rerun's viewer in a process of its own, bound to loopback (its default is all
interfaces).
"""

from __future__ import annotations

import colorsys
import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from edge_runtime.cli import sigterm_as_interrupt
from edge_runtime.files import check_writable, draft_of
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError

if TYPE_CHECKING:  # rerun takes a second to load; options and checks go without it
    import rerun as rr
    import rerun.blueprint as rrb

# Read when rerun is imported. Silences its lines on a viewer that is gone: we print one.
os.environ.setdefault("RUST_LOG", "warn,re_grpc_client=off,re_sdk=off")

# A colour for each source of the car's commands, for light and dark backgrounds.
Colour = tuple[int, int, int]
POLICY: Colour = (40, 120, 230)
HUMAN: Colour = (60, 170, 90)
RETURNING: Colour = (185, 140, 255)
"""The person has let go, and the action is on its way back to the policy's."""
SHADOW: Colour = (20, 160, 150)  # A policy beside the one that drives
APPLIED: Colour = (235, 140, 40)  # The command that the car got, whoever decided it
BY_NAME = {"policy": POLICY, "human": HUMAN, "returning": RETURNING, "applied": APPLIED}
GROUND, ROAD, MARKING = (222, 229, 216), (92, 97, 105), (235, 235, 235)
PATH, GOAL, GLASS = (120, 190, 255), (84, 200, 120), (30, 34, 40)
"""Of the road from above; the other cars have APPLIED's colour."""
SPREAD = 150 / 360
"""Range of the hues of one colour's shades: asked and achieved actions stay distinguishable."""


def shades(colour: Colour, count: int) -> list[Colour]:
    """Return ``count`` colours: ``colour`` first, then the following hues."""
    hue, light, saturation = colorsys.rgb_to_hls(*(part / 255 for part in colour))
    hues = (hue + SPREAD * number / count for number in range(count))
    turned = [colorsys.hls_to_rgb(each % 1.0, light, saturation) for each in hues]
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in turned]


LOOPBACK = "127.0.0.1"
START_S = 30.0  # Limit until a viewer listens
LOOK_S = 0.05
WRITE_S = 60.0  # Limit until a file is written
FLUSH_S = 5.0  # Limit until a viewer has received everything
END_S = 3.0  # Limit until a viewer that receives no more has ended
FOXGLOVE_PORT = 8765  # Foxglove tries this port first
SPAWN, SERVE, SUFFIX = "spawn", "serve", ".rrd"


class ViewerGone(UserError):  # noqa: N818 (a person closed it: no error)
    """The viewer has ended, hangs, or never came."""


def has_display() -> bool:
    return any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def check_sink(sink: str | None, port: int | None = None) -> str:
    """Return the sink: spawn (also for None), serve, or an absolute path that ends in .rrd.

    UserError for any other, a missing display, a file that cannot be written, or a busy ``port``.
    """
    sink = sink or SPAWN
    if port is not None:
        if sink != SERVE:
            raise UserError(f"--port is that of a page: --{SERVE}")
        if any(map(_answers, (port, port + 1))):
            raise UserError(f"port {port} or {port + 1} is in use; name another --port")
    if sink.endswith(SUFFIX):
        return str(check_writable(sink))
    if sink not in (SPAWN, SERVE):
        raise UserError(f"{sink!r} is neither {SPAWN} nor {SERVE} nor a file FILE{SUFFIX}")
    if sink == SPAWN and not has_display():
        raise UserError("no display for a window here: serve a page, or save a file")
    return sink


@contextlib.contextmanager
def open_sink(
    sink: str, application: str, blueprint: rrb.Blueprint, port: int | None = None
) -> Iterator[rr.RecordingStream]:
    """Open a recording that goes to a window (``spawn``), a page (``serve``) or a file.

    ``application`` keeps layouts of different kinds apart. A window stays open afterwards; a page
    is served until then, at ``port`` if it is given. ViewerGone where the viewer ends or hangs.
    """
    import rerun as rr

    recording = rr.RecordingStream(application)
    opened = _saved(recording, sink, blueprint) if sink.endswith(SUFFIX) else None
    with sigterm_as_interrupt(), opened or _shown(recording, sink, blueprint, port):
        yield recording


def flush(recording: rr.RecordingStream) -> None:
    try:
        recording.flush(timeout_sec=FLUSH_S)
    except RuntimeError as error:
        raise ViewerGone(str(error)) from None


@contextlib.contextmanager
def _saved(recording: rr.RecordingStream, path: str, blueprint: rrb.Blueprint) -> Iterator[None]:
    """Record into a file that appears under its name when it is complete."""
    with draft_of(Path(path)) as draft:
        recording.save(draft, default_blueprint=blueprint)
        yield
        try:
            recording.flush(timeout_sec=WRITE_S)
        except RuntimeError as error:
            raise UserError(f"cannot write {path}: {error}") from None
        recording.disconnect()  # Writes the footer.


@contextlib.contextmanager
def _shown(
    recording: rr.RecordingStream, kind: str, blueprint: rrb.Blueprint, port: int | None
) -> Iterator[None]:
    """Draw for a window or a page; ViewerGone where the viewer ends or hangs."""
    page, data = (port, port + 1) if port else (free_port(), free_port())
    options, ports = ["--expect-data-soon"], [data]
    if kind == SERVE:
        options, ports = ["--serve-web", "--web-viewer-port", str(page)], [page, data]
    viewer = Viewer([*options, "--port", str(data)], ports)
    try:
        url = f"rerun+http://{LOOPBACK}:{data}/proxy"
        recording.connect_grpc(url, default_blueprint=blueprint)
        if kind == SERVE:
            print(f"open http://{LOOPBACK}:{page}/?url={quote(url, safe='')}", flush=True)
        try:
            yield
        finally:
            flush(recording)
    except ViewerGone as gone:
        why = viewer.last_words(END_S)
        viewer.end()  # Otherwise rerun waits for ever for a viewer that hangs.
        raise ViewerGone(why or str(gone)) from None
    finally:
        recording.disconnect()
        if kind == SERVE:
            viewer.end()


class Viewer:
    """A viewer that listens at ``ports``; ViewerGone where it ends at once or listens too late."""

    def __init__(self, options: Sequence[str], ports: Sequence[int]) -> None:
        command = [sys.executable, "-m", "rerun_cli", "--bind", LOOPBACK, *options]
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 (open for as long as the viewer writes)
        quiet: Any = {"stdout": subprocess.DEVNULL, "stderr": self._said}
        environment = {**os.environ, "RERUN_APP_ONLY": "true"}  # As rerun's own spawn: no questions
        # A process group of its own: ^C does not reach it, and `end` also kills its child.
        self._process = subprocess.Popen(command, env=environment, start_new_session=True, **quiet)
        end_s = time.monotonic() + START_S
        try:
            while not all(map(_answers, ports)):
                words = self.last_words(LOOK_S)
                if words or time.monotonic() > end_s:
                    raise ViewerGone(words or f"it does not listen after {START_S:.0f} s")
        except BaseException:
            self.end()
            raise

    def end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def last_words(self, wait_s: float) -> str:
        """Return why the viewer has ended, "" if it still runs after ``wait_s``."""
        try:
            self._process.wait(wait_s)
        except subprocess.TimeoutExpired:
            return ""
        self._said.seek(0)
        _, error, last = self._said.read().decode(errors="replace").rpartition("Error: ")
        return last.strip() if error else "it was closed"


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


def _answers(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), LOOK_S):
        return True
    return False
