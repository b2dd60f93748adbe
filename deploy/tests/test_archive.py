"""Every byte of a bundle counts."""

from __future__ import annotations

import hashlib
import os
import random
import subprocess
import tarfile

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from deploy.bundle import _write
from deploy.campaigns.light import HERE
from deploy.installer.archive import CONTEXT, END, MANIFEST, SIGNATURE, header, open_bundle, padding
from deploy.installer.errors import UserError
from deploy.installer.layout import Layout
from deploy.installer.manifest import FileEntry, Manifest, parse_manifest, to_json
from deploy.installer.steps import trusted_key

CONTENTS = {"config.toml": b"a = 1\n", "empty": b"", "wheels/a-1.whl": bytes(range(256)) * 5}
KEY = Ed25519PrivateKey.from_private_bytes(bytes(32))
PUBLIC = KEY.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)


def manifest_of(contents, **changes):
    files = [FileEntry(p, len(d), hashlib.sha256(d).hexdigest()) for p, d in contents.items()]
    return Manifest("0.1.0-a-b", HERE, "hunter01", "p" * 64, files)._replace(**changes)


@pytest.fixture
def bundle(tmp_path):
    path = tmp_path / "bundle.tar"
    _write(path, manifest_of(CONTENTS), KEY, CONTENTS)
    return path


def test_a_bundle_is_a_tar_that_others_read(bundle, tmp_path):
    with tarfile.open(bundle) as tar:
        assert tar.getnames() == [MANIFEST, SIGNATURE, *CONTENTS]
        tar.extractall(tmp_path / "a", filter="data")
    assert all((tmp_path / "a" / n).read_bytes() == data for n, data in CONTENTS.items())
    subprocess.run(["tar", "--extract", "--file", bundle], cwd=tmp_path, check=True)
    assert (tmp_path / "wheels/a-1.whl").read_bytes() == CONTENTS["wheels/a-1.whl"]


def test_what_was_put_in_comes_out(bundle):
    with open_bundle(str(bundle), PUBLIC) as opened:
        assert opened.manifest == manifest_of(CONTENTS)
        assert {e.path: opened.read(e) for e in opened.manifest.files} == CONTENTS


def test_any_one_byte_changed_is_found(bundle):
    """200 seeded places; `python -m deploy.campaigns.tamper` takes thousands, and the installer."""
    whole, choice = bundle.read_bytes(), random.Random(7)
    for place in choice.sample(range(len(whole)), 200):
        changed = bytearray(whole)
        changed[place] ^= choice.randrange(1, 256)
        bundle.write_bytes(changed)
        with pytest.raises(UserError, match="is refused"), open_bundle(str(bundle), PUBLIC):
            pass


@pytest.mark.parametrize("size", [0, 1, 511, 512, 2000, -1, -512, -1024])
def test_a_part_of_it_is_refused(bundle, size):
    bundle.write_bytes(bundle.read_bytes()[:size])
    with pytest.raises(UserError, match="is refused"), open_bundle(str(bundle), PUBLIC):
        pass


def test_more_than_it_is_refused(bundle):
    bundle.write_bytes(bundle.read_bytes() + b"\0")
    with pytest.raises(UserError, match="follows its end"), open_bundle(str(bundle), PUBLIC):
        pass


def test_another_key_and_a_signature_for_something_else_are_refused(bundle):
    other = Ed25519PrivateKey.generate()
    raw = to_json(manifest_of(CONTENTS))
    for signature in (other.sign(CONTEXT + raw), KEY.sign(raw)):
        members = {MANIFEST: raw, SIGNATURE: signature, **CONTENTS}
        data = b"".join(header(n, len(d)) + d + padding(len(d)) for n, d in members.items())
        bundle.write_bytes(data + END)
        with pytest.raises(UserError, match="signature is not of the key"):
            open_bundle(str(bundle), PUBLIC).__enter__()


def test_a_bundle_that_changes_after_it_was_verified(bundle):
    with open_bundle(str(bundle), PUBLIC) as opened:
        entry = opened.manifest.files[2]
        data = bundle.read_bytes()
        with open(bundle, "r+b") as stream:
            stream.seek(data.index(CONTENTS[entry.path]))
            stream.write(b"!")
        with pytest.raises(UserError, match="changed while"):
            opened.read(entry)


@pytest.mark.parametrize(
    "path", ["/etc/passwd", "../x", "a/../../x", "a//b", "", ".hidden", "a/.", "a\nb", "a b"]
)
def test_a_signed_name_that_leaves_the_release_is_refused(path):
    with pytest.raises(UserError, match="manifest is not valid"):
        parse_manifest(to_json(manifest_of({path: b""})))


@pytest.mark.parametrize(
    "changes",
    [{"version": "../x"}, {"version": ""}, {"files": [FileEntry("a", -1, "0" * 64)]},
     {"files": [FileEntry("a", 1, "0" * 64)] * 2}, {"files": [FileEntry("a", 1, "xyz")]}],
)  # fmt: skip
def test_a_signed_manifest_that_makes_no_sense_is_refused(changes):
    with pytest.raises(UserError, match="manifest is not valid"):
        parse_manifest(to_json(manifest_of({}, **changes)))


def test_another_format_is_said():
    raw = to_json(manifest_of({})).replace(b'"format":1', b'"format":2')
    with pytest.raises(UserError, match="format is 2"):
        parse_manifest(raw)


@pytest.mark.parametrize("name", ["missing.tar", ".", "pipe", "/dev/zero"])
def test_what_cannot_be_read_is_one_line(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match=r"cannot be read|is not a file"):
        trusted_key(Layout(str(tmp_path)), str(tmp_path / name))
    with pytest.raises(UserError, match=r"cannot be read|is not a file"):
        open_bundle(str(tmp_path / name), PUBLIC).__enter__()
