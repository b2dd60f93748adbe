"""``trainer train|drive --human web`` as a process of its own, as a person starts it."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

START_S, END_S = 60.0, 30.0
ENDLESS = 10**6
"""Episodes; the page ends the run before."""


class CockpitRun:
    """A running sitting whose person is in a browser.

    Args:
        process: the sitting.
        url: of its cockpit.
    """

    def __init__(self, process: asyncio.subprocess.Process, url: str) -> None:
        self.process, self.url = process, url

    async def ended(self) -> int:
        """Wait until it has ended; its exit status.

        Raises:
            TimeoutError: it goes on.
        """
        return await asyncio.wait_for(self.process.wait(), END_S)


@asynccontextmanager
async def cockpit_run(
    out: Path, options: Sequence[str] = (), command: str = "train"
) -> AsyncIterator[CockpitRun]:
    """Train or drive with ``--human web`` until the page quits; whatever is left is ended.

    Args:
        out: of the run, or of the recordings.
        options: more of the command's.
        command: ``train`` or ``drive``.

    Raises:
        RuntimeError: it ended before it served the cockpit; with its last line.
    """
    words = [sys.executable, "-m", "trainer", command, "--human", "web", "--port", "0"]
    words += ["--out", str(out), "--episodes", str(ENDLESS), *options]
    with tempfile.TemporaryFile() as log:
        process = await asyncio.create_subprocess_exec(
            *words, stdout=asyncio.subprocess.PIPE, stderr=log
        )
        try:
            url = await asyncio.wait_for(_address(process), START_S)
            if url is None:
                log.seek(0)
                lines = log.read().decode(errors="replace").strip().splitlines()
                raise RuntimeError(f"it ended early: {lines[-1] if lines else 'silent'}")
            yield CockpitRun(process, url)
        finally:
            if process.returncode is None:
                process.terminate()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(process.wait(), END_S)
            if process.returncode is None:
                process.kill()
                await process.wait()


async def _address(process: asyncio.subprocess.Process) -> str | None:
    """The address that it prints; None where it ends without."""
    assert process.stdout is not None
    while line := (await process.stdout.readline()).decode():
        if line.startswith("cockpit: open "):
            return line.split()[-1]
    return None
