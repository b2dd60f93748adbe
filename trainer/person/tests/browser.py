"""A real Chromium for the cockpit's tests, and for its picture in the documentation.

``python -m trainer.person.tests.browser --picture docs/cockpit.png`` takes that picture.
"""

import asyncio
import subprocess
import sys
import tempfile
from contextlib import asynccontextmanager

from trainer.util import find_chromium

PATIENCE_S = 20.0
DESKTOP = {"width": 1280, "height": 740}
POLICY_DRIVES = (
    "document.body.dataset.control === 'policy' && document.body.dataset.link === 'live'"
    " && !document.getElementById('message').textContent"
)
PERSON_DRIVES = "document.body.dataset.control === 'human'"


@asynccontextmanager
async def open_browser(scripts=(), **options):
    """A page (playwright's) in a fresh Chromium.

    Args:
        scripts: run in every page before its own.
        options: of playwright's context: size, touch and so on.
    """
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


async def until(page, expression):
    """Wait until a JavaScript expression is true.

    playwright's own ``wait_for_function`` evaluates within the page, which the page's security
    policy forbids.
    """
    async with asyncio.timeout(PATIENCE_S):
        while not await page.evaluate(f"Boolean({expression})"):
            await asyncio.sleep(0.01)


async def touch(link, what, *points):
    """One of the touch events Start, Move and End, by a page's DevTools link."""
    places = [{"x": x, "y": y} for x, y in points]
    await link.send("Input.dispatchTouchEvent", {"type": f"touch{what}", "touchPoints": places})


async def quit_sitting(page):
    """Quit, and be sure."""
    await page.keyboard.press("KeyQ")
    await page.keyboard.press("KeyQ")


def address(process):
    """The cockpit's address, which a ``--human web`` process prints."""
    for line in process.stdout:
        if line.startswith("cockpit: open "):
            return line.split()[-1]
    raise RuntimeError(f"it ended before it served the cockpit, with status {process.wait()}")


async def take_picture(url, path):
    """The cockpit in the middle of a take-over."""
    async with open_browser() as page:
        await page.goto(url)
        await until(page, POLICY_DRIVES)
        await asyncio.sleep(1.5)
        await page.keyboard.down("ArrowDown")
        await until(page, PERSON_DRIVES)
        await asyncio.sleep(0.5)
        await page.screenshot(path=path)
        await page.keyboard.up("ArrowDown")
        await quit_sitting(page)


def main(path):
    with tempfile.TemporaryDirectory() as directory:
        words = ["trainer", "drive", "--human", "web", "--policy", "expert", "--seed", "1"]
        command = [sys.executable, "-m", *words, "--out", directory]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                asyncio.run(take_picture(address(process), path))
                process.wait(30.0)
            finally:
                process.kill()


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--picture") + 1])
