"""What is believed of a bundle: its signature, every byte, and that it is for this computer.

The bundle is a tar of which every byte follows from the signed manifest. tar(1) can unpack it, but
each header is written anew from the manifest and must be the very bytes that are there, padding
must be zero, and nothing may follow. So a changed byte anywhere is found.

    manifest.json, manifest.sig, then the manifest's files in its order

`manifest.sig` is Ed25519 over CONTEXT and the bytes of manifest.json.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import hashlib
import json
import os
import platform
import re
import stat
import sys
from typing import Any, BinaryIO, Iterator, NamedTuple


class _OneLineError(Exception):
    def __str__(self) -> str:
        """The text on one line, whatever a file name or the system put into it."""
        line = " ".join(super().__str__().split())
        # What a terminal would act upon is written as its escape.
        return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


class UserError(_OneLineError):
    """Bad input. Its text is one line: what is wrong, and what would be right."""


class UnhealthyError(_OneLineError):
    """A release that may not run here. Its text says why, on one line."""


FORMAT = 1
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]*(/[A-Za-z0-9_][A-Za-z0-9._+-]*)*")
_VERSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]{0,99}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


class FileEntry(NamedTuple):
    """One file of the bundle; `size` in bytes, `sha256` in hex."""

    path: str
    size: int
    sha256: str


class Target(NamedTuple):
    """A kind of board: `python` like 3.8, `machine` as uname says, the least `glibc`."""

    name: str
    python: str
    machine: str
    glibc: str


class Manifest(NamedTuple):
    """All of it. `version` names these bytes and no others."""

    version: str
    target: Target
    vehicle_id: str
    policy_id: str
    files: list[FileEntry]


def to_json(manifest: Manifest) -> bytes:
    """The one way to write it: sorted keys, no spaces, a newline at the end."""
    value: dict[str, Any] = manifest._asdict()
    value["format"] = FORMAT
    value["target"] = manifest.target._asdict()
    value["files"] = [entry._asdict() for entry in manifest.files]
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode() + b"\n"


def parse_manifest(data: bytes) -> Manifest:
    """Read `to_json`. Raises UserError for another format, and for names that leave the release."""
    try:
        value = json.loads(data)
        if value["format"] != FORMAT:
            raise UserError(f"its format is {value['format']}, this installer reads {FORMAT}")
        manifest = Manifest(
            version=value["version"],
            target=Target(**value["target"]),
            vehicle_id=value["vehicle_id"],
            policy_id=value["policy_id"],
            files=[FileEntry(**entry) for entry in value["files"]],
        )
        _check(manifest)
    except (ValueError, TypeError, KeyError, RecursionError):
        raise UserError("its manifest is not valid") from None
    return manifest


def _check(manifest: Manifest) -> None:
    if not _VERSION.fullmatch(manifest.version):
        raise ValueError(manifest.version)
    for entry in manifest.files:
        if not (_NAME.fullmatch(entry.path) and _SHA256.fullmatch(entry.sha256)):
            raise ValueError(entry.path)
        if isinstance(entry.size, bool) or entry.size < 0:
            raise ValueError(entry.path)
    if len({entry.path for entry in manifest.files}) != len(manifest.files):
        raise ValueError("a file stands there twice")


KEY_BYTES = 32
SIGNATURE_BYTES = 64
_P = 2**255 - 19
_ORDER = 2**252 + 27742317777372353535851937790883648493
_D = -121665 * pow(121666, _P - 2, _P) % _P
_ROOT_OF_MINUS_ONE = pow(2, (_P - 1) // 4, _P)
_SPKI_PREFIX = bytes.fromhex("302a300506032b6570032100")
"""What stands before the 32 bytes in a SubjectPublicKeyInfo of Ed25519 (RFC 8410)."""
_BEGIN, _END = "-----BEGIN PUBLIC KEY-----", "-----END PUBLIC KEY-----"


class _Point(NamedTuple):
    """Extended coordinates (RFC 8032, 5.1.4): x = X/Z, y = Y/Z, x * y = T/Z."""

    x: int
    y: int
    z: int
    t: int


def parse_public_key(pem: bytes) -> bytes:
    """The 32 bytes of a public key in PEM. Raises UserError for anything else."""
    lines = pem.decode("ascii", "replace").split("\n")
    lines = [line.strip() for line in lines if line.strip()]
    if len(lines) < 3 or lines[0] != _BEGIN or lines[-1] != _END:
        raise UserError("the public key is not a PEM public key")
    try:
        der = base64.b64decode("".join(lines[1:-1]), validate=True)
    except binascii.Error:
        raise UserError("the public key is not a PEM public key") from None
    if len(der) != len(_SPKI_PREFIX) + KEY_BYTES or not der.startswith(_SPKI_PREFIX):
        raise UserError("the public key is not an Ed25519 key")
    return der[len(_SPKI_PREFIX) :]


def verify(public_key: bytes, message: bytes, signature: bytes) -> bool:
    """Whether `signature` (64 bytes) is the key owner's (32 bytes) over exactly `message`.

    Without cofactor, as OpenSSL decides: R must be the very bytes that S and the message give.
    """
    if len(public_key) != KEY_BYTES or len(signature) != SIGNATURE_BYTES:
        return False
    key = _decode(public_key)
    scalar = int.from_bytes(signature[KEY_BYTES:], "little")
    if key is None or scalar >= _ORDER:
        return False
    digest = hashlib.sha512(signature[:KEY_BYTES] + public_key + message).digest()
    challenge = int.from_bytes(digest, "little") % _ORDER
    minus_key = _Point(_P - key.x, key.y, key.z, _P - key.t)
    found = _add(_multiply(scalar, _BASE), _multiply(challenge, minus_key))
    return _encode(found) == signature[:KEY_BYTES]


def _decode(data: bytes) -> _Point | None:
    """The point of 32 bytes (5.1.3); None where they are none, or one written in a second way."""
    number = int.from_bytes(data, "little")
    sign, y = number >> 255, number & ((1 << 255) - 1)
    x = _recover_x(y, sign)
    return None if x is None else _Point(x, y, 1, x * y % _P)


def _recover_x(y: int, sign: int) -> int | None:
    if y >= _P:
        return None
    square = (y * y - 1) * pow(_D * y * y + 1, _P - 2, _P) % _P
    x = pow(square, (_P + 3) // 8, _P)
    if (x * x - square) % _P != 0:
        x = x * _ROOT_OF_MINUS_ONE % _P
    if (x * x - square) % _P != 0 or (x == 0 and sign == 1):
        return None
    return _P - x if x & 1 != sign else x


def _encode(point: _Point) -> bytes:
    inverse = pow(point.z, _P - 2, _P)
    x, y = point.x * inverse % _P, point.y * inverse % _P
    return (y | (x & 1) << 255).to_bytes(KEY_BYTES, "little")


def _add(a: _Point, b: _Point) -> _Point:
    """Complete addition, doubling included (5.1.4)."""
    m, n = (a.y - a.x) * (b.y - b.x) % _P, (a.y + a.x) * (b.y + b.x) % _P
    c, d = 2 * a.t * b.t * _D % _P, 2 * a.z * b.z % _P
    e, f, g, h = n - m, d - c, d + c, n + m
    return _Point(e * f % _P, g * h % _P, f * g % _P, e * h % _P)


def _multiply(scalar: int, point: _Point) -> _Point:
    total = _Point(0, 1, 1, 0)
    while scalar:
        if scalar & 1:
            total = _add(total, point)
        point = _add(point, point)
        scalar >>= 1
    return total


def _base() -> _Point:
    point = _decode((4 * pow(5, _P - 2, _P) % _P).to_bytes(KEY_BYTES, "little"))
    assert point is not None
    return point


_BASE = _base()


MANIFEST, SIGNATURE = "manifest.json", "manifest.sig"
CONTEXT = b"phil bundle manifest 1\n"
"""Before what is signed: a signature over a policy file can never pass for one over a bundle."""
BLOCK = 512
END = bytes(2 * BLOCK)
_MODE = 0o600
_MAX_MANIFEST_BYTES = 1 << 20
_CHUNK = 1 << 20


def header(name: str, size: int) -> bytes:
    """The 512 bytes before a file's content (POSIX ustar): owner 0, time 0, mode 0600."""
    raw = name.encode("ascii")
    if len(raw) > 100:
        raise UserError(f"the name {name} is too long for a bundle: 100 characters at most")
    fields = [
        raw.ljust(100, b"\0"),
        b"%07o\0" % _MODE,
        b"%07o\0" % 0,
        b"%07o\0" % 0,
        b"%011o\0" % size,
        b"%011o\0" % 0,
        b" " * 8,  # the checksum counts itself as spaces
        b"0".ljust(101, b"\0"),
        b"ustar\x0000".ljust(BLOCK - 257, b"\0"),
    ]
    block = b"".join(fields)
    return block[:148] + b"%06o\0 " % sum(block) + block[156:]


def padding(size: int) -> bytes:
    """The zeros that fill a file's last block."""
    return bytes(-size % BLOCK)


class Bundle:
    """An open, verified bundle. Make it with `open_bundle`."""

    def __init__(self, stream: BinaryIO, manifest: Manifest, raw: tuple[bytes, bytes]) -> None:
        self.manifest = manifest
        self.manifest_json, self.signature = raw
        self._stream = stream
        self._offsets: dict[str, int] = {}

    def check_files(self) -> None:
        """Hold every byte after the signature against the manifest."""
        for entry in self.manifest.files:
            self._expect(header(entry.path, entry.size), f"the header of {entry.path}")
            self._offsets[entry.path] = self._stream.tell()
            digest, left = hashlib.sha256(), entry.size
            while left:
                chunk = self._stream.read(min(left, _CHUNK))
                if not chunk:
                    raise UserError(f"it ends within {entry.path}")
                digest.update(chunk)
                left -= len(chunk)
            if digest.hexdigest() != entry.sha256:
                raise UserError(f"{entry.path} is not what the manifest says")
            self._expect(padding(entry.size), f"what follows {entry.path}")
        self._expect(END, "its end")
        if self._stream.read(1):
            raise UserError("something follows its end")

    def read(self, entry: FileEntry) -> bytes:
        """A file's bytes, checked once more: the bundle may change after it was verified."""
        self._stream.seek(self._offsets[entry.path])
        data = self._stream.read(entry.size)
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise UserError(f"{entry.path} changed while the bundle was read")
        return data

    def _expect(self, wanted: bytes, what: str) -> None:
        if self._stream.read(len(wanted)) != wanted:
            raise UserError(f"{what} is not what the manifest says")


@contextlib.contextmanager
def open_bundle(path: str, public_key: bytes) -> Iterator[Bundle]:
    """A bundle of which every byte is verified. Raises UserError, having written nothing.

    `public_key` is the 32 bytes of the key that this board trusts.
    """
    with open_file(path, "bundle") as stream:
        try:
            bundle = _verify(stream, public_key)
        except UserError as error:
            raise UserError(f"bundle {path} is refused: {error}") from None
        except OSError as error:
            raise UserError(f"bundle {path} cannot be read: {error.strerror}") from None
        yield bundle


def open_file(path: str, what: str) -> BinaryIO:
    """Open a regular file to read. UserError for all else: a pipe would be waited for."""
    try:
        stream = open(path, "rb", opener=_at_once)  # noqa: SIM115 - whoever asked for it closes it
    except OSError as error:
        raise UserError(f"{what} {path} cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise UserError(f"{what} {path} is not a file")
    return stream


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)


def _verify(stream: BinaryIO, public_key: bytes) -> Bundle:
    raw = _read_manifest(stream)
    signature_header = header(SIGNATURE, SIGNATURE_BYTES)
    if stream.read(BLOCK) != signature_header:
        raise UserError("it holds no signature")
    signature = stream.read(SIGNATURE_BYTES)
    if stream.read(len(padding(len(signature)))) != padding(len(signature)):
        raise UserError("what follows its signature is not zero")
    # Nothing inside is looked at before the signature holds.
    if not verify(public_key, CONTEXT + raw, signature):
        raise UserError("its signature is not of the key that is trusted here, or it was changed")
    bundle = Bundle(stream, parse_manifest(raw), (raw, signature))
    bundle.check_files()
    return bundle


def _read_manifest(stream: BinaryIO) -> bytes:
    block = stream.read(BLOCK)
    try:
        size = int(block[124:135], 8)
    except ValueError:
        raise UserError("it is no bundle") from None
    if not 0 < size <= _MAX_MANIFEST_BYTES or block != header(MANIFEST, size):
        raise UserError("it is no bundle")
    raw = stream.read(size)
    if stream.read(len(padding(size))) != padding(size):
        raise UserError("what follows its manifest is not zero")
    return raw


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
    name, _, version = (os.confstr("CS_GNU_LIBC_VERSION") or "another").partition(" ")
    if name != "glibc" or _numbers(version) < _numbers(target.glibc):
        raise UserError(f"the bundle needs glibc {target.glibc}, this is {name} {version}")


def _numbers(version: str) -> list[int]:
    return [int(part) for part in version.split(".") if part.isdigit()]
