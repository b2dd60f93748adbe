"""rerun's viewer without a screen.

Without a graphics card it draws in software, through Vulkan (Debian's mesa-vulkan-drivers).
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

from edge_runtime.util import UserError

SIZE = "1400x900"
START_S, LOOK_S = 60.0, 0.5
NEEDS = "it needs Vulkan, in software with apt install mesa-vulkan-drivers"


@contextlib.contextmanager
def headless_viewer() -> Iterator[Any]:
    """A viewer, as a ``ViewerClient`` that asks it for pictures.

    Raises:
        UserError: it does not start here, or ends as soon as it is to draw.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "rerun", "--headless", "--hide-welcome-screen"]
    command += ["--bind", "127.0.0.1", "--port", str(port), "--window-size", SIZE]
    # A group of its own: the module starts the real viewer as a child, which must end with it.
    viewer = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        yield _connect(viewer, f"rerun+http://127.0.0.1:{port}/proxy")
    except ConnectionError as error:
        raise UserError(f"rerun's viewer ends as it draws ({error}): {NEEDS}") from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait()


def _connect(viewer: subprocess.Popen[bytes], url: str) -> Any:
    from rerun.experimental import ViewerClient

    give_up_s = time.monotonic() + START_S
    while True:
        try:
            client = ViewerClient.connect(url)
            client.get_state()
            return client
        except Exception as error:
            if viewer.poll() is not None or time.monotonic() > give_up_s:
                raise UserError(f"rerun's viewer does not start here ({error}): {NEEDS}") from None
            time.sleep(LOOK_S)
