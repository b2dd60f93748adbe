"""``trainer train --human web`` as a process of its own, as a person starts it."""

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
    """A running training whose person sits in a browser.

    Args:
        process: the training.
        url: of its cockpit.
        run_dir: where it keeps its run.
    """

    def __init__(self, process: asyncio.subprocess.Process, url: str, run_dir: Path) -> None:
        self.process, self.url, self.run_dir = process, url, run_dir

    async def ended(self) -> int:
        """Wait until it has ended; its exit status.

        Raises:
            TimeoutError: it goes on.
        """
        return await asyncio.wait_for(self.process.wait(), END_S)


@asynccontextmanager
async def cockpit_run(run_dir: Path, options: Sequence[str] = ()) -> AsyncIterator[CockpitRun]:
    """Train with ``--human web`` until the page quits; whatever is left is ended.

    Args:
        run_dir: of the run.
        options: more of ``trainer train``'s.

    Raises:
        RuntimeError: it ended before it served the cockpit; with its last line.
    """
    command = [sys.executable, "-m", "trainer", "train", "--human", "web", "--port", "0"]
    command += ["--out", str(run_dir), "--episodes", str(ENDLESS), *options]
    with tempfile.TemporaryFile() as log:
        process = await asyncio.create_subprocess_exec(
            *command, stdout=asyncio.subprocess.PIPE, stderr=log
        )
        try:
            url = await asyncio.wait_for(_address(process), START_S)
            if url is None:
                log.seek(0)
                lines = log.read().decode(errors="replace").strip().splitlines()
                raise RuntimeError(f"the training ended early: {lines[-1] if lines else 'silent'}")
            yield CockpitRun(process, url, run_dir)
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
