"""How soon a key in the browser reaches the car: a real Chromium, a real training, its recording.

A press begins just before Chromium is told of it, which counts against us, and ends at the wall
time of the recorded step that is the first of an intervention: when its control period asked the
hands, right before the car moves. Beside it stands the same from the page's own key event on. What
is pressed while nobody drives (between two episodes) is not counted, and told.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import random
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_runtime.cli import ArgumentParser, UserError, run_cli, write_json_out
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.option_types import not_negative, positive
from trainer.benches.chromium import Browser, find_chromium, open_browser
from trainer.benches.cockpit_run import CockpitRun, cockpit_run
from trainer.person.recording import Step, find_recordings, read_steps
from trainer.util import about

OPENING_BAR_S, KEY_BAR_MS = 2.0, 150.0
KEYS = {"left_turn": ("ArrowUp", "ArrowDown"), "congestion": ("ArrowLeft", "ArrowRight")}
HELD_S, BETWEEN_S = (0.25, 0.45), (0.3, 0.6)
POLICY_DRIVES = (
    "document.body.dataset.control === 'policy' && document.body.dataset.link === 'live'"
    " && !document.getElementById('message').textContent"
)
PERSON_DRIVES = "document.body.dataset.control === 'human'"
NOTE_KEYS = """
globalThis.keyMs = [];
addEventListener("keydown", (event) => keyMs.push(performance.timeOrigin + event.timeStamp), true);
"""
QUIET = ("--set", "evaluate_every_steps=0")
"""Nothing is to be waited for at the end."""


def key_to_applied_ms(presses_ns: Sequence[float], steps: Sequence[Step]) -> list[float | None]:
    """From each press to the first step of its intervention, ms.

    None: an episode ended in between, or none was being driven, so that nothing could be applied.

    Args:
        presses_ns: wall times.
        steps: as recorded.
    """
    return [_answer_ms(press_ns, steps) for press_ns in presses_ns]


def _answer_ms(press_ns: float, steps: Sequence[Step]) -> float | None:
    count = sum(step.time_ns <= press_ns for step in steps)
    if count == 0 or steps[count - 1].outcome:
        return None
    for step in itertools.islice(steps, count, None):
        if step.first:
            return 1e-6 * (step.time_ns - press_ns)
        if step.outcome:
            return None
    return None


def quantiles(values: Sequence[float]) -> dict[str, float]:
    """Median and tail."""
    p50, p90, p99 = np.percentile(values, (50, 90, 99))
    return {"p50": float(p50), "p90": float(p90), "p99": float(p99), "max": float(max(values))}


async def measure(loads: int, presses: int, scenario: str, seed: int) -> dict[str, Any]:
    """Open the page again and again, then press keys at moments of the seed's choice."""
    generator = random.Random(seed)
    with tempfile.TemporaryDirectory() as directory:
        run_dir = Path(directory) / "run"
        options = ("--scenario", scenario, "--seed", str(seed), *QUIET)
        async with open_browser() as browser, cockpit_run(run_dir, options) as run:
            keys = KEYS[scenario]
            # The first opening may have to wait for the trainer, which has only just been started.
            started = await _open_and_take_over(browser, run, keys[0])
            opened = [await _open_and_take_over(browser, run, keys[0]) for _ in range(loads)]
            await browser.value(NOTE_KEYS)
            pressed, trips_ms = [], []
            for _ in range(presses):
                pressed.append(await _press(browser, generator, keys))
                trips_ms.append(await browser.value("parseFloat(trip.textContent)"))
            events_ns = [1e6 * at_ms for at_ms in await browser.value("keyMs")]
            await quit_page(browser)
            status = await run.ended()
        steps = [step for path in find_recordings([run_dir]) for step in read_steps(path)]
    if status != 0:
        raise UserError(f"the training ended with status {status}")
    report = _report(opened, pressed, events_ns, trips_ms, steps)
    return {**about(), "first_opening_s": started, **report}


async def quit_page(browser: Browser) -> None:
    """Quit, and be sure."""
    await browser.tap("KeyQ")
    await browser.tap("KeyQ")


async def _open_and_take_over(browser: Browser, run: CockpitRun, key: str) -> dict[str, float]:
    """Open the page, and hold a key from its load event on until the person drives.

    Ends when the policy drives again: the next page must not find the person driving still.
    """
    began_s = time.monotonic()
    await browser.open(run.url)
    loaded_s = time.monotonic()
    await browser.key(key, True)
    await browser.until(PERSON_DRIVES)
    taken_s = time.monotonic()
    await browser.key(key, False)
    await browser.until(POLICY_DRIVES)
    return {"load_s": loaded_s - began_s, "taken_over_s": taken_s - began_s}


async def _press(browser: Browser, generator: random.Random, keys: Sequence[str]) -> int:
    await browser.until(POLICY_DRIVES)
    await asyncio.sleep(generator.uniform(*BETWEEN_S))
    key = generator.choice(keys)
    down_ns = time.time_ns()
    await browser.key(key, True)
    await asyncio.sleep(generator.uniform(*HELD_S))
    await browser.key(key, False)
    return down_ns


def _report(
    opened: Sequence[dict[str, float]],
    pressed_ns: Sequence[int],
    events_ns: Sequence[float],
    trips_ms: Sequence[float | None],
    steps: Sequence[Step],
) -> dict[str, Any]:
    counted = [ms for ms in key_to_applied_ms(pressed_ns, steps) if ms is not None]
    from_event = [ms for ms in key_to_applied_ms(events_ns, steps) if ms is not None]
    key_ms = quantiles(counted)
    opening_s = [times["taken_over_s"] for times in opened]
    return {
        "opening": {
            "times": len(opened),
            "load_s": quantiles([times["load_s"] for times in opened]),
            "opened_to_taken_over_s": quantiles(opening_s),
            "bar_s": OPENING_BAR_S,
            "met": max(opening_s) < OPENING_BAR_S,
        },
        "key_to_applied_ms": {
            "presses": len(counted),
            "not_counted": len(pressed_ns) - len(counted),
            **key_ms,
            "bar_p99": KEY_BAR_MS,
            "met": key_ms["p99"] < KEY_BAR_MS,
        },
        "key_event_to_applied_ms": quantiles(from_event),
        "round_trip_ms": quantiles([ms for ms in trips_ms if ms is not None]),
        "period_ms": quantiles(_periods_ms(steps)),
        "recorded": {
            "steps": len(steps),
            "human_steps": sum(step.human for step in steps),
            "interventions": sum(step.first for step in steps),
        },
    }


def _periods_ms(steps: Sequence[Step]) -> list[float]:
    """Between two steps of the same episode."""
    return [
        1e-6 * (after.time_ns - before.time_ns)
        for before, after in itertools.pairwise(steps)
        if after.episode == before.episode
    ]


async def picture(path: str, scenario: str, seed: int) -> None:
    """Take a picture of the cockpit in the middle of a take-over, here from the expert."""
    options = ("--policy", "expert", "--scenario", scenario, "--seed", str(seed))
    with tempfile.TemporaryDirectory() as directory:
        async with (
            open_browser() as browser,
            cockpit_run(Path(directory), options, "drive") as run,
        ):
            await browser.open(run.url)
            await browser.until(POLICY_DRIVES)
            await asyncio.sleep(1.5)
            await browser.key(KEYS[scenario][1], True)
            await browser.until(PERSON_DRIVES)
            await asyncio.sleep(0.5)
            data = await browser.picture()
            await browser.key(KEYS[scenario][1], False)
            await quit_page(browser)
            await run.ended()
    write_atomic(path, data)


def main(argv: list[str]) -> int:
    """Measure and print, or take a picture; the exit status."""
    parser = ArgumentParser(
        prog="python -m trainer.benches.cockpit",
        description="Measures the browser cockpit in a headless Chromium beside a real training.",
        epilog="example: python -m trainer.benches.cockpit --presses 300 --out cockpit.json",
    )
    parser.add_argument("--presses", type=positive, default=300, metavar="N", help="keys pressed")
    parser.add_argument("--loads", type=positive, default=10, metavar="N", help="pages opened")
    parser.add_argument("--scenario", choices=["left_turn", "congestion"], default="left_turn")
    parser.add_argument("--seed", type=not_negative, default=1, help="of run and presses")
    parser.add_argument("--out", metavar="F.json", help="also write the figures to this file")
    parser.add_argument("--picture", metavar="F.png", help="take this picture instead of measuring")
    arguments = parser.parse_args(argv)
    if find_chromium() is None:
        raise UserError("no Chromium is installed (Debian: apt-get install chromium)")
    for path in filter(None, (arguments.out, arguments.picture)):
        check_writable(path)
    if arguments.picture:
        asyncio.run(picture(arguments.picture, arguments.scenario, arguments.seed))
        print(arguments.picture)
        return 0
    report = asyncio.run(
        measure(arguments.loads, arguments.presses, arguments.scenario, arguments.seed)
    )
    print(json.dumps(report, indent=2))
    write_json_out(arguments.out, report)
    return 0


if __name__ == "__main__":
    sys.exit(run_cli(main))
