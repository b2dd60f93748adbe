"""Which bundle is believed: its signature, what it holds, and that it is for this computer.

A bundle is a tar, and beside it stands BUNDLE.tar.sig: what `ssh-keygen -Y sign` says of the whole
file. So a changed byte anywhere is found, and nothing inside is looked at before that. The board's
own `ssh-keygen -Y verify` decides; the key is the one that the board trusts.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import io
import json
import os
import platform
import re
import subprocess
import sys
import tarfile
import tempfile
from typing import Any, NamedTuple

from edge_runtime.util import UserError, read_bytes

MANIFEST = "manifest.json"
FORMAT = 1
NAMESPACE = "phil-bundle"
"""Of the signature: one over something else, with the same key, does not pass for a bundle's."""
_SIGNER = "owner"
_MAX_BUNDLE_MIB = 1024
_BEGIN, _END = "-----BEGIN PUBLIC KEY-----", "-----END PUBLIC KEY-----"
_ED25519 = bytes.fromhex("302a300506032b6570032100")
"""What stands before the 32 bytes of a key in a SubjectPublicKeyInfo of Ed25519 (RFC 8410)."""
_SSH_ED25519 = b"\0\0\0\x0bssh-ed25519\0\0\0\x20"
"""What stands before the same 32 bytes in a public key of OpenSSH (RFC 8709)."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]*(/[A-Za-z0-9_][A-Za-z0-9._+-]*)*")
VERSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]{0,99}")


class UnhealthyError(UserError):
    """A release that may not run here. Its text says why, on one line."""


class Target(NamedTuple):
    """A kind of board: `python` like 3.8, `machine` as uname says, the least `glibc`."""

    name: str
    python: str
    machine: str
    glibc: str


class Manifest(NamedTuple):
    """What a bundle is. `version` names its bytes and no others."""

    version: str
    target: Target
    vehicle_id: str
    policy_id: str


class Bundle(NamedTuple):
    """A verified bundle: what it says of itself, and the bytes of each file by its path."""

    manifest: Manifest
    files: dict[str, bytes]


def read_bundle(path: str, public_key: bytes) -> Bundle:
    """Read a bundle that the owner of `public_key` (PEM) has signed.

    It is read once, verified and used from memory, so nobody can change it in between.
    Raises UserError, having written nothing.
    """
    allowed = ssh_key(public_key)
    data = read_bytes(path, "bundle", _MAX_BUNDLE_MIB)
    signature = read_bytes(f"{path}.sig", "signature", 1)
    try:
        _check_signature(data, signature, allowed)
        files = _unpack(data)
        return Bundle(parse_manifest(files.get(MANIFEST, b"")), files)
    except UserError as error:
        raise UserError(f"bundle {path} is refused: {error}") from None


def read_public_key(path: str) -> bytes:
    """The PEM of an Ed25519 public key. Raises UserError for anything else."""
    pem = read_bytes(path, "public key", 1)
    try:
        ssh_key(pem)
    except UserError as error:
        raise UserError(f"public key {path}: {error}") from None
    return pem


def key_name(pem: bytes) -> str:
    """A few digits by which a person tells public keys apart."""
    return hashlib.sha256(ssh_key(pem).encode()).hexdigest()[:16]


def ssh_key(pem: bytes) -> str:
    """A public key in PEM as OpenSSH writes it in a file of allowed signers."""
    lines = [line.strip() for line in pem.decode("ascii", "replace").split("\n") if line.strip()]
    if len(lines) < 3 or lines[0] != _BEGIN or lines[-1] != _END:
        raise UserError("the public key is not a PEM public key")
    try:
        der = base64.b64decode("".join(lines[1:-1]), validate=True)
    except binascii.Error:
        raise UserError("the public key is not a PEM public key") from None
    if len(der) != len(_ED25519) + 32 or not der.startswith(_ED25519):
        raise UserError("the public key is not an Ed25519 key")
    return f"ssh-ed25519 {base64.b64encode(_SSH_ED25519 + der[-32:]).decode()}"


def _check_signature(data: bytes, signature: bytes, allowed: str) -> None:
    with tempfile.TemporaryDirectory(prefix="phil-verify-") as place:
        keys, signed = os.path.join(place, "keys"), os.path.join(place, "sig")
        for path, content in ((keys, f"{_SIGNER} {allowed}\n".encode()), (signed, signature)):
            with open(path, "wb") as stream:
                stream.write(content)
        command = ["ssh-keygen", "-Y", "verify", "-f", keys, "-I", _SIGNER,
                   "-n", NAMESPACE, "-s", signed]  # fmt: skip
        try:
            done = subprocess.run(command, input=data, capture_output=True, check=False)
        except OSError as error:
            raise UserError(f"ssh-keygen cannot be run: {error.strerror}") from None
    if b"unknown option" in done.stderr:
        raise UserError("this ssh-keygen verifies no signatures: OpenSSH 8.2 or newer is needed")
    if done.returncode != 0:
        raise UserError("its signature is not of the key that is trusted here, or it was changed")


def _unpack(data: bytes) -> dict[str, bytes]:
    """The files of a tar by path: regular ones with plain names, and nothing else."""
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as tar:
            for member in tar:
                stream = tar.extractfile(member) if member.isreg() else None
                if stream is None or not _NAME.fullmatch(member.name) or member.name in files:
                    raise UserError(f"it holds what no bundle may hold: {member.name!r}")
                files[member.name] = stream.read()
    except tarfile.TarError:
        raise UserError("it is no bundle") from None
    return files


def to_json(manifest: Manifest) -> bytes:
    """The one way to write it: sorted keys, no spaces, a newline at the end."""
    value = {**manifest._asdict(), "format": FORMAT, "target": manifest.target._asdict()}
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode() + b"\n"


def parse_manifest(data: bytes) -> Manifest:
    """Read `to_json`. Raises UserError for another format or a version that is no folder's name."""
    try:
        value: dict[str, Any] = json.loads(data)
        if value["format"] != FORMAT:
            raise UserError(f"its format is {value['format']}, this installer reads {FORMAT}")
        names = ("version", "vehicle_id", "policy_id")
        manifest = Manifest(target=Target(**value["target"]), **{n: value[n] for n in names})
        if not VERSION.fullmatch(manifest.version):
            raise ValueError(manifest.version)
    except (ValueError, TypeError, KeyError, RecursionError):
        raise UserError("its manifest is not valid") from None
    return manifest


def check_fits(target: Target) -> None:
    """Raise UserError unless Python, processor and C library are what the wheels need."""
    python = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if python != target.python:
        raise UserError(
            f"the bundle is for Python {target.python} and this is {python}:"
            f" run it with python{target.python}"
        )
    if platform.machine() != target.machine:
        raise UserError(f"the bundle is for {target.machine}, this is {platform.machine()}")
    name, version = platform.libc_ver()
    if name != "glibc" or _numbers(version) < _numbers(target.glibc):
        found = f"{name or 'another'} {version}".rstrip()
        raise UserError(f"the bundle needs glibc {target.glibc}, this is {found}")


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".") if part.isdigit()]
