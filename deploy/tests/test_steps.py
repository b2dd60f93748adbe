"""What becomes of a switch that is cut off by something else than the service's own fault."""

from __future__ import annotations

import fcntl
import io
import sys

import pytest

from deploy.installer.__main__ import Installer
from deploy.installer.layout import Layout
from deploy.installer.systemd import NoService
from deploy.installer.verify import UnhealthyError, UserError

OLD, NEW = "0.1.0-old", "0.1.0-new"


class Service(NoService):
    """Runs whatever `current` names; its watch of the new release ends with an error."""

    name = "fake"

    def __init__(self, layout: Layout, error: BaseException) -> None:
        self.layout = layout
        self.error = error
        self.runs = ""
        self.heard: list[str] = []
        """What ran at a moment when commands could leave."""

    def start(self, release) -> None:
        self.runs = release.name

    def watch(self, limits) -> None:
        if self.runs == NEW:
            raise self.error

    def stop(self) -> None:
        if self.runs and not self._is_held():
            self.heard.append(self.runs)
        self.runs = ""

    def _is_held(self) -> bool:
        with open(self.layout.hold) as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False


@pytest.fixture
def layout(tmp_path, monkeypatch):
    """A board on which the old release is current, and the new one lies beside it, proven."""
    layout = Layout(str(tmp_path))
    for version in (OLD, NEW):
        layout.release(version).mkdir(parents=True)
    layout.state.mkdir()
    layout.link("current", OLD)
    monkeypatch.setattr(Installer, "_prove", lambda self, version: None)
    return layout


@pytest.mark.parametrize(
    "error",
    [
        UnhealthyError("it ended"),
        UserError("systemctl cannot be run: No such file or directory"),
        OSError(28, "No space left on device", "/etc/systemd/system/phil-edge.service"),
        KeyboardInterrupt(),
    ],
    ids=lambda error: type(error).__name__,
)
@pytest.mark.parametrize("reader", ["there", "gone"])
def test_whatever_cuts_the_watch_off_the_old_release_runs_again(layout, monkeypatch, error, reader):
    """Also where nobody reads any more what the installer says: an ssh link that broke."""
    service = Service(layout, error)
    if reader == "gone":
        closed = io.StringIO()
        monkeypatch.setattr(closed, "write", _broken, raising=False)
        monkeypatch.setattr(sys, "stdout", closed)
    with pytest.raises(UnhealthyError, match=f"went back to {OLD}"):
        Installer(layout, service).activate(NEW, is_new=True)
    assert (layout.linked("current"), service.runs) == (OLD, OLD)
    assert layout.versions() == [OLD]
    assert service.heard == []


def _broken(text: str) -> int:
    raise BrokenPipeError(32, "Broken pipe")


def test_a_roll_back_that_is_interrupted_can_be_tried_again(layout):
    layout.link("previous", NEW)
    service = Service(layout, KeyboardInterrupt())
    with pytest.raises(UnhealthyError, match=f"went back to {OLD}"):
        Installer(layout, service).activate(NEW, is_new=False)
    assert (layout.linked("current"), layout.linked("previous"), service.runs) == (OLD, NEW, OLD)


def test_a_stop_that_is_interrupted_starts_the_old_release_again(layout):
    service = Service(layout, KeyboardInterrupt())
    stops = [KeyboardInterrupt]

    def stop() -> None:
        service.runs = ""
        if stops:
            raise stops.pop()

    service.stop = stop  # type: ignore[method-assign]
    with pytest.raises(UnhealthyError, match=f"went back to {OLD}: interrupted"):
        Installer(layout, service).activate(NEW, is_new=True)
    assert (layout.linked("current"), layout.linked("previous"), service.runs) == (OLD, None, OLD)
