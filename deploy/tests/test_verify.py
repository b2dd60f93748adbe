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


def test_a_bundle_is_a_tar_that_others_read(bundle, tmp_path):
    with tarfile.open(bundle) as tar:
        assert tar.getnames() == sorted(CONTENTS)
        tar.extractall(tmp_path / "a", filter="data")
    assert all((tmp_path / "a" / n).read_bytes() == data for n, data in CONTENTS.items())
    subprocess.run(["tar", "--extract", "--file", bundle], cwd=tmp_path, check=True)
    assert (tmp_path / "wheels/a-1.whl").read_bytes() == CONTENTS["wheels/a-1.whl"]


def test_what_was_put_in_comes_out(bundle):
    opened = read_bundle(str(bundle), PUBLIC)
    assert opened.manifest == MADE
    assert opened.files == CONTENTS


def test_any_one_byte_changed_is_found(bundle):
    """100 seeded places; `python -m hil_tests board` tries it with the installer on a board."""
    whole, choice = bundle.read_bytes(), random.Random(7)
    for place in choice.sample(range(len(whole)), 100):
        changed = bytearray(whole)
        changed[place] ^= choice.randrange(1, 256)
        bundle.write_bytes(changed)
        refused(bundle, "is refused: its signature is not of the key")


def test_a_signature_with_one_byte_changed_is_refused_or_says_the_same(bundle):
    """It is text: a few changes, as of a line's end, leave the signature itself as it was."""
    path = bundle.with_name("bundle.tar.sig")
    whole, choice = path.read_bytes(), random.Random(7)
    taken = 0
    for place in choice.sample(range(len(whole)), 100):
        changed = bytearray(whole)
        changed[place] ^= choice.randrange(1, 256)
        path.write_bytes(changed)
        with contextlib.suppress(UserError):
            assert read_bundle(str(bundle), PUBLIC).files == CONTENTS
            taken += 1
    assert taken < 10


@pytest.mark.parametrize("size", [0, 1, 511, 512, 2000, -1, -512, -1024])
def test_a_part_of_it_is_refused(bundle, size):
    bundle.write_bytes(bundle.read_bytes()[:size])
    refused(bundle)


def test_more_than_it_is_refused(bundle):
    bundle.write_bytes(bundle.read_bytes() + b"\0")
    refused(bundle)


def test_another_key_and_a_signature_for_something_else_are_refused(bundle, monkeypatch):
    data = bundle.read_bytes()
    write(bundle, data, Ed25519PrivateKey.generate())
    refused(bundle, "signature is not of the key")
    monkeypatch.setattr(bundle_module, "NAMESPACE", "file")
    write(bundle, data)
    refused(bundle, "signature is not of the key")


def test_without_a_signature_it_is_refused(bundle):
    bundle.with_name("bundle.tar.sig").unlink()
    refused(bundle, r"signature .*bundle\.tar\.sig cannot be read")


@pytest.mark.parametrize(
    "path", ["/etc/passwd", "../x", "a/../../x", "a//b", "", ".hidden", "a/.", "a\nb", "a b"]
)
def test_a_signed_name_that_leaves_the_release_is_refused(bundle, path):
    write(bundle, _pack({**CONTENTS, path: b"x"}))
    refused(bundle, "holds what no bundle holds")


@pytest.mark.parametrize(
    "kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE]
)
def test_a_signed_link_folder_or_pipe_is_refused(bundle, kind):
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as tar:
        member = tarfile.TarInfo("a")
        member.type, member.linkname = kind, "config.toml"
        tar.addfile(member)
    write(bundle, packed.getvalue())
    refused(bundle, "holds what no bundle holds")


def test_a_signed_file_that_stands_there_twice_is_refused(bundle):
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as tar:
        for _ in range(2):
            tar.addfile(tarfile.TarInfo("a"))
    write(bundle, packed.getvalue())
    refused(bundle, "holds what no bundle holds")


@pytest.mark.parametrize(
    "data", [b"", b"no tar", _pack(FILES)], ids=["empty", "no tar", "no manifest"]
)
def test_what_is_signed_and_no_bundle_is_refused(bundle, data):
    write(bundle, data)
    refused(bundle)


@pytest.mark.parametrize("raw", [b"", b"[]", b"{}", to_json(MADE._replace(version="../x")),
                                 to_json(MADE._replace(version=""))])  # fmt: skip
def test_a_signed_manifest_that_makes_no_sense_is_refused(raw):
    with pytest.raises(UserError, match="manifest is not valid"):
        parse_manifest(raw)


def test_another_format_is_said():
    raw = to_json(MADE).replace(b'"format":1', b'"format":2')
    with pytest.raises(UserError, match="format is 2"):
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
