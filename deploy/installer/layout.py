"""Where things lie on the board, and how they change without ever being half changed.

ROOT/trusted.pub            the key that this board trusts; never taken from a bundle
ROOT/releases/VERSION/      whole releases only: made beside, named when all of it is on the disk
ROOT/current -> releases/V  what the service runs; changed by one rename
ROOT/previous -> releases/V where `rollback` goes
ROOT/state/                 the files of STATE
ROOT/.lock                  one installer at a time
ROOT/releases/.making-*     what a run that was cut off left; the next run removes it

A release is a folder with our manifest. Whatever else lies there is not ours, and stays. A release
holds what the bundle holds (manifest.json, install.pyz, policy.*, config.toml, tls/, units/), and
besides

site-packages/              the wheels, unpacked and compiled
launch.py, bin/phil-edge    start the runtime with this Python and these packages alone
contents.json               the SHA-256 of every file, by which a release is known to be whole
"""

from __future__ import annotations

import compileall
import contextlib
import fcntl
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import sys
import time
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Iterator

from deploy.installer.verify import MANIFEST, VERSION, Bundle, parse_manifest
from edge_runtime.util import UserError, printable, read_bytes, read_json

NO_ZIP = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError)  # What a damaged archive raises

DEFAULT_ROOT = "/opt/phil"
SITE, CONTENTS, LAUNCHER = "site-packages", "contents.json", "bin/phil-edge"
WHEELS, TLS = "wheels/", "tls/"
POLICY, PUBLIC_KEY, CONFIG = "policy.onnx", "policy.pub", "config.toml"
LINKS = ("current", "previous")
STATE = HOLD, SERVED, WAY, UNITS = ("hold", "served", "way", "phil-units")
_MAKING = ".making-"
_HOLD_LIMIT_S = 2.0  # A runtime that asks whether it may send has the lock for microseconds
_NOT_COMPILED = re.compile(f"/{SITE}/(.*/)?tests/")
"""numpy's own tests are a quarter of all files, and nobody imports them here."""
_LAUNCH = """\
import os
import runpy
import site
import sys

# The packages of this release and the standard library; nothing else of this computer (-I -S).
site.addsitedir(os.path.join(os.path.dirname(os.path.abspath(__file__)), "site-packages"))
sys.argv[0] = "phil-edge"
runpy.run_module("edge_runtime", run_name="__main__")
"""


class Layout:
    """The folders under one root."""

    def __init__(self, root: str) -> None:
        self.root = Path(os.path.abspath(root))
        self.releases = self.root / "releases"
        self.trusted = self.root / "trusted.pub"
        self.state = self.root / "state"
        self.hold = self.state / HOLD
        self.served = self.state / SERVED  # The release that was last found healthy
        state = [self.state / name for name in STATE]
        self._files = [*state, *map(_draft_of, state)]

    def release(self, version: str) -> Path:
        """The folder of a release."""
        return self.releases / version

    def making(self, version: str) -> Path:
        """Where a release is made."""
        return self.releases / (_MAKING + version)

    def linked(self, name: str) -> str | None:
        """The version that `current` or `previous` names; None without one."""
        try:
            folder, version = os.path.split(os.readlink(str(self.root / name)))
        except OSError:
            return None
        ours = folder == "releases" and VERSION.fullmatch(version)
        return version if ours and self.release(version).is_dir() else None

    def versions(self) -> list[str]:
        """All releases, by name: folders with our manifest of it, and those that a link names."""
        found = set(filter(None, map(self.linked, LINKS)))
        for folder in self.releases.glob("*"):
            with contextlib.suppress(UserError):
                manifest = parse_manifest(read_bytes(folder / MANIFEST, "manifest", 1))
                if manifest.version == folder.name and not folder.is_symlink():
                    found.add(folder.name)
        return sorted(found)

    def link(self, name: str, version: str | None) -> None:
        """Let `current` or `previous` name a release, or nothing, in one step."""
        draft = self.root / f".{name}"
        draft.unlink(missing_ok=True)
        if version is None:
            (self.root / name).unlink(missing_ok=True)
        elif self.linked(name) != version:
            os.symlink(os.path.join("releases", version), str(draft))
            os.replace(str(draft), str(self.root / name))
        sync_folder(self.root)

    def take_away(self, version: str) -> Path:
        """Take its name from a release, so that no half of it ever bears it; where it is then."""
        old = self.making(f"{version}.old")
        remove_tree(old)
        with contextlib.suppress(FileNotFoundError):
            self.release(version).rename(old)
            sync_folder(self.releases)
        return old

    def remove_unused(self, *versions: str) -> None:
        """Remove releases that no link names, as far as the disk lets us."""
        for version in set(versions) - set(map(self.linked, LINKS)):
            with contextlib.suppress(OSError):
                remove_tree(self.take_away(version))

    def tidy(self) -> None:
        """Remove what a run that was cut off has left."""
        for path in (self.root / ".current", self.root / ".previous", _draft_of(self.trusted)):
            with contextlib.suppress(OSError):
                path.unlink()
        for path in self.releases.glob(f"{_MAKING}*"):
            remove_tree(path)

    def make_ready(self) -> None:
        """Tidy. Raise UserError where what is not ours bears a name that a switch gives."""
        self.tidy()
        links = [self.root / f"{dot}{name}" for name in LINKS for dot in ("", ".")]
        for path in filter(os.path.lexists, map(str, (*links, *self._files))):
            is_link = os.path.islink(path)
            if not (is_link if Path(path) in links else os.path.isfile(path) and not is_link):
                raise UserError(f"{path} is in the way: move it away")

    def remove_all(self) -> None:
        """Remove what is ours, the trusted key last. What else lies there stays."""
        versions = self.versions()
        for name in LINKS:
            if (self.root / name).is_symlink():
                self.link(name, None)
        self.tidy()
        self.remove_unused(*versions)
        for path in (*self._files, self.trusted, self.root / ".lock"):
            with contextlib.suppress(OSError):
                path.unlink()
        for folder in (self.state, self.releases, self.root):
            with contextlib.suppress(OSError):
                folder.rmdir()

    @contextlib.contextmanager
    def holding(self, gid: int | None = None) -> Iterator[None]:
        """Keep the service from sending any command (`hold` in its settings).

        A lock, not a file's existence: it ends with this process, whatever ends that. Whoever may
        read the file could lock it, too: only the service's group `gid` may. UserError where
        somebody does.
        """
        end_s = time.monotonic() + _HOLD_LIMIT_S
        with self._open_lock(self.hold, gid) as stream:
            while True:
                try:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if time.monotonic() > end_s:
                        raise UserError(f"another process holds {self.hold} locked") from None
                    time.sleep(0.02)
            yield

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Make the root and be the only installer in it. The lock goes with the process.

        It is `lockf`'s, which no child inherits: `flock`'s lives as long as any process that was
        forked with it, so what a killed installer has started would keep it.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot write to {self.root}: {error.strerror}") from None
        with self._open_lock(self.root / ".lock") as stream:
            try:
                fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UserError(f"another installer is at work in {self.root}") from None
            for folder in (self.releases, self.state):
                folder.mkdir(exist_ok=True)
            yield

    @staticmethod
    def _open_lock(path: Path, gid: int | None = None) -> BinaryIO:
        """Open a file to lock that nobody else can read, but for the group `gid`. UserError."""
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK  # Of a pipe: do not wait
        try:
            stream = open(os.open(str(path), flags, 0o600), "rb")  # noqa: SIM115 - the caller's
            os.fchmod(stream.fileno(), 0o600 if gid is None else 0o640)
            if gid is not None:
                os.fchown(stream.fileno(), -1, gid)
        except OSError as error:
            raise UserError(f"{path} cannot be locked: {error.strerror}") from None
        return stream


def _draft_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.new")


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that a power cut leaves the old one or the new one."""
    draft = _draft_of(path)
    draft.unlink(missing_ok=True)
    with open(os.open(str(draft), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(str(draft), str(path))
    sync_folder(path.parent)


def read_state(path: Path) -> str:
    """The text of a small file; empty where there is none."""
    try:
        return read_bytes(path, "state file", 1).decode("utf-8", "replace")
    except UserError:
        return ""


def sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk."""
    descriptor = os.open(str(folder), os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_tree(path: Path) -> None:
    """Remove a folder and all in it, as far as it is there and the disk lets us."""
    if path.is_dir():  # rmtree would wait for a pipe
        shutil.rmtree(str(path), ignore_errors=True)


def make_release(bundle: Bundle, layout: Layout, group: int | None) -> Path:
    """Unpack a bundle; the folder appears under its name when all of it is on the disk.

    `group` is the id of the group that may read the TLS key, None for the owner alone.
    """
    version = bundle.manifest.version
    folder, draft = layout.release(version), layout.making(version)
    remove_tree(draft)
    check_room(bundle, layout)
    try:
        _fill(bundle, draft, folder, group)
        _write(draft / CONTENTS, json.dumps(hashes(draft), indent=0).encode())
        os.sync()
        old = layout.take_away(version)  # a damaged one, if any
        draft.rename(folder)
        sync_folder(layout.releases)
        remove_tree(old)
    except (OSError, UserError) as error:
        remove_tree(draft)
        if isinstance(error, OSError):
            raise UserError(f"cannot write {folder}: {error.strerror}") from None
        raise
    return folder


def why_not_whole(folder: Path) -> str:
    """What is missing or changed in a release; empty where every file is as it was made."""
    try:
        wanted = read_json(folder / CONTENTS, "list")
    except UserError:
        return f"{CONTENTS} cannot be read"
    found = hashes(folder)
    wrong = sorted(p for p in wanted.keys() | found.keys() if wanted.get(p) != found.get(p))
    return (
        printable(f"{len(wrong)} files are missing or changed, {wrong[0]} first") if wrong else ""
    )


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a release but `contents.json`, by path; empty of no file."""
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if not p.is_dir()}
    found.pop(CONTENTS, None)
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        for name, path in found.items()
    }


def unpack_wheel(data: bytes, name: str, site: Path) -> None:
    """Write a wheel's packages into `site`, without pip, which a board may lack (PEP 427).

    Scripts, headers and data files have no use on the board and stay out. Raises UserError for
    names that leave `site`, and for a file that another wheel holds too.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as wheel:
            for member in wheel.infolist():
                place = None if member.is_dir() else _place(member.filename, name)
                if place is not None:
                    (site / place).parent.mkdir(parents=True, exist_ok=True)
                    with open(str(site / place), "xb") as stream:
                        stream.write(wheel.read(member))
    except NO_ZIP as error:
        raise UserError(f"{name} is not a wheel: {error}") from None
    except (FileExistsError, NotADirectoryError) as error:
        raise UserError(f"{name} holds a file that another wheel holds: {error.filename}") from None


def _place(path: str, wheel: str) -> PurePosixPath | None:
    """Where a member goes below site-packages; None where it does not go there."""
    parts = PurePosixPath(path).parts
    if not parts or path.startswith("/") or "\\" in path or ".." in parts:
        raise UserError(f"{wheel} would write outside of its folder: {path}")
    if not parts[0].endswith(".data"):
        return PurePosixPath(*parts)
    if len(parts) > 2 and parts[1] in ("purelib", "platlib"):
        return PurePosixPath(*parts[2:])
    return None


def _fill(bundle: Bundle, draft: Path, folder: Path, group: int | None) -> None:
    draft.mkdir(mode=0o755)
    for path, data in bundle.files.items():
        if path.startswith(WHEELS):
            unpack_wheel(data, path, draft / SITE)
        elif path.startswith(TLS):
            _write(draft / path, data, 0o600)
        else:
            _write(draft / path, data)
    let_read_key(draft, group)
    _write(draft / "launch.py", _LAUNCH.encode())
    start = [sys.executable, "-I", "-S", "-B", str(folder / "launch.py")]
    text = f'#!/bin/sh\nexec {" ".join(map(shlex.quote, start))} "$@"\n'
    _write(draft / LAUNCHER, text.encode(), 0o755)
    # Now, because the service may not write here, and compiling at each start takes seconds.
    compileall.compile_dir(str(draft / SITE), quiet=2, rx=_NOT_COMPILED)


def let_read_key(folder: Path, group: int | None) -> None:
    """Let a group, if there is one, read the TLS key of a release."""
    if group is not None:
        for path in (folder / TLS).glob("*"):
            os.chown(str(path), -1, group)
            os.chmod(str(path), 0o640)


def _write(path: Path, data: bytes, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    descriptor = os.open(str(path), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "wb") as stream:
        stream.write(data)
    os.chmod(str(path), mode)


def check_room(bundle: Bundle, layout: Layout) -> None:
    """Unpacked and compiled, wheels take some four times their size. UserError."""
    needed = 5 * sum(map(len, bundle.files.values()))
    free = shutil.disk_usage(str(layout.releases)).free
    if free < needed:
        raise UserError(
            f"not enough room in {layout.root}: {needed // 10**6} MB are needed,"
            f" {free // 10**6} MB are free"
        )
