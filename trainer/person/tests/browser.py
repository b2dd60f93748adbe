"""The cockpit's pages for tests: a WebSocket that talks as a page does, and a real Chromium."""

import asyncio
import shutil
import time
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import cache

import aiohttp

from trainer.environments import make_environment
from trainer.person import View

WAIT_S, PATIENCE_S = 5.0, 20.0
DESKTOP = {"width": 1280, "height": 740}
LIVE = "document.body.dataset.link === 'live'"
READY = f"{LIVE} && document.getElementById('scenario').textContent"
OVER = "document.body.dataset.link === 'over'"
PERSON_DRIVES = "document.body.dataset.control === 'human'"
POLICY_DRIVES = (
    f"document.body.dataset.control === 'policy' && {LIVE}"
    " && !document.getElementById('message').textContent"
)
WHY = "document.getElementById('why').textContent"
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find_chromium() -> str | None:
    """The path of the browser, or None where there is none."""
    return next((path for name in CHROMIUM if (path := shutil.which(name))), None)


@cache
def first_view(scenario: str = "left_turn") -> View:
    env = make_environment(scenario)
    frames, info = env.reset(seed=3)
    return View(
        scenario=scenario, scene=env.scene(), frames=frames,
        policy_action=0.25, human_action=-0.5, applied_action=0.25, control="policy",
        speed_mps=info["speed_mps"], distance_m=info["distance_m"], goal_m=env.config.goal_m,
        episode=1, step=0, time_s=0.0,
    )  # fmt: skip


def view_of_step(step: int) -> View:
    return replace(first_view(), step=step)


def origin(cockpit):
    return f"http://127.0.0.1:{cockpit.port}"


@asynccontextmanager
async def page(cockpit, **more):
    options = {"origin": origin(cockpit), **more}
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(cockpit.url + "socket", **options) as link,
    ):
        yield link


async def say(link, engaged=False, action=0.0, **more):
    """Say something as a page does; the echo."""
    await link.send_json({"at_ms": 12.5, "action": action, "engaged": engaged, **more})
    return await hear(link, "echo")


async def hear(link, kind):
    while True:
        message = await link.receive_json(timeout=WAIT_S)
        if message["kind"] == kind:
            return message


def poll(cockpit):
    return cockpit.poll(time.monotonic())


async def reads(cockpit, condition):
    async with asyncio.timeout(PATIENCE_S):
        while not condition(reading := poll(cockpit)):
            await asyncio.sleep(0.005)
    return reading


async def until(page, expression):
    """Wait until a JavaScript expression is true; the page's security policy forbids playwright's
    own ``wait_for_function``, which evaluates within the page."""
    async with asyncio.timeout(PATIENCE_S):
        while not await page.evaluate(f"Boolean({expression})"):
            await asyncio.sleep(0.01)


@asynccontextmanager
async def open_browser(scripts=(), **options):
    """A page in a fresh Chromium; ``scripts`` run before its own, ``options`` are playwright's."""
    from playwright.async_api import async_playwright  # here: only browser tests need it

    async with async_playwright() as playwright:
        chromium = await playwright.chromium.launch(
            executable_path=find_chromium(),
            args=["--no-sandbox", "--disable-quic"],  # containers run as root
        )
        context = await chromium.new_context(**{"viewport": DESKTOP, **options})
        for script in scripts:
            await context.add_init_script(script)
        yield await context.new_page()
        await chromium.close()


async def quit_sitting(page):
    await page.click("[data-wish=quit]")
    await until(page, OVER)  # A page that closes sooner may take the word with it.


def address(process):
    """The cockpit's address, which a ``--human web`` process prints."""
    for line in process.stdout:
        if line.startswith("cockpit: open "):
            return line.split()[-1]
    raise RuntimeError(f"it ended before it served the cockpit, with status {process.wait()}")
