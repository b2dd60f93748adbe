"""Read a signed bundle, and unpack it as a release that no power cut can leave half-made.

BUNDLE.tar.sig is the signature of `ssh-keygen -Y sign` over the whole BUNDLE.tar, so a changed byte
is found before anything inside is read.

ROOT/trusted.pub             the key that this board trusts, in OpenSSH's form; never from a bundle
ROOT/releases/VERSION/       whole releases only; a running installer locks the folder
ROOT/current  -> releases/V  the release that the service runs
ROOT/previous -> releases/V  the release that `rollback` goes back to
ROOT/.before  -> releases/V  during a switch: the release that was current before it

Each link changes by one rename. A release that no link names is removed; a folder without
contents.json is no release. Everything else in ROOT stays.

A release holds the bundle's files, and

site-packages/               its wheels, unpacked and compiled
bin/phil-edge                starts the runtime with these packages and the installer's Python
contents.json                the SHA-256 of every file, to check that the release is whole
"""

from __future__ import annotations

import base64
import compileall
import contextlib
import hashlib
import io
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path
from typing import Iterator, NamedTuple

from edge_runtime.files import try_to_lock_file
from edge_runtime.util import PathLike, UserError, read_bytes

DEFAULT_ROOT = "/opt/phil"
NAMESPACE = "phil-bundle"
"""So that a signature of something else by the same key is not valid for a bundle."""
MANIFEST, CONFIG, WHEELS, TLS = "manifest.json", "config.toml", "wheels/", "tls/"
POLICY, PUBLIC_KEY = "policy.onnx", "policy.pub"
SITE, LAUNCHER, CONTENTS = "site-packages", "bin/phil-edge", "contents.json"
CURRENT, PREVIOUS, BEFORE = "current", "previous", ".before"
LINKS = CURRENT, PREVIOUS, BEFORE, ".next"
DRAFT, DAMAGED = ".draft", ".damaged"
_MAX_BUNDLE_MIB = 1024
_ED25519 = bytes.fromhex("302a300506032b6570032100")
"""Precedes the 32 bytes of a key in a SubjectPublicKeyInfo of Ed25519 (RFC 8410)."""
_SSH_ED25519 = b"\0\0\0\x0bssh-ed25519\0\0\0\x20"
"""Precedes the same 32 bytes in a public key of OpenSSH (RFC 8709)."""
_PATH = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]*(/[A-Za-z0-9_][A-Za-z0-9._+-]*)?")
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


class Manifest(NamedTuple):
    """A bundle's description; it runs with this Python ("3.8"), and this glibc or a newer one."""

    version: str  # Unique to these bytes
    vehicle_id: str
    policy_id: str
    python: str
    machine: str
    glibc: str


def read_bundle(path: PathLike, trusted: str) -> tuple[Manifest, dict[str, bytes]]:
    """Read a bundle once; UserError unless the key `trusted` has signed it."""
    data = read_bytes(path, "bundle", _MAX_BUNDLE_MIB)
    with tempfile.NamedTemporaryFile("w") as signers:
        signers.write(f"owner {trusted}\n")
        signers.flush()
        command = ["ssh-keygen", "-Y", "verify", "-f", signers.name, "-I", "owner",
                   "-n", NAMESPACE, "-s", f"{path}.sig"]  # fmt: skip
        done = subprocess.run(command, input=data, capture_output=True, check=False)
    if done.returncode != 0:
        why = done.stderr.decode(errors="replace")
        raise UserError(f"bundle {path} was changed, or its signer is not trusted here ({why})")
    files = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as tar:
            for member in tar:
                stream = tar.extractfile(member) if member.isreg() else None
                if stream is None or not _PATH.fullmatch(member.name):
                    raise ValueError(f"{member.name!r} in it")
                files[member.name] = stream.read()
        return Manifest(**json.loads(files[MANIFEST])), files
    except (tarfile.TarError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"bundle {path} is of another format: {error}") from None


def read_public_key(path: PathLike) -> str:
    """Read an Ed25519 key in PEM; return it in OpenSSH's form. UserError for anything else."""
    pem = read_bytes(path, "public key")
    try:
        der = base64.b64decode(re.sub(rb"-----(BEGIN|END) PUBLIC KEY-----", b"", pem))
    except ValueError:
        der = b""
    if len(der) != len(_ED25519) + 32 or not der.startswith(_ED25519):
        raise UserError(f"public key {path} is not Ed25519 in PEM; `deploy keys` makes one")
    return f"ssh-ed25519 {base64.b64encode(_SSH_ED25519 + der[-32:]).decode()}"


def check_fits(manifest: Manifest) -> None:
    """Raise UserError unless Python, processor and C library are what the wheels need."""
    python, (_, glibc) = f"{sys.version_info[0]}.{sys.version_info[1]}", platform.libc_ver()
    here, wanted = (python, platform.machine(), glibc or "0"), manifest[3:]
    newest, oldest = (tuple(map(int, each[2].split("."))) for each in (here, wanted))
    if here[:2] != wanted[:2] or newest < oldest:
        raise UserError(f"the bundle is for Python, processor and glibc {wanted}, this is {here}")


class Releases:
    """The releases below one root, the links that name them, and the locks."""

    def __init__(self, root: str) -> None:
        self.root = Path(os.path.abspath(root))
        self.trusted = self.root / "trusted.pub"
        self._releases = self.root / "releases"

    def folder(self, version: str) -> Path:
        return self._releases / version

    def linked(self, name: str) -> str | None:
        """The version that a link names; None without the link or its release."""
        link = self.root / name
        return link.resolve().name if link.is_symlink() and link.exists() else None

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Lock out other installers; before and after, remove releases that no link names."""
        for link in (self.root / name for name in LINKS):
            if link.exists() and not link.is_symlink():
                raise UserError(f"{link} is no link of an installation; move it away")
        self._releases.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as undo:
            lock = os.open(self._releases, os.O_RDONLY)  # No program that is started inherits it.
            undo.callback(os.close, lock)
            if not try_to_lock_file(lock):
                raise UserError(f"another installer is at work in {self.root}")
            undo.callback(self._tidy)
            self._tidy()
            yield

    def _tidy(self) -> None:
        if self.linked(BEFORE) == self.linked(CURRENT):  # The switch was not made, or was undone.
            self._unlink(BEFORE)
        named = {self.linked(name) for name in LINKS}
        for path in self._releases.glob("*"):
            is_release = path.name in (DRAFT, DAMAGED) or (path / CONTENTS).exists()
            if is_release and path.name not in named:
                shutil.rmtree(path, ignore_errors=True)

    def prepare(self) -> None:
        """Note the current release: going back is then one rename, which needs no disk space."""
        if not os.path.lexists(self.root / BEFORE):  # An interrupted switch has left one.
            self.link(BEFORE, str(self.linked(CURRENT)))  # "None" is the name of no release

    def link(self, name: str, version: str) -> None:
        """Point a link to a release, by one rename."""
        self._unlink(".next")  # of an installer that was killed
        os.symlink(f"releases/{version}", self.root / ".next")
        self.move(".next", name)

    def move(self, link: str, to: str) -> None:
        os.replace(self.root / link, self.root / to)
        os.sync()

    def _unlink(self, name: str) -> None:
        (self.root / name).unlink(missing_ok=True)

    def is_whole(self, version: str) -> bool:
        """Return whether no file of a release is missing, changed or added."""
        path = self.folder(version) / CONTENTS
        return path.exists() and path.read_bytes() == _contents(path.parent)

    def unpack(self, version: str, files: dict[str, bytes]) -> None:
        """Make a release of a bundle's files; rename it once everything is on the disk."""
        folder = self.folder(version)
        draft = folder.with_name(DRAFT)
        draft.mkdir(mode=0o700)
        for name, data in files.items():
            if name.startswith(WHEELS):
                unpack_wheel(data, draft / SITE)
            else:
                (draft / name).parent.mkdir(exist_ok=True)
                (draft / name).write_bytes(data)
        for secret in (draft / TLS).glob("*"):
            secret.chmod(0o600)
        launcher = draft / LAUNCHER
        launcher.parent.mkdir()
        launcher.write_text(_LAUNCH.format(python=sys.executable, packages=str(folder / SITE)))
        launcher.chmod(0o755)
        # Here, because the service may not write, and compiling at each start takes seconds.
        compileall.compile_dir(draft / SITE, quiet=2)
        (draft / CONTENTS).write_bytes(_contents(draft))
        draft.chmod(0o755)
        os.sync()
        if folder.exists():  # It is damaged.
            folder.rename(folder.with_name(DAMAGED))
        draft.rename(folder)
        os.sync()

    def remove_all(self) -> None:
        """Remove the installation, the trusted key last."""
        for name in LINKS:
            self._unlink(name)
        self._tidy()
        self._unlink(self.trusted.name)
        with contextlib.suppress(OSError):  # Folders with other files stay.
            self._releases.rmdir()
            self.root.rmdir()


def _contents(folder: Path) -> bytes:
    hashes = {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path != folder / CONTENTS
    }
    return json.dumps(hashes, indent=0, sort_keys=True).encode()


def unpack_wheel(data: bytes, site: Path) -> None:
    """Write a wheel's packages into `site`, without scripts and data; a board may lack pip."""
    with zipfile.ZipFile(io.BytesIO(data)) as wheel:
        for member in wheel.infolist():
            folder, _, rest = member.filename.partition("/")
            if folder.endswith(".data"):
                kind, _, member.filename = rest.partition("/")
                if kind not in ("purelib", "platlib") or not member.filename:
                    continue
            wheel.extract(member, site)
