"""Which bundle is believed: every byte of it counts."""

from __future__ import annotations

import contextlib
import io
import os
import random
import subprocess
import tarfile

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from deploy import bundle as bundle_module
from deploy.bundle import _pack, _sign
from deploy.installer.__main__ import trusted_key
from deploy.installer.layout import Layout
from deploy.installer.verify import (
    MANIFEST,
    Manifest,
    UserError,
    parse_manifest,
    read_bundle,
    read_public_key,
    ssh_key,
    to_json,
)
from deploy.tests.boards import HERE

FILES = {"config.toml": b"a = 1\n", "empty": b"", "wheels/a-1.whl": bytes(range(256)) * 5}
KEY = Ed25519PrivateKey.from_private_bytes(bytes(32))
MADE = Manifest("0.1.0-a-b", HERE, "hunter01", "p" * 64)
CONTENTS = {**FILES, MANIFEST: to_json(MADE)}


def pem_of(key) -> bytes:
    return key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)


PUBLIC = pem_of(KEY)


@pytest.fixture
def bundle(tmp_path):
    path = tmp_path / "bundle.tar"
    write(path, _pack(CONTENTS))
    return path


def write(path, data: bytes, key: Ed25519PrivateKey = KEY) -> None:
    """A bundle of these bytes, and the key's signature of them."""
    path.write_bytes(data)
    path.with_name(f"{path.name}.sig").write_bytes(_sign(data, key))


def refused(path, match: str = "is refused", key: bytes = PUBLIC) -> None:
    with pytest.raises(UserError, match=match):
        read_bundle(str(path), key)


def test_what_was_put_in_comes_out_and_others_read_it_too(bundle, tmp_path):
    opened = read_bundle(str(bundle), PUBLIC)
    assert (opened.manifest, opened.files) == (MADE, CONTENTS)
    subprocess.run(["tar", "--extract", "--file", bundle], cwd=tmp_path, check=True)
    assert all((tmp_path / name).read_bytes() == data for name, data in CONTENTS.items())


def changed(path):
    """100 seeded places of a file, one byte of it changed at a time."""
    whole, choice = path.read_bytes(), random.Random(7)
    for place in choice.sample(range(len(whole)), 100):
        data = bytearray(whole)
        data[place] ^= choice.randrange(1, 256)
        path.write_bytes(data)
        yield


def test_any_one_byte_changed_is_found(bundle):
    """`python -m hil_tests board` tries it with the installer on a board."""
    for _ in changed(bundle):
        refused(bundle, "is refused: its signature is not of the key")


def test_a_signature_with_one_byte_changed_is_refused_or_says_the_same(bundle):
    """It is text: a few changes, as of a line's end, leave the signature itself as it was."""
    taken = 0
    for _ in changed(bundle.with_name("bundle.tar.sig")):
        with contextlib.suppress(UserError):
            assert read_bundle(str(bundle), PUBLIC).files == CONTENTS
            taken += 1
    assert taken < 10


@pytest.mark.parametrize("size", [0, 1, 511, 512, 2000, -1, -512, -1024])
def test_a_part_of_it_or_more_is_refused(bundle, size):
    whole = bundle.read_bytes()
    for data in (whole[:size], whole + bytes(abs(size) + 1)):
        bundle.write_bytes(data)
        refused(bundle)


def test_another_key_a_signature_for_something_else_and_none_are_refused(bundle, monkeypatch):
    data = bundle.read_bytes()
    write(bundle, data, Ed25519PrivateKey.generate())
    refused(bundle, "signature is not of the key")
    monkeypatch.setattr(bundle_module, "NAMESPACE", "file")
    write(bundle, data)
    refused(bundle, "signature is not of the key")
    bundle.with_name("bundle.tar.sig").unlink()
    refused(bundle, r"signature .*bundle\.tar\.sig cannot be read")


def tar_of(*kinds: bytes) -> bytes:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as tar:
        for kind in kinds:
            member = tarfile.TarInfo("a")
            member.type, member.linkname = kind, "config.toml"
            tar.addfile(member)
    return packed.getvalue()


NAMES = ("/etc/passwd", "../x", "a/../../x", "a//b", "", ".hidden", "a/.", "a\nb", "a b")
KINDS = (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE)
STRANGE = {
    **{f"name {name!r}": _pack({**CONTENTS, name: b"x"}) for name in NAMES},
    **{f"kind {kind!r}": tar_of(kind) for kind in KINDS},
    "file twice": tar_of(tarfile.REGTYPE, tarfile.REGTYPE),
}
NO_BUNDLE = {"empty": b"", "no tar": b"no tar", "no manifest": _pack(FILES)}


@pytest.mark.parametrize("what", [*STRANGE, *NO_BUNDLE])
def test_what_is_signed_and_no_bundle_is_refused(bundle, what):
    write(bundle, {**STRANGE, **NO_BUNDLE}[what])
    refused(bundle, "holds what no bundle holds" if what in STRANGE else "is refused")


@pytest.mark.parametrize(
    ("raw", "match"),
    [
        *((raw, "manifest is not valid") for raw in (b"", b"[]", b"{}")),
        *((to_json(MADE._replace(version=v)), "manifest is not valid") for v in ("../x", "")),
        (to_json(MADE).replace(b'"format":1', b'"format":2'), "format is 2"),
    ],
)
def test_a_signed_manifest_that_makes_no_sense_is_refused(raw, match):
    with pytest.raises(UserError, match=match):
        parse_manifest(raw)


@pytest.mark.parametrize("name", ["missing.tar", ".", "pipe", "/dev/zero"])
def test_what_cannot_be_read_is_one_line(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match=r"cannot be read|is not a file"):
        trusted_key(Layout(str(tmp_path)), str(tmp_path / name))
    refused(tmp_path / name, r"cannot be read|is not a file")


@pytest.mark.parametrize(
    ("program", "match"),
    [(None, "ssh-keygen cannot be run"), ("echo unknown option -- Y >&2; exit 1", "OpenSSH 8.2")],
)
def test_an_ssh_keygen_that_cannot_verify_is_said(bundle, tmp_path, monkeypatch, program, match):
    monkeypatch.setenv("PATH", str(tmp_path))
    if program:
        (tmp_path / "ssh-keygen").write_text(f"#!/bin/sh\n{program}\n")
        (tmp_path / "ssh-keygen").chmod(0o755)
    refused(bundle, match)


def test_a_key_is_the_same_however_its_lines_end(tmp_path):
    path = tmp_path / "key.pub"
    path.write_bytes(PUBLIC.replace(b"\n", b"\r\n"))
    assert ssh_key(read_public_key(str(path))) == ssh_key(PUBLIC)
    assert ssh_key(PUBLIC) != ssh_key(pem_of(Ed25519PrivateKey.generate()))


def test_what_is_no_public_key_is_said(tmp_path):
    pem = pem_of(ec.generate_private_key(ec.SECP256R1()))
    for wrong in (b"", b"\xff\xfe", pem, pem[:-30], pem.replace(b"PUBLIC", b"PRIVATE")):
        (tmp_path / "key.pub").write_bytes(wrong)
        with pytest.raises(UserError, match="public key is not"):
            read_public_key(str(tmp_path / "key.pub"))
