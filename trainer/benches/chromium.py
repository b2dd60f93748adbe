"""One page in a headless Chromium, through its DevTools protocol: real keys, touches, pictures."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import os
import shutil
import signal
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless",
    "--no-sandbox",  # containers and continuous integration run as root
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--remote-debugging-port=0",
)
START_S, ANSWER_S, END_S = 30.0, 20.0, 5.0
PORT_FILE = "DevToolsActivePort"
WINDOWS_CODES = {"Space": 32, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}
"""Key codes that the protocol wants beside the name; a letter's is its capital's ASCII code."""


def find_chromium() -> str | None:
    """The browser's path, or None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page. Everything waits for Chromium's answer.

    Args:
        link: the page's DevTools socket.
    """

    def __init__(self, link: aiohttp.ClientWebSocketResponse) -> None:
        self._link = link
        self._numbers = itertools.count(1)
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._loaded = asyncio.Event()
        self._reader = asyncio.create_task(self._read())

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call one of the protocol's methods; its result.

        Raises:
            RuntimeError: Chromium refuses.
        """
        number = next(self._numbers)
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        await self._link.send_json({"id": number, "method": method, "params": parameters})
        said = await asyncio.wait_for(answer, ANSWER_S)
        if "error" in said:
            raise RuntimeError(f"{method}: {said['error']['message']}")
        return dict(said["result"])

    async def open(self, url: str) -> None:
        """Go to a page, and wait until it is loaded."""
        self._loaded.clear()
        said = await self.call("Page.navigate", url=url)
        if "errorText" in said:
            raise RuntimeError(f"{url}: {said['errorText']}")
        await asyncio.wait_for(self._loaded.wait(), ANSWER_S)

    async def value(self, expression: str) -> Any:
        """What a JavaScript expression is in the page."""
        said = await self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in said:
            raise RuntimeError(f"{expression}: {said['exceptionDetails']['text']}")
        return said["result"].get("value")

    async def text(self, selector: str) -> str:
        """The text of the first element of a CSS selector."""
        return str(await self.value(f"document.querySelector({selector!r}).textContent"))

    async def until(self, expression: str, timeout_s: float = ANSWER_S) -> None:
        """Wait until a JavaScript expression is true.

        Raises:
            TimeoutError: it is not.
        """
        async with asyncio.timeout(timeout_s):
            while not await self.value(f"Boolean({expression})"):
                await asyncio.sleep(0.01)

    async def key(self, code: str, down: bool) -> None:
        """Press or release a key, by its ``KeyboardEvent.code``."""
        letter = code.removeprefix("Key")
        await self.call(
            "Input.dispatchKeyEvent",
            type="rawKeyDown" if down else "keyUp",
            code=code,
            key={"Space": " "}.get(code, letter if code in WINDOWS_CODES else letter.lower()),
            windowsVirtualKeyCode=WINDOWS_CODES.get(code) or ord(letter),
        )

    async def tap(self, code: str) -> None:
        """Press and release a key."""
        await self.key(code, True)
        await self.key(code, False)

    async def touch(self, *points: tuple[float, float]) -> None:
        """Where fingers are now, in the page's pixels; without any, they are lifted."""
        kind = "touchEnd" if not points else "touchMove" if self._touching else "touchStart"
        self._touching = bool(points)
        places = [{"x": x, "y": y} for x, y in points]
        await self.call("Input.dispatchTouchEvent", type=kind, touchPoints=places)

    _touching = False

    async def picture(self) -> bytes:
        """The page as a PNG file."""
        return base64.b64decode((await self.call("Page.captureScreenshot"))["data"])

    async def close(self) -> None:
        """End the browser's conversation."""
        self._reader.cancel()
        await self._link.close()

    async def _read(self) -> None:
        async for message in self._link:
            said = message.json()
            if said.get("method") == "Page.loadEventFired":
                self._loaded.set()
            answer = self._answers.pop(said.get("id"), None)
            if answer is not None and not answer.done():
                answer.set_result(said)


@asynccontextmanager
async def open_browser(
    size: tuple[int, int] = (1280, 740), extra: tuple[str, ...] = ()
) -> AsyncIterator[Browser]:
    """A fresh Chromium with one empty page; ended with all its processes.

    Args:
        size: of the page, pixels.
        extra: more of Chromium's flags.

    Raises:
        FileNotFoundError: there is no Chromium here.
        TimeoutError: it does not start.
    """
    program = find_chromium()
    if program is None:
        raise FileNotFoundError(f"none of {', '.join(NAMES)} is installed")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = await asyncio.create_subprocess_exec(
            program,
            *FLAGS,
            *extra,
            f"--window-size={size[0]},{size[1]}",
            f"--user-data-dir={profile}",
            "about:blank",
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            async with aiohttp.ClientSession() as session:
                link = await session.ws_connect(await _page_address(session, Path(profile)))
                browser = Browser(link)
                await browser.call("Page.enable")
                await browser.call(
                    "Emulation.setDeviceMetricsOverride",
                    width=size[0],
                    height=size[1],
                    deviceScaleFactor=1,
                    mobile=False,
                )
                try:
                    yield browser
                finally:
                    await browser.close()
        finally:
            await _end(process)


async def _page_address(session: aiohttp.ClientSession, profile: Path) -> str:
    """The DevTools socket of the first page, once Chromium has written down its port."""
    async with asyncio.timeout(START_S):
        while not (lines := _lines(profile / PORT_FILE)):
            await asyncio.sleep(0.02)
        while True:
            async with session.get(f"http://127.0.0.1:{lines[0]}/json/list") as answer:
                targets = await answer.json()
            for target in targets:
                if target["type"] == "page":
                    return str(target["webSocketDebuggerUrl"])
            await asyncio.sleep(0.02)


def _lines(path: Path) -> list[str]:
    """The port file's lines; none until it is whole."""
    try:
        text = path.read_text()
    except FileNotFoundError:
        return []
    return text.splitlines() if text.count("\n") else []


async def _end(process: asyncio.subprocess.Process) -> None:
    """End Chromium and its helpers, which share its session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(process.wait(), END_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    await process.wait()
