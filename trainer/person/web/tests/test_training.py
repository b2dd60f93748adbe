"""A real Chromium beside a real ``trainer train --human web``, as a person has them."""

import asyncio

import pytest

from trainer.benches.chromium import find_chromium, open_browser
from trainer.benches.cockpit import PERSON_DRIVES, POLICY_DRIVES, quit_page
from trainer.benches.cockpit_run import cockpit_run
from trainer.drivers import CHECKPOINT_FILE
from trainer.files import load_torch
from trainer.person.recording import find_recordings, read_steps
from trainer.person.takeover import MAX_SLEW

APPLIED = "document.querySelector('.bar.applied output').textContent"
QUICK = ("--threads", "1", "--set", "evaluate_every_steps=0", "--set", "warmup_steps=8")


pytestmark = pytest.mark.skipif(
    find_chromium() is None, reason="no Chromium (Debian: apt-get install chromium)"
)


def test_a_key_held_in_the_page_takes_over_in_the_training_process(tmp_path):
    run_dir = tmp_path / "run"

    async def sit():
        async with open_browser() as browser, cockpit_run(run_dir, QUICK) as run:
            await browser.open(run.url)
            await browser.until(POLICY_DRIVES)
            await browser.key("ArrowDown", True)
            await browser.until(f"{PERSON_DRIVES} && {APPLIED} === '-1.00'")
            await browser.key("ArrowDown", False)
            await browser.until(POLICY_DRIVES)
            await quit_page(browser)
            await browser.until("document.body.dataset.link === 'over'")
            return await run.ended()

    assert asyncio.run(sit()) == 0
    [recording] = find_recordings([run_dir])
    steps = list(read_steps(recording))
    ours = [step for step in steps if step.human]
    assert sum(step.first for step in steps) == 1
    assert ours[0].first
    # Towards the brake within the first period, by no more than a hand-over may.
    first = ours[0]
    before = steps[steps.index(first) - 1].action if first.step else first.policy_action
    assert before is not None
    towards = min(max(first.human_action - before, -MAX_SLEW), MAX_SLEW)
    assert first.human_action < 0.0
    assert first.action == pytest.approx(before + towards)
    assert -1.0 in [step.action for step in ours]
    assert steps[-1].outcome == "stopped"
    replay = load_torch(run_dir / CHECKPOINT_FILE)["learning"]["replay"]
    assert int(replay["human"].sum()) == len(ours)
