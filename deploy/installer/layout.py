"""Lay releases out on the board, so that a power cut at any moment leaves a whole one current.

ROOT/trusted.pub             the key that this board trusts; never taken from a bundle
ROOT/releases/VERSION/       whole releases only: each is made under another name
ROOT/current  -> releases/V  the release that the service runs
ROOT/previous -> releases/V  the release that `rollback` goes back to
ROOT/.before  -> releases/V  during a switch: the release that was current before it
ROOT/state/hold              locked during a switch, and then the service sends no command
ROOT/.lock                   locked by the one installer at work

Each link changes by one rename. ROOT/releases and ROOT/state are the installer's alone: it removes
every release that no link names. All else in ROOT stays.

A release holds what the bundle holds (manifest.json, install.pyz, policy.*, config.toml, tls/,
units/), and besides

site-packages/               the wheels, unpacked and compiled
bin/phil-edge                starts the runtime with these packages and the installer's Python
contents.json                the SHA-256 of every file, by which a release is known to be whole
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
import shutil
import sys
import zipfile
from pathlib import Path
from typing import Iterator

from edge_runtime.util import UserError, read_json

DEFAULT_ROOT = "/opt/phil"
SITE, CONTENTS, LAUNCHER = "site-packages", "contents.json", "bin/phil-edge"
WHEELS, TLS = "wheels/", "tls/"
POLICY, PUBLIC_KEY, CONFIG = "policy.onnx", "policy.pub", "config.toml"
CURRENT, PREVIOUS, BEFORE, _NEXT = "current", "previous", ".before", ".next"
_NO_RELEASE = ".none"  # What `.before` names during a first install
_NOT_COMPILED = re.compile(f"/{SITE}/(.*/)?tests/")
"""numpy's own tests are a quarter of all files, and nobody imports them here."""
_LAUNCH = """\
#!{python} -ISB
import runpy
import site
import sys

# The packages of this release and the standard library; nothing else of this computer (-I -S).
site.addsitedir({packages!r})
sys.argv[0] = "phil-edge"
runpy.run_module("edge_runtime", run_name="__main__")
"""


class Releases:
    """The releases below one root, the links that name them, and the locks."""

    def __init__(self, root: str) -> None:
        self.root = Path(os.path.abspath(root))
        self.trusted = self.root / "trusted.pub"
        self._releases = self.root / "releases"
        self._state = self.root / "state"
        self.hold = self._state / "hold"

    def folder(self, version: str) -> Path:
        return self._releases / version

    def linked(self, name: str) -> str | None:
        """The version that a link names; None without the link or its release."""
        try:
            version = os.path.basename(os.readlink(self.root / name))
        except OSError:
            return None
        return version if self.folder(version).is_dir() else None

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Be the only installer here; before and after, remove what no link names.

        Raises UserError where another installer is at work.
        """
        for folder in (self._releases, self._state):
            folder.mkdir(parents=True, exist_ok=True)
        with open(os.open(self.root / ".lock", os.O_RDWR | os.O_CREAT, 0o600), "rb") as stream:
            try:
                # No child inherits this lock. A killed installer's child would keep one of flock.
                fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UserError(f"another installer is at work in {self.root}") from None
            try:
                self._tidy()
                yield
            finally:
                with contextlib.suppress(OSError):
                    self._tidy()

    def _tidy(self) -> None:
        if self.linked(BEFORE) == self.linked(CURRENT):  # The switch was not made, or was undone.
            self._remove_link(BEFORE)
        self._remove_link(_NEXT)
        named = {self.linked(name) for name in (CURRENT, PREVIOUS, BEFORE)}
        for path in self._releases.glob("*"):
            if path.name not in named:
                _remove(path)

    @contextlib.contextmanager
    def holding(self, gid: int) -> Iterator[None]:
        """Keep the service from sending any command (`hold` in its settings).

        The lock ends with this process, however that ends. Whoever may read the file could lock
        it, too: only the service's group `gid` may.
        """
        with open(os.open(self.hold, os.O_RDWR | os.O_CREAT, 0o600), "rb") as stream:
            os.fchown(stream.fileno(), -1, gid)
            os.fchmod(stream.fileno(), 0o640)
            fcntl.flock(stream, fcntl.LOCK_EX)
            yield

    def good(self) -> str | None:
        """The version to go back to: of a switch that was cut off, the one before it."""
        is_cut_off = os.path.lexists(self.root / BEFORE)
        return self.linked(BEFORE if is_cut_off else CURRENT)

    def prepare(self, version: str) -> None:
        """Make the links of a switch beforehand: it and the way back then need no room."""
        links = {BEFORE: self.good() or _NO_RELEASE, _NEXT: version}
        for name, target in links.items():
            if not os.path.lexists(self.root / name):  # `.before` is there after one was cut off
                os.symlink(f"releases/{target}", self.root / name)
        sync_folder(self.root)

    def switch(self) -> None:
        """Let `current` name the release that was prepared."""
        self._rename(_NEXT, CURRENT)

    def go_back(self) -> None:
        """Let `current` name the release before the switch, or none."""
        if self.linked(BEFORE) is None:
            self._remove_link(CURRENT)
            self._remove_link(BEFORE)
        else:
            self._rename(BEFORE, CURRENT)

    def accept(self) -> None:
        """End a switch that went well: the release before it is where `rollback` goes."""
        if self.linked(BEFORE) in (None, self.linked(CURRENT)):
            self._remove_link(BEFORE)
        else:
            self._rename(BEFORE, PREVIOUS)

    def _rename(self, link: str, to: str) -> None:
        os.replace(self.root / link, self.root / to)
        sync_folder(self.root)

    def _remove_link(self, name: str) -> None:
        (self.root / name).unlink(missing_ok=True)

    def damage(self, version: str) -> list[str]:
        """The files of a release that are missing, changed or too many."""
        try:
            wanted = read_json(self.folder(version) / CONTENTS, "list")
        except UserError:
            return [CONTENTS]
        found = hashes(self.folder(version))
        return sorted(p for p in wanted.keys() | found.keys() if wanted.get(p) != found.get(p))

    def unpack(self, version: str, files: dict[str, bytes]) -> None:
        """Make a release of a bundle's files: it gets its name when all of it is on the disk."""
        folder = self.folder(version)
        draft, damaged = (folder.with_name(f".{kind}") for kind in ("draft", "damaged"))
        _fill(files, draft, folder)
        _write(draft / CONTENTS, json.dumps(hashes(draft), indent=0).encode())
        os.sync()
        if folder.exists():
            folder.rename(damaged)
        draft.rename(folder)
        sync_folder(self._releases)

    def remove_all(self) -> None:
        """Remove the installation, the trusted key last."""
        for name in (CURRENT, PREVIOUS, BEFORE, _NEXT):
            self._remove_link(name)
        for path in (self._releases, self._state, self.trusted, self.root / ".lock"):
            _remove(path)
        with contextlib.suppress(OSError):
            self.root.rmdir()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a release but `contents.json`, by path."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path != folder / CONTENTS
    }


def _fill(files: dict[str, bytes], draft: Path, folder: Path) -> None:
    """Write all files of a release into `draft`, which will be called `folder`."""
    draft.mkdir(mode=0o755)
    for path, data in files.items():
        if path.startswith(WHEELS):
            unpack_wheel(data, draft / SITE)
        else:
            _write(draft / path, data, 0o600 if path.startswith(TLS) else 0o644)
    launcher = _LAUNCH.format(python=sys.executable, packages=str(folder / SITE))
    _write(draft / LAUNCHER, launcher.encode(), 0o755)
    # Now, because the service may not write here, and compiling at each start takes seconds.
    compileall.compile_dir(draft / SITE, quiet=2, rx=_NOT_COMPILED)


def unpack_wheel(data: bytes, site: Path) -> None:
    """Write a wheel's packages into `site`, without pip, which a board may lack (PEP 427).

    Scripts, headers and data files have no use on the board and stay out. No name leaves `site`:
    zipfile sees to that.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as wheel:
        for member in wheel.infolist():
            folder, _, rest = member.filename.partition("/")
            if folder.endswith(".data"):
                kind, _, member.filename = rest.partition("/")
                if kind not in ("purelib", "platlib") or not member.filename:
                    continue
            wheel.extract(member, site)


def _write(path: Path, data: bytes, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as stream:
        stream.write(data)
