"""Every byte of a bundle counts."""

from __future__ import annotations

import hashlib
import os
import random
import subprocess
import tarfile

import pytest
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.bundle import _write
from deploy.campaigns.light import HERE
from deploy.installer.layout import Layout
from deploy.installer.steps import trusted_key
from deploy.installer.verify import (
    _ORDER,
    CONTEXT,
    END,
    MANIFEST,
    SIGNATURE,
    FileEntry,
    Manifest,
    UserError,
    header,
    open_bundle,
    padding,
    parse_manifest,
    parse_public_key,
    to_json,
    verify,
)

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


# RFC 8032, section 7.1: TEST 1, 2, 3 and SHA(abc): public key, message, signature.
VECTORS = [
    (
        "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
        "",
        "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bacc61e39701c"
        "f9b46bd25bf5f0595bbe24655141438e7a100b",
    ),
    (
        "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
        "72",
        "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da085ac1e43e15996e458f3613d0"
        "f11d8c387b2eaeb4302aeeb00d291612bb0c00",
    ),
    (
        "fc51cd8e6218a1a38da47ed00230f0580816ed13ba3303ac5deb911548908025",
        "af82",
        "6291d657deec24024827e69c3abe01a30ce548a284743a445e3680d7db5ac3ac18ff9b538d16f290ae67f760984d"
        "c6594a7c15e9716ed28dc027beceea1ec40a",
    ),
    (
        "ec172b93ad5e563bf4932c70e1245034c35467ef2efd4d64ebf819683467e2bf",
        "ddaf35a193617abacc417349ae20413112e6fa4e89a97ea20a9eeee64b55d39a2192992a274fc1a836ba3c23a3fee"
        "bbd454d4423643ce80e2a9ac94fa54ca49f",
        "dc2a4459e7369633a52b1bf277839a00201009a3efbf3ecb69bea2186c26b58909351fc9ac90b3ecfdfbc7c66431e"
        "0303dca179c138ac17ad9bef1177331a704",
    ),
]


@pytest.mark.parametrize(("key", "message", "signature"), VECTORS)
def test_vectors(key, message, signature):
    key, message, signature = (bytes.fromhex(text) for text in (key, message, signature))
    assert verify(key, message, signature)
    assert not verify(key, message + b"!", signature)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.binary(min_size=32, max_size=32),
    message=st.binary(max_size=200),
    flip=st.tuples(st.integers(0, 2), st.integers(0, 10**6), st.integers(1, 255)),
)
def test_it_decides_as_openssl_does(seed, message, flip):
    """For what was signed, and for the same with one byte changed somewhere."""
    private = Ed25519PrivateKey.from_private_bytes(seed)
    key = private.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
    parts = [key, message, private.sign(message)]
    assert verify(*parts)
    which, place, change = flip
    if parts[which]:
        changed = bytearray(parts[which])
        changed[place % len(changed)] ^= change
        parts[which] = bytes(changed)
        assert verify(*parts) == openssl_verifies(*parts)


def openssl_verifies(key: bytes, message: bytes, signature: bytes) -> bool:
    try:
        Ed25519PublicKey.from_public_bytes(key).verify(signature, message)
    except (InvalidSignature, ValueError):
        return False
    return True


def test_a_second_form_of_the_same_signature_is_refused():
    """S + L fits the equation, too (RFC 8032, 8.4): who accepts it accepts a changed file."""
    private = Ed25519PrivateKey.generate()
    key = private.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
    signature = private.sign(b"bundle")
    scalar = int.from_bytes(signature[32:], "little") + _ORDER
    twin = signature[:32] + scalar.to_bytes(32, "little")
    assert verify(key, b"bundle", signature)
    assert not verify(key, b"bundle", twin)


def test_sizes_and_points_that_are_none():
    private = Ed25519PrivateKey.generate()
    key = private.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
    signature = private.sign(b"")
    assert not verify(key[:-1], b"", signature)
    assert not verify(key, b"", signature[:-1])
    for y in (2, 2**255 - 19, 2**255 - 1, 1 | 1 << 255):  # no point, not reduced, -0
        assert not verify(y.to_bytes(32, "little"), b"", signature)


def test_a_key_is_read_as_openssl_reads_it():
    public = Ed25519PrivateKey.generate().public_key()
    pem = public.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    raw = public.public_bytes(Encoding.Raw, PublicFormat.Raw)
    assert parse_public_key(pem) == parse_public_key(pem.replace(b"\n", b"\r\n")) == raw


def test_what_is_no_public_key_is_said():
    other = ec.generate_private_key(ec.SECP256R1()).public_key()
    pem = other.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    for wrong in (b"", b"\xff\xfe", pem, pem[:-30], pem.replace(b"PUBLIC", b"PRIVATE")):
        with pytest.raises(UserError, match="public key is not"):
            parse_public_key(wrong)
