"""The bundle as a file: a tar of which every byte follows from the signed manifest.

tar(1) can unpack it, but nobody here trusts what tar says: each header is written anew from the
manifest and must be the very bytes that are there, padding must be zero, and nothing may follow.
So a single changed byte anywhere is found, not only one inside a file.

    manifest.json, manifest.sig, then the manifest's files in its order

`manifest.sig` is Ed25519 over CONTEXT and the bytes of manifest.json.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
from typing import BinaryIO, Iterator

from deploy.installer import ed25519
from deploy.installer.errors import UserError
from deploy.installer.manifest import FileEntry, Manifest, parse_manifest

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
    signature_header = header(SIGNATURE, ed25519.SIGNATURE_BYTES)
    if stream.read(BLOCK) != signature_header:
        raise UserError("it holds no signature")
    signature = stream.read(ed25519.SIGNATURE_BYTES)
    if stream.read(len(padding(len(signature)))) != padding(len(signature)):
        raise UserError("what follows its signature is not zero")
    # Nothing inside is looked at before the signature holds.
    if not ed25519.verify(public_key, CONTEXT + raw, signature):
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
