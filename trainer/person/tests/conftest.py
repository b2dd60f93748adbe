"""A cockpit, and one Chromium for all tests of the page."""

import asyncio
import inspect
import os
from contextlib import closing

import pytest

from hil_tests.tests.shared.commands import call
from trainer.environments import make_environment
from trainer.person import web
from trainer.person.tests.browser import READY, find_chromium, first_view, open_browser, until
from trainer.person.web import Cockpit
from trainer.tests.conftest import one_thread

__all__ = ["browser", "cockpit", "one_thread", "opened", "runner", "sit_down"]

FAKE_PADS = """
globalThis.pads = {};
navigator.getGamepads = () => [0, 1, 2, 3].map((index) => globalThis.pads[index] ?? null);
globalThis.plug = (id, mapping, axes, buttons) => {
  globalThis.pads[0] = { id, mapping, axes, index: 0, connected: true,
    buttons: buttons.map((value) => ({ value, pressed: value > 0.5 })) };
};
"""
"""Headless Chromium has no gamepad: the page is given one that says what the test wants."""


# No test opens a browser by itself, nor does a process that it starts.
for name in ("DISPLAY", "WAYLAND_DISPLAY"):
    os.environ.pop(name, None)
os.environ["BROWSER"] = "true"  # On macOS: the command that does nothing


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Run a test that is a coroutine, in the browser's event loop where it has one."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = inspect.signature(pyfuncitem.obj).parameters
    test = pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names})
    pyfuncitem.funcargs.get("runner", asyncio).run(test)
    return True


@pytest.fixture(scope="module")
def runner():
    if find_chromium() is None:
        pytest.skip("no Chromium (Debian: apt-get install chromium)")
    pytest.importorskip("playwright")
    with asyncio.Runner() as runner:
        yield runner


@pytest.fixture(scope="module")
def browser(runner):
    context = open_browser([FAKE_PADS])
    yield runner.run(context.__aenter__())
    runner.run(context.__aexit__(None, None, None))


@pytest.fixture
def sit_down(monkeypatch, tmp_path, capsys, one_thread):
    """Run a command with somebody else at the wheel; its status, stdout and stderr."""

    def sit_down(person, *command):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(web, "open_cockpit", lambda *_: person)
        return call(capsys, *command, "--speed", "1000")

    return sit_down


@pytest.fixture
def cockpit():
    with closing(Cockpit(make_environment("left_turn"))) as cockpit:
        yield cockpit


@pytest.fixture
def opened(runner, browser, cockpit):
    """The browser has the cockpit open, with the left turn in view."""
    cockpit.show(first_view())
    runner.run(browser.goto(cockpit.url))
    runner.run(browser.evaluate("localStorage.clear()"))
    runner.run(until(browser, READY))
