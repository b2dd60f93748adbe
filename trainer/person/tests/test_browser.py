"""The page in a real headless Chromium: hands become readings, and losing it is letting go."""

import asyncio
from contextlib import closing
from dataclasses import replace
from typing import Any

import pytest

from bridge.rerun import BY_NAME, shades
from hil_tests.testing.browser import (
    LIVE,
    OVER,
    READY,
    WHY,
    Tunnel,
    first_view,
    page,
    poll,
    reads,
    until,
    view_of_step,
)
from hil_tests.testing.environments import ROVER
from hil_tests.testing.people import LET_GO
from trainer.person.coach import Coaching, SittingEpisode, advise
from trainer.person.web import Cockpit

pytestmark = pytest.mark.usefixtures("opened")

TWO_HEARTBEATS = "new Promise((done) => setTimeout(done, 200))"
YOU = "document.querySelector('.bar.human output').textContent"
COLOURS_IN = (
    "new Set(new Uint32Array({0}.getContext('2d')"
    ".getImageData(0, 0, {0}.width, {0}.height).data.buffer)).size"
)
"""How many colours a canvas shows."""
LEVEL = "document.getElementById('pad').className === 'level'"


async def press_again(browser, cockpit):
    """After a hold that does not count any more, let go and press again: that counts."""
    await until(browser, f"{LIVE} && {WHY}.includes('press again')")
    assert poll(cockpit) == LET_GO, "held all the while"
    await browser.keyboard.up("ArrowUp")
    await browser.keyboard.down("ArrowUp")
    await reads(cockpit, lambda r: r.engaged)
    await browser.keyboard.up("ArrowUp")


async def test_a_held_key_takes_over_and_grows_and_its_release_lets_go(browser, cockpit):
    await browser.keyboard.down("ArrowUp")
    assert (await reads(cockpit, lambda r: r.engaged)).action >= 0.5
    await reads(cockpit, lambda r: r.action == 1.0)
    await browser.keyboard.down("ArrowDown")
    await browser.keyboard.up("ArrowUp")
    await reads(cockpit, lambda r: r.action == -1.0)
    await browser.keyboard.up("ArrowDown")
    await reads(cockpit, lambda r: r == LET_GO)


async def test_the_space_bar_holds_without_driving_and_presses_no_button(browser, cockpit):
    await browser.evaluate("document.querySelector('[data-wish=restart]').focus()")
    await browser.keyboard.down("Space")
    reading = await reads(cockpit, lambda r: r.engaged)
    assert reading.action == 0.0
    await browser.keyboard.up("Space")
    assert not (await reads(cockpit, lambda r: not r.engaged)).wishes


async def test_in_the_congestion_left_and_right_steer(browser, cockpit):
    cockpit.show(first_view("congestion"))
    await until(browser, LEVEL)
    await browser.keyboard.down("ArrowLeft")
    await reads(cockpit, lambda r: r.action == -1.0)
    await browser.keyboard.up("ArrowLeft")
    await reads(cockpit, lambda r: r == LET_GO)
    await browser.keyboard.down("ArrowUp")
    await browser.evaluate(TWO_HEARTBEATS)
    assert not poll(cockpit).engaged
    await browser.keyboard.up("ArrowUp")


HIDE = "Object.defineProperty(document, 'hidden', {configurable: true, value: %s})"
SEEN = "window.dispatchEvent(new Event('visibilitychange'))"


async def test_a_hidden_page_has_let_go_and_comes_back_without_a_pile_of_frames(browser, cockpit):
    """Browsers say nothing new of a gamepad there, and give no animation frame."""
    held = [0.0] * 17
    held[5] = held[7] = 1.0
    await browser.evaluate(f"plug('Pad', 'standard', [0, 0, 0, 0], {held})")
    await reads(cockpit, lambda r: r.engaged)
    await browser.evaluate(
        f"{HIDE % 'true'}; window.asked = 0; requestAnimationFrame = () => asked++; {SEEN}"
    )
    await reads(cockpit, lambda r: r == LET_GO)
    for step in range(20):
        cockpit.show(view_of_step(step))
        await asyncio.sleep(0.02)
    assert poll(cockpit) == LET_GO
    assert await browser.evaluate("asked") == 0
    assert cockpit.present
    await browser.evaluate(f"{HIDE % 'false'}; {SEEN}")
    await reads(cockpit, lambda r: r.engaged)
    assert await browser.evaluate("asked") == 1


async def test_a_key_whose_coming_up_may_be_lost_is_let_go(browser, cockpit):
    for lost in ("new Event('blur')", "new MouseEvent('contextmenu')",
                 "new KeyboardEvent('keydown', {key: 'Meta', metaKey: true})"):  # fmt: skip
        await browser.keyboard.down("ArrowUp")
        await reads(cockpit, lambda r: r.engaged)
        await browser.evaluate(f"window.dispatchEvent({lost})")
        await reads(cockpit, lambda r: r == LET_GO)
        await browser.keyboard.up("ArrowUp")


async def test_only_the_main_button_holds_the_pad(browser, cockpit):
    await browser.hover("#pad")
    await browser.mouse.down(button="right")
    await asyncio.sleep(0.2)
    assert poll(cockpit) == LET_GO
    await browser.mouse.up(button="right")
    await browser.mouse.down()
    await reads(cockpit, lambda r: r.engaged)
    await browser.mouse.up()
    await reads(cockpit, lambda r: r == LET_GO)


async def test_a_page_that_hangs_has_let_go_and_must_press_again(browser, cockpit):
    await browser.keyboard.down("ArrowUp")
    await reads(cockpit, lambda r: r.engaged)
    busy = asyncio.create_task(
        browser.evaluate("(() => { const t = Date.now(); while (Date.now() - t < 1000); })()")
    )
    await reads(cockpit, lambda r: r == LET_GO)
    assert not cockpit.present
    await busy
    await press_again(browser, cockpit)


async def test_a_finger_on_the_pad_drives(browser, cockpit):
    link = await browser.context.new_cdp_session(browser)

    async def touch(what, *points):
        places = [{"x": x, "y": y} for x, y in points]
        await link.send("Input.dispatchTouchEvent", {"type": f"touch{what}", "touchPoints": places})

    box = await browser.evaluate("document.getElementById('pad').getBoundingClientRect().toJSON()")
    x, middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await touch("Start", (x, middle))
    assert abs((await reads(cockpit, lambda r: r.engaged)).action) < 0.05
    long_press = "new MouseEvent('contextmenu', {bubbles: true, cancelable: true})"
    menu = await browser.evaluate(f"document.getElementById('pad').dispatchEvent({long_press})")
    assert not menu, "as a phone asks for one under a thumb that stays"
    await touch("Move", (x, middle - 0.45 * box["height"]))
    await reads(cockpit, lambda r: r.action == 1.0)
    await touch("Move", (x, middle + 0.225 * box["height"]))
    reading = await reads(cockpit, lambda r: r.action < 0.0)
    assert reading.action == pytest.approx(-0.5, abs=0.05)
    await touch("End")
    await reads(cockpit, lambda r: r == LET_GO)


TOUCHED = [(667, 375), (932, 430), (360, 640), (1024, 768), (768, 1024)]
"""Phones and tablets, either way up."""
LONG_ADVICE = advise([SittingEpisode(0, "collision", 0.0, 0)] * 10, None, {})


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
async def test_a_thumb_finds_pad_and_buttons_beside_the_road(browser, cockpit, scenario):
    said = Coaching(LONG_ADVICE, "", "", [], [], 0.0, [])
    context = await browser.context.browser.new_context(is_mobile=True, has_touch=True)
    async with context, await context.new_page() as page:
        for width, height in TOUCHED:
            await page.set_viewport_size({"width": width, "height": height})
            await page.goto(cockpit.url)  # Laid out anew.
            cockpit.show(replace(first_view(scenario), coach=said))
            await until(page, f"{READY} && document.getElementById('advice').textContent")
            boxes = await page.evaluate(
                "Object.fromEntries(['pad', 'scene', 'control', 'buttons'].map((id) => "
                "[id, document.getElementById(id).getBoundingClientRect().toJSON()]))"
            )
            for box in boxes.values():
                assert box["left"] >= 0, (width, height)
                assert box["right"] <= width, height
                assert box["bottom"] <= height, width
            pad, road = boxes["pad"], boxes["scene"]
            assert pad["width"] >= 240, (width, height)
            assert pad["height"] >= 190, (width, height)
            assert road["width"] >= 0.55 * width, height
            beside = pad["left"] >= road["right"] or pad["top"] >= road["bottom"]
            assert beside, (width, height)


async def test_a_gamepads_triggers_drive_while_its_button_is_held(browser, cockpit):
    buttons = [0.0] * 17
    for index, value in ((7, 1.0), (6, 0.0)):
        buttons[index] = value
    await browser.evaluate(f"plug('Pad', 'standard', [0, 0, 0, 0], {buttons})")
    assert not (await reads(cockpit, lambda r: r.action == 1.0)).engaged
    buttons[5] = 1.0
    await browser.evaluate(f"plug('Pad', 'standard', [0, 0, 0, 0], {buttons})")
    assert (await reads(cockpit, lambda r: r.engaged)).action == 1.0
    await browser.evaluate("delete pads[0]")
    await reads(cockpit, lambda r: r == LET_GO)


async def test_a_gamepad_that_the_browser_does_not_know_takes_over_by_a_button(browser, cockpit):
    await browser.evaluate(f"plug('Twin Stick', '', [0, 0, -1, 1], {[0.0] * 12})")
    assert not (await reads(cockpit, lambda r: r.action == 1.0)).by_moving


async def test_a_wheel_takes_over_by_moving_and_its_choices_are_kept(browser, cockpit):
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


async def test_a_tap_of_a_gamepads_button_and_of_a_pedal_is_heard_however_short(browser, cockpit):
    """Both come and go between two polls of the loop."""
    wait = "await new Promise((done) => setTimeout(done, 40));"
    press = "plug('{0}', '{1}', [0, 0, {2}, 1], {3}); " + wait
    for name, mapping, before, after in (
        ("Pad", "standard", (0, [0.0] * 17), (0, [*[0.0] * 5, 1.0, *[0.0] * 11])),
        ("G29", "", (1, [0.0] * 24), (-1, [0.0] * 24)),
    ):
        taps = "".join(press.format(name, mapping, *it) for it in (before, after, before))
        await browser.evaluate(f"(async () => {{ {taps} }})()")
        reading = poll(cockpit)
        assert (reading.engaged, reading.by_moving) == (name == "Pad", name == "G29")
        assert reading.action == float(name == "G29")
        assert not poll(cockpit).engaged
        await browser.evaluate("delete pads[0]")
        await reads(cockpit, lambda r: r == LET_GO)


async def test_a_gamepads_own_buttons_pause_and_restart(browser, cockpit):
    buttons = [0.0] * 17
    for pressed, wished in ((9, set()), (None, set()), (9, {"pause"}), (8, {"restart"})):
        shown = [float(number == pressed) for number in range(len(buttons))]
        await browser.evaluate(f"plug('Pad', 'standard', [0, 0, 0, 0], {shown})")
        await browser.evaluate(TWO_HEARTBEATS)
        assert poll(cockpit).wishes == wished, "the first press only shows the page the device"


async def test_buttons_and_keys_wish_once(browser, cockpit):
    await browser.evaluate("document.querySelector('[data-wish=pause]').click()")
    await reads(cockpit, lambda r: r.wishes == {"pause"})
    await browser.keyboard.press("KeyR")
    await reads(cockpit, lambda r: r.wishes == {"restart"})
    await browser.evaluate("document.querySelector('[data-wish=discard]').click()")
    await reads(cockpit, lambda r: r.wishes == {"discard"})
    await browser.evaluate("dispatchEvent(new KeyboardEvent('keydown', {code: 'Backspace'}))")
    await reads(cockpit, lambda r: r.wishes == {"discard"})
    for quit in (browser.keyboard.press("KeyQ"), browser.click("[data-wish=quit]")):
        await quit
        await reads(cockpit, lambda r: r.wishes == {"quit"})


async def test_what_is_shown_is_drawn(browser, cockpit):
    view: Any = replace(first_view(), control="human", speed_mps=4.25, message="saving", episode=7)
    cockpit.show(view)
    await until(browser, "document.body.dataset.control === 'human'")
    assert await browser.text_content("#who") == "You drive"
    assert await browser.text_content("#speed-value") == "4.3"
    assert await browser.text_content("#message") == "saving"
    assert (await browser.text_content("#place")).startswith("episode 8")
    assert await browser.text_content(".bar.policy output") == "0.25"
    # The newer frame's pixels are the policy's own, and the road is drawn in more than one
    # colour.
    pixel = (
        "[...document.querySelectorAll('#frames canvas')[1].getContext('2d')"
        ".getImageData(0, 0, 80, 45).data].filter((_, i) => i % 4 === 0)"
    )
    assert await browser.evaluate(pixel) == view.frames[1].ravel().tolist()
    assert await browser.evaluate(COLOURS_IN.format("scene")) > 10


async def test_several_actions_are_drawn_in_colours_of_their_own(browser):
    view = replace(first_view(), scenario=ROVER, scene=None, frames=None)
    with closing(Cockpit(scenario=ROVER)) as cockpit:
        await browser.goto(cockpit.url)
        await until(browser, LIVE)
        for step in range(20):
            cockpit.show(replace(
                view, step=step, policy_action=(0.9, 0.4), human_action=(0.0, 0.0),
                applied_action=(-0.4, -0.9),
            ))  # fmt: skip
            await asyncio.sleep(0.03)
        bars = await browser.evaluate(
            "[...document.querySelectorAll('.bar.policy u, .bar.applied u')]"
            ".map((bar) => getComputedStyle(bar).backgroundColor)"
        )
        wanted = [*shades(BY_NAME["policy"], 2), *shades(BY_NAME["applied"], 2)]
        assert bars == [f"rgb{colour}" for colour in wanted]
        drawn = await browser.evaluate(
            "[...new Set(new Uint32Array(document.getElementById('history').getContext('2d')"
            ".getImageData(0, 0, 2000, 200).data.buffer))].map((pixel) => pixel >>> 0)"
        )
        seen = [tuple(pixel >> shift & 255 for shift in (0, 8, 16)) for pixel in drawn]
        for colour in wanted:
            apart = [max(abs(a - b) for a, b in zip(one, colour, strict=True)) for one in seen]
            assert min(apart) < 10, colour


async def test_the_coach_is_shown_and_leaves_where_there_is_none(browser, cockpit):
    coach = Coaching(
        advice="Watch only.", said="42 s at the wheel", alone="94%", human_s=42.0,
        curve=[(5.0, 0.2), (30.0, 0.94)], typical=[(10.0, 0.5), (28.0, 0.9)],
        episodes=[SittingEpisode(6, "collision", 0.0, 0), SittingEpisode(7, "goal", 2.25, 1, 1.5)],
    )  # fmt: skip
    cockpit.show(replace(first_view(), coach=coach))
    await until(browser, "document.getElementById('advice').textContent === 'Watch only.'")
    assert await browser.text_content("#alone") == "94%"
    newest, older = (await browser.inner_text("#episodes")).splitlines()[1:]
    assert newest.split() == ["8", "goal", "2.3", "1"]
    assert older.split() == ["7", "collision", "0.0", "0"]
    assert await browser.evaluate(COLOURS_IN.format("curve")) > 5
    cockpit.show(first_view())
    await until(browser, "document.getElementById('coach').hidden")
    assert await browser.is_hidden("#advice")
    assert await browser.is_hidden("#listed")


async def test_the_screen_is_filled_and_left(browser):
    await browser.click("#full-screen")
    await until(browser, "document.fullscreenElement")
    await browser.click("#full-screen")
    await until(browser, "!document.fullscreenElement")


async def test_a_second_page_is_told_that_it_watches(browser, cockpit):
    await browser.goto("about:blank")
    async with page(cockpit):
        await browser.goto(cockpit.url)
        await until(browser, "document.body.classList.contains('watching')")
        await browser.keyboard.down("ArrowUp")
        await until(browser, f"{YOU} === '1.00'")
        assert not poll(cockpit).engaged
        await browser.keyboard.up("ArrowUp")
    await until(browser, "!document.body.classList.contains('watching')")


async def test_the_end_of_the_sitting_is_told(browser, cockpit):
    cockpit.close()
    await until(browser, OVER)
    assert await browser.text_content("#who") == "The sitting is over"


@pytest.mark.parametrize("how", ["closed", "silent", "silent, then closed"])
async def test_a_lost_connection_is_letting_go_and_comes_back(browser, cockpit, how):
    """Through a tunnel, as over ``ssh -L``, that is cut or swallows everything."""
    async with Tunnel(cockpit.port) as tunnel:
        await browser.goto(cockpit.url.replace(str(cockpit.port), str(tunnel.port)))
        await until(browser, READY)
        await browser.keyboard.down("ArrowUp")
        await reads(cockpit, lambda r: r.engaged)
        tunnel.cut() if how == "closed" else tunnel.swallow()
        await reads(cockpit, lambda r: r == LET_GO)
        if "then" in how:  # As the page is about to give it up: one connection comes back, not two.
            await asyncio.sleep(1.2)
            tunnel.cut()
        await until(browser, "document.body.dataset.link === 'lost'")
        await press_again(browser, cockpit)
        joined = len(tunnel._ways)
        await asyncio.sleep(1.5 * ("then" in how))
        assert len(tunnel._ways) == joined, "it does not connect again and again"
