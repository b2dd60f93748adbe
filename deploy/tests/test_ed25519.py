"""The verifier of the board against RFC 8032's own vectors and against OpenSSL's code."""

from __future__ import annotations

import pytest
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.installer.ed25519 import _ORDER, parse_public_key, verify
from deploy.installer.errors import UserError

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
