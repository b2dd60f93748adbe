"""The installer among what others left in its folders, on a disk that fails: the real layout, a
service that notes what it is told, and no process.

Afterwards a whole release runs, the old one or the new one, and `current` names it; what is not
ours is still there; and what a person must clear away is said before the service is stopped.
"""

import contextlib
import errno
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deploy.installer import __main__ as installer
from deploy.installer.layout import LINKS, STATE, Layout, make_release, why_not_whole
from deploy.installer.systemd import Limits, NoService
from deploy.installer.verify import Bundle, Manifest, UnhealthyError, to_json
from deploy.tests.boards import HERE
from hil_tests.testing.policies import public_pem

EARLIER, OLD, NEW = "0.1.0-earlier", "0.1.0-old", "0.1.0-new"
KEY = public_pem(Ed25519PrivateKey.generate())
ODD = os.fsdecode(b"\xff\xfe no UTF-8")
FOREIGN = (
    *("diary", "state/notes", "releases/notes", "releases/lost+found", f"releases/{ODD}"),
    *(f"releases/{OLD}.bak", f"releases/{NEW}"),
)
STATE_FILES = tuple(f"state/{name}" for name in STATE)
OURS = (
    *LINKS,
    *(f".{name}" for name in LINKS),
    *(".lock", "trusted.pub", ".trusted.pub.new", "state", "releases", "releases/.making-x"),
    *STATE_FILES,
    *("state/.served.new", "state/.way.new"),
)


def _folder(path: Path, outside: Path) -> None:
    (path / "within").mkdir(parents=True)
    (path / "within/letter").write_text("not ours")


KINDS: dict[str, Callable[[Path, Path], Any]] = {
    "text": lambda path, outside: path.write_text("not ours"),
    "odd bytes": lambda path, outside: path.write_bytes(b"\xff\xfe\0"),
    "empty": lambda path, outside: path.touch(),
    "locked": lambda path, outside: path.touch(0),
    "huge": lambda path, outside: path.write_bytes(bytes(2 << 20)),
    "folder": _folder,
    "empty folder": lambda path, outside: path.mkdir(),
    "link into nowhere": lambda path, outside: path.symlink_to("nowhere"),
    "link to itself": lambda path, outside: path.symlink_to(path.name),
    "link outside": lambda path, outside: path.symlink_to(outside),
    "pipe": lambda path, outside: os.mkfifo(path),
    "copy of a release": lambda path, outside: shutil.copytree(
        outside.parent / f"spare/releases/{OLD}", path
    ),
}


class Service(NoService):
    """Notes what runs. Of a story that is not `healthy`, the new release never is."""

    name = "fake"

    def __init__(self, running: str | None, bad: str | None) -> None:
        self.running, self.bad, self.told = running, bad, 0

    def stop(self) -> None:
        self.told, self.running = self.told + 1, None

    def start(self, release: Path) -> None:
        self.told, self.running = self.told + 1, release.name

    def watch(self, limits: Limits) -> None:
        if self.running == self.bad:
            raise UnhealthyError("it ended")

    def remove(self) -> None:
        self.stop()


STEPS = {"os.rename": 1, "os.symlink": 1, "os.remove": 0, "os.rmdir": 0, "os.mkdir": 0, "open": 0}
"""What changes a disk, as audit events (PEP 578), and which argument is the path."""
_interfere: Callable[[str, str], None] | None = None


def _watch(event: str, arguments: Any) -> None:
    if _interfere is None or event not in STEPS:
        return
    if event != "open" or (isinstance(arguments[2], int) and arguments[2] & os.O_CREAT):
        _interfere(event, str(arguments[STEPS[event]]))


sys.addaudithook(_watch)


@contextlib.contextmanager
def at_step(number: int, root: Path, act: Callable[[bool], Any], once: bool):
    """Let `act(makes a file)` happen before the change in `root` of that number, or from it on."""
    global _interfere
    left = number

    def interfere(event: str, path: str) -> None:
        nonlocal left
        global _interfere
        left -= path.startswith(str(root))
        if left <= 0:
            _interfere = None
            try:
                act(event in ("os.symlink", "os.mkdir", "open"))
            finally:
                _interfere = None if once else interfere

    _interfere = interfere
    try:
        yield
    finally:
        _interfere = None


def bundle_of(version: str) -> Bundle:
    manifest = Manifest(version, HERE, "hunter01", "policy")
    return Bundle(manifest, {"manifest.json": to_json(manifest)})


def run(command: str, root: Path, service: Service) -> int:
    words = [command, "--root", str(root)]
    if command == "install":
        (root.parent / "key.pub").write_bytes(KEY)
        words += ["bundle", "--trust", str(root.parent / "key.pub")]
    kept = {one: signal.getsignal(one) for one in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)}
    umask = os.umask(0o022)
    try:
        with (
            mock.patch.object(installer, "choose", return_value=service),
            mock.patch.object(installer, "read_bundle", return_value=bundle_of(NEW)),
            mock.patch.object(installer, "check_fits"),
            mock.patch.object(installer.Installer, "_prove"),
            mock.patch.object(os, "fsync"),
            mock.patch.object(os, "sync"),
        ):
            return installer.main(words)
    finally:
        os.umask(umask)
        for one, handler in kept.items():
            signal.signal(one, handler)


def lay(path: Path, kind: str, outside: Path) -> bool:
    """Put debris there; in the place of a file or link, but of no folder. Whether it lies there."""
    try:
        path.unlink(missing_ok=True)
        KINDS[kind](path, outside)
    except OSError:  # a folder is there, or none to hold it
        return False
    return True


def seen(path: Path) -> Any:
    """What is there, to be compared: type, and content to the last file."""
    if path.is_symlink():
        return os.readlink(path)
    if path.is_dir():
        return {one.name: seen(one) for one in path.iterdir()}
    return path.read_bytes() if path.is_file() else path.is_fifo()


def is_kept(before: Any, after: Any) -> bool:
    """Whether all that was there is there; a folder may hold more."""
    if isinstance(before, dict) and isinstance(after, dict):
        return all(name in after and is_kept(one, after[name]) for name, one in before.items())
    return bool(before == after)


def is_foreign(place: str, kind: str) -> bool:
    """Whether it must survive: what bears no name of ours, and a folder wherever it stands."""
    if place == "releases/.making-x":  # Of our own prefix: it is what a run left that was cut off.
        return kind in ("text", "pipe")
    # These are ours while they are folders; only what is in them is not.
    return place in FOREIGN or kind == "folder" or (place in LINKS and "link" not in kind)


DEBRIS = st.tuples(st.sampled_from(FOREIGN + OURS), st.sampled_from(sorted(KINDS)))
TROUBLE = st.one_of(
    st.none(),
    st.tuples(st.integers(1, 40), st.sampled_from(("full", "fault", "interrupt"))),
    st.tuples(st.integers(1, 40), DEBRIS),
)


@settings(max_examples=300)
@given(
    st.sampled_from(("install", "install", "rollback", "uninstall")),
    st.lists(DEBRIS, max_size=3, unique_by=lambda one: one[0]),
    TROUBLE,
    st.booleans(),
    st.booleans(),
)
@example("install", [("releases/notes", "text")], None, True, True)
@example("rollback", [("releases/notes", "text")], None, True, True)
@example("uninstall", [("releases/notes", "text")], None, True, True)
@example("install", [("releases/lost+found", "folder")], None, True, True)
@example("install", [("current", "folder")], None, True, True)
@example("rollback", [("previous", "folder")], None, True, True)
@example("install", [("previous", "folder")], None, True, True)
@example("install", [("state/hold", "folder")], None, True, True)
@example("install", [("state/hold", "pipe")], None, True, True)
@example("rollback", [("state/served", "odd bytes")], None, False, True)
@example("install", [], (22, "full"), False, True)
def test_among_debris_a_whole_release_runs_and_nothing_foreign_is_gone(
    command, debris, trouble, is_healthy, is_installed
):
    with tempfile.TemporaryDirectory() as place:
        root, outside = Path(place) / "root", Path(place) / "outside"
        layout = Layout(str(root))
        _folder(outside, outside)
        with mock.patch.object(os, "fsync"), mock.patch.object(os, "sync"):
            for folder in (layout.releases, layout.state) if is_installed else ():
                folder.mkdir(parents=True)
            root.mkdir(exist_ok=True)
            for version in (EARLIER, OLD) if is_installed else ():
                make_release(bundle_of(version), layout, None)
            spare = Layout(str(Path(place) / "spare"))
            spare.releases.mkdir(parents=True)
            make_release(bundle_of(OLD), spare, None)
            if is_installed:
                layout.link("current", OLD)
                layout.link("previous", EARLIER)
                layout.trusted.write_bytes(KEY)
                layout.served.write_text(OLD)
        laid = [(place, kind) for place, kind in debris if lay(root / place, kind, outside)]
        target = {"install": NEW, "rollback": EARLIER}.get(command)
        good = layout.linked("current") or layout.linked("previous")
        service = Service(OLD if is_installed else None, None if is_healthy else target)

        def act(makes_a_file: bool) -> None:
            if trouble[1] == "interrupt":
                raise KeyboardInterrupt
            if trouble[1] == "fault" or (trouble[1] == "full" and makes_a_file):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(root))
            if trouble[1] != "full":
                place, kind = trouble[1]
                # In the middle nobody takes a link or a release of ours away.
                if place in STATE_FILES or not os.path.lexists(root / place):
                    lay(root / place, kind, outside)

        # A file with a name of ours, in a folder that is not ours, is ours.
        foreign = [
            f"{one}/within" if kind == "folder" else one
            for one, kind in laid
            if is_foreign(one, kind)
        ]
        before = {place: seen(root / place) for place in foreign}
        kept_outside = seen(outside)
        number, what = trouble or (10**9, None)
        with at_step(number, root, act, once=what != "full"):
            status = run(command, root, service)

        assert status in (0, 1, 2, 130)
        assert is_kept(before, {place: seen(root / place) for place in before})
        assert is_kept(kept_outside, seen(outside))
        if status == 2 and command != "uninstall":
            assert service.told == 0
        if service.told == 0:
            assert status != 0
        elif command == "uninstall":
            assert service.running is None
        else:
            assert service.running == good if status == 1 else target
            if service.running and ("current", "folder") not in laid:
                assert layout.linked("current") == service.running
                assert why_not_whole(layout.release(service.running)) == ""
        in_the_way = [place for place, _ in laid if place in OURS or place == f"releases/{NEW}"]
        if is_installed and not in_the_way and trouble is None:
            assert status == (0 if is_healthy or command == "uninstall" else 1)
