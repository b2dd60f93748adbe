"""The page in a real headless Chromium: hands become readings, and losing it is letting go."""

import asyncio
from dataclasses import replace

import pytest

from trainer.environments import make_environment
from trainer.person.tests.browser import (
    LIVE,
    OVER,
    WHY,
    first_view,
    page,
    poll,
    reads,
    until,
)
from trainer.person.tests.people import LET_GO
from trainer.person.web import controls_of

pytestmark = pytest.mark.usefixtures("opened")

LEVEL = "document.getElementById('pad').className === 'level'"
HIDE = "Object.defineProperty(document, 'hidden', {configurable: true, value: %s})"
SEEN = "window.dispatchEvent(new Event('visibilitychange'))"
HANG = "(() => { const t = Date.now(); while (Date.now() - t < 700); })()"


async def press_again(browser, cockpit):
    """After a hold that does not count any more, let go and press again: that counts."""
    await until(browser, f"{LIVE} && {WHY}.includes('press again')")
    assert poll(cockpit) == LET_GO, "held all the while"
    await browser.keyboard.up("ArrowUp")
    await browser.keyboard.down("ArrowUp")
    await reads(cockpit, lambda r: r.engaged)
    await browser.keyboard.up("ArrowUp")
    await reads(cockpit, lambda r: r == LET_GO)


async def test_keys_take_over_and_their_release_or_a_lost_page_lets_go(browser, cockpit):
    await browser.keyboard.down("ArrowUp")
    assert (await reads(cockpit, lambda r: r.engaged)).action >= 0.5
    await reads(cockpit, lambda r: r.action == 1.0)
    await browser.keyboard.down("ArrowDown")
    await browser.keyboard.up("ArrowUp")
    await reads(cockpit, lambda r: r.action == -1.0)
    await browser.keyboard.up("ArrowDown")
    await reads(cockpit, lambda r: r == LET_GO)
    # The space bar holds without driving, and presses no button.
    await browser.evaluate("document.querySelector('[data-wish=restart]').focus()")
    await browser.keyboard.down("Space")
    assert (await reads(cockpit, lambda r: r.engaged)).action == 0.0
    await browser.keyboard.up("Space")
    assert not (await reads(cockpit, lambda r: not r.engaged)).wishes
    # A key whose coming up may be lost is let go.
    for lost in ("new Event('blur')", "new MouseEvent('contextmenu')",
                 "new KeyboardEvent('keydown', {key: 'Meta', metaKey: true})"):  # fmt: skip
        await browser.keyboard.down("ArrowUp")
        await reads(cockpit, lambda r: r.engaged)
        await browser.evaluate(f"window.dispatchEvent({lost})")
        await reads(cockpit, lambda r: r == LET_GO)
        await browser.keyboard.up("ArrowUp")
    # A page that hangs has let go, too, and must press again.
    await browser.keyboard.down("ArrowUp")
    await reads(cockpit, lambda r: r.engaged)
    busy = asyncio.create_task(browser.evaluate(HANG))
    await reads(cockpit, lambda r: r == LET_GO)
    assert not cockpit.present
    await busy
    await press_again(browser, cockpit)
    # Wishes come once each.
    for wished, how in (
        ("pause", browser.click("[data-wish=pause]")),
        ("restart", browser.keyboard.press("KeyR")),
        ("discard", browser.keyboard.press("Backspace")),
        ("quit", browser.keyboard.press("KeyQ")),
    ):
        await how
        await reads(cockpit, lambda r, wished=wished: r.wishes == {wished})


async def test_a_finger_and_the_main_button_alone_drive_on_the_pad(browser, cockpit):
    link = await browser.context.new_cdp_session(browser)

    async def touch(what, *points):
        places = [{"x": x, "y": y} for x, y in points]
        await link.send("Input.dispatchTouchEvent", {"type": f"touch{what}", "touchPoints": places})

    box = await browser.evaluate("document.getElementById('pad').getBoundingClientRect().toJSON()")
    x, middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await touch("Start", (x, middle))
    assert abs((await reads(cockpit, lambda r: r.engaged)).action) < 0.05
    await touch("Move", (x, middle - 0.45 * box["height"]))
    await reads(cockpit, lambda r: r.action == 1.0)
    await touch("Move", (x, middle + 0.225 * box["height"]))
    reading = await reads(cockpit, lambda r: r.action < 0.0)
    assert reading.action == pytest.approx(-0.5, abs=0.05)
    await touch("End")
    await reads(cockpit, lambda r: r == LET_GO)
    await browser.hover("#pad")
    await browser.mouse.down(button="right")
    await asyncio.sleep(0.2)
    assert poll(cockpit) == LET_GO
    await browser.mouse.up(button="right")
    await browser.mouse.down()
    await reads(cockpit, lambda r: r.engaged)
    await browser.mouse.up()
    await reads(cockpit, lambda r: r == LET_GO)


async def test_a_gamepad_takes_over_by_its_button_unless_hidden_and_a_wheel_by_moving(
    browser, cockpit
):
    def pad(**pressed):
        buttons = [float(pressed.get(f"b{number}", 0.0)) for number in range(17)]
        return browser.evaluate(f"plug('Pad', 'standard', [0, 0, 0, 0], {buttons})")

    await pad(b7=1)
    assert not (await reads(cockpit, lambda r: r.action == 1.0)).engaged
    await pad(b5=1, b7=1)
    assert (await reads(cockpit, lambda r: r.engaged)).action == 1.0
    # Browsers say nothing new of a gamepad to a hidden page.
    await browser.evaluate(f"{HIDE % 'true'}; {SEEN}")
    await reads(cockpit, lambda r: r == LET_GO)
    assert cockpit.present
    await browser.evaluate(f"{HIDE % 'false'}; {SEEN}")
    await reads(cockpit, lambda r: r.engaged)
    await browser.evaluate("delete pads[0]")
    await reads(cockpit, lambda r: r == LET_GO)
    # In the congestion, which is steered; the wheel's choices are kept.
    cockpit.controls = controls_of(make_environment("congestion"))
    cockpit.show(first_view("congestion"))
    await until(browser, LEVEL)
    wheel = f"plug('G29', '', [-0.25, 0, 1, 1], {[0.0] * 24})"
    await browser.evaluate(wheel)
    reading = await reads(cockpit, lambda r: r.by_moving)
    assert reading.action == -1.0, "a quarter of its travel is full action"
    await browser.evaluate(
        "full.value = 1; full.dispatchEvent(new Event('input'));"
        "invert.checked = true; invert.dispatchEvent(new Event('input'))"
    )
    turned = (0.25 - 0.02) / 0.98
    assert (await reads(cockpit, lambda r: r.action > 0.0)).action == pytest.approx(turned)
    await browser.goto(cockpit.url)
    await browser.evaluate(wheel)
    assert (await reads(cockpit, lambda r: r.by_moving)).action == pytest.approx(turned)
    await browser.evaluate("delete pads[0]")


async def test_what_is_shown_is_drawn_and_a_second_page_watches_until_the_end(browser, cockpit):
    view = replace(first_view(), control="human", speed_mps=4.25, message="saving", progress="94%")
    cockpit.show(view)
    await until(browser, "document.getElementById('progress').textContent === '94%'")
    for place, shown in (("#who", "You drive"), ("#speed-value", "4.3"), ("#message", "saving"),
                         (".bar.policy output", "0.25"),
                         ("#keys span:nth-child(2)", "Up / W: pedal +1")):  # fmt: skip
        assert await browser.text_content(place) == shown
    # The newer frame's pixels are the policy's own.
    pixel = (
        "[...document.querySelectorAll('#frames canvas')[1].getContext('2d')"
        ".getImageData(0, 0, 80, 45).data].filter((_, i) => i % 4 === 0)"
    )
    assert view.frames is not None
    assert await browser.evaluate(pixel) == view.frames[1].ravel().tolist()
    await browser.goto("about:blank")
    async with page(cockpit):
        await browser.goto(cockpit.url)
        await until(browser, "document.body.classList.contains('watching')")
        await browser.keyboard.down("ArrowUp")
        await asyncio.sleep(0.2)
        assert not poll(cockpit).engaged
        await browser.keyboard.up("ArrowUp")
    await until(browser, "!document.body.classList.contains('watching')")
    cockpit.close()
    await until(browser, OVER)
