"""What a test waits for: a reading of the cockpit's, or something in the page."""

import asyncio
import time

WAIT_S = 10.0
LIVE = "document.body.dataset.link === 'live'"
READY = f"{LIVE} && document.getElementById('scenario').textContent"
TWO_HEARTBEATS = "new Promise((done) => setTimeout(done, 200))"
WHY = "document.getElementById('why').textContent"
YOU = "document.querySelector('.bar.human output').textContent"


def poll(cockpit):
    return cockpit.poll(time.monotonic())


async def reads(cockpit, condition):
    """Poll until the reading is as wanted; that reading."""
    end_s = time.monotonic() + WAIT_S
    while not condition(reading := poll(cockpit)):
        assert time.monotonic() < end_s, reading
        await asyncio.sleep(0.005)
    return reading
