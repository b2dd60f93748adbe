"""Decide which bundle is believed: by its signature, and by the computer that it is for.

A bundle is a tar. BUNDLE.tar.sig beside it is what `ssh-keygen -Y sign` makes of the whole file, so
a changed byte anywhere is found before anything inside is looked at. The board's own
`ssh-keygen -Y verify` decides, with the key that the board trusts.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import io
import json
import platform
import re
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import NamedTuple

from edge_runtime.util import UserError, read_bytes

MANIFEST = "manifest.json"
FORMAT = 1
NAMESPACE = "phil-bundle"
"""A signature over anything else, with the same key, does not pass for a bundle's."""
_SIGNER = "owner"
_MAX_BUNDLE_MIB = 1024
_PEM_FRAME = re.compile(rb"-----(BEGIN|END) PUBLIC KEY-----")
_ED25519 = bytes.fromhex("302a300506032b6570032100")
"""Precedes the 32 bytes of a key in a SubjectPublicKeyInfo of Ed25519 (RFC 8410)."""
_SSH_ED25519 = b"\0\0\0\x0bssh-ed25519\0\0\0\x20"
"""Precedes the same 32 bytes in a public key of OpenSSH (RFC 8709)."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]*(/[A-Za-z0-9_][A-Za-z0-9._+-]*)*")
_VERSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]{0,99}")


class Target(NamedTuple):
    """A kind of board: `python` as "3.8", `machine` as uname names it, the oldest `glibc`."""

    name: str
    python: str
    machine: str
    glibc: str

    def __str__(self) -> str:
        return f"Python {self.python} on {self.machine} with glibc {self.glibc}"


class BundleManifest(NamedTuple):
    """What a bundle says of itself. `version` names its bytes and no others."""

    version: str
    target: Target
    vehicle_id: str
    policy_id: str


def read_bundle(path: str, public_key: bytes) -> tuple[BundleManifest, dict[str, bytes]]:
    """Read a bundle that the owner of `public_key` (PEM) has signed: manifest, and files by path.

    It is read once, verified and used from memory, so nobody can change it in between.
    Raises UserError, having written nothing.
    """
    data = read_bytes(path, "bundle", _MAX_BUNDLE_MIB)
    signature = read_bytes(f"{path}.sig", "signature", 1)
    try:
        _check_signature(data, signature, ssh_key(public_key))
        files = _unpack(data)
        return parse_manifest(files.get(MANIFEST, b"")), files
    except UserError as error:
        raise UserError(f"bundle {path} is refused: {error}") from None


def read_public_key(path: str) -> bytes:
    """Read an Ed25519 public key in PEM. Raises UserError for anything else."""
    pem = read_bytes(path, "public key", 1)
    try:
        ssh_key(pem)
    except UserError as error:
        raise UserError(f"public key {path}: {error}") from None
    return pem


def key_name(pem: bytes) -> str:
    """Name a public key by 16 hex digits."""
    return hashlib.sha256(ssh_key(pem).encode()).hexdigest()[:16]


def ssh_key(pem: bytes) -> str:
    """Write an Ed25519 public key in PEM as OpenSSH does. Raises UserError for anything else."""
    try:
        der = base64.b64decode(_PEM_FRAME.sub(b"", pem))
    except binascii.Error:
        der = b""
    if len(der) != len(_ED25519) + 32 or not der.startswith(_ED25519):
        raise UserError("it is no Ed25519 public key in PEM")
    return f"ssh-ed25519 {base64.b64encode(_SSH_ED25519 + der[-32:]).decode()}"


def _check_signature(data: bytes, signature: bytes, allowed: str) -> None:
    with tempfile.TemporaryDirectory(prefix="phil-verify-") as place:
        signers, signed = Path(place, "signers"), Path(place, "sig")
        signers.write_text(f"{_SIGNER} {allowed}\n")
        signed.write_bytes(signature)
        command = ["ssh-keygen", "-Y", "verify", "-f", str(signers), "-I", _SIGNER,
                   "-n", NAMESPACE, "-s", str(signed)]  # fmt: skip
        done = subprocess.run(command, input=data, capture_output=True, check=False)
    if done.returncode != 0:
        said = done.stderr.decode(errors="replace")
        raise UserError(f"it was changed, or signed by a key that is not trusted here ({said})")


def _unpack(data: bytes) -> dict[str, bytes]:
    """The files of a tar by path: regular ones with plain names, and nothing else."""
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as tar:
            for member in tar:
                stream = tar.extractfile(member) if member.isreg() else None
                if stream is None or not _NAME.fullmatch(member.name) or member.name in files:
                    raise UserError(f"no bundle may hold {member.name!r}")
                files[member.name] = stream.read()
    except tarfile.TarError:
        raise UserError("it is no tar") from None
    return files


def to_json(manifest: BundleManifest) -> bytes:
    """Write a manifest in its one form: sorted keys, no spaces, a newline at the end."""
    value = {**manifest._asdict(), "format": FORMAT, "target": manifest.target._asdict()}
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode() + b"\n"


def parse_manifest(data: bytes) -> BundleManifest:
    """Read `to_json`. Raises UserError for another format or a version that is no folder's name."""
    try:
        value = json.loads(data)
        target = Target(**value.pop("target"))
        if value.pop("format") == FORMAT and _VERSION.fullmatch(value["version"]):
            return BundleManifest(target=target, **value)
    except (ValueError, TypeError, KeyError, AttributeError):
        pass
    raise UserError(f"its manifest is not one of format {FORMAT}")


def check_fits(target: Target) -> None:
    """Raise UserError unless Python, processor and C library are what the wheels need."""
    libc, version = platform.libc_ver()
    python = f"{sys.version_info[0]}.{sys.version_info[1]}"
    here = Target("here", python, platform.machine(), version if libc == "glibc" else "none")
    if here[1:3] != target[1:3] or _numbers(here.glibc) < _numbers(target.glibc):
        raise UserError(f"the bundle is for {target} or newer, this is {here}")


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".") if part.isdigit()]
