import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
)

from edge_runtime.errors import UserError
from edge_runtime.private_keys import read_private_key, read_signing_key

SM2 = """-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqBHM9VAYItBG0wawIBAQQgOT8zVOhnwMqKGmhW
bOaBqhJfcbJUpXzXnCKMbtoIVWqhRANCAASw9HXpv3hPTdG7qCzE6RYVYMKrbQRH
Vr/LhzTsFDjPQKyiO3ZuVQ2q4nEoMMYUN0FiBWkZ5VWDR6fIxYHvmw3f
-----END PRIVATE KEY-----
"""
"""Of a curve that cryptography reads and does not know."""


def pem(key, encryption=None):
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption or NoEncryption())


def test_a_signing_key_is_read(tmp_path):
    key = Ed25519PrivateKey.generate()
    path = tmp_path / "policy.key"
    path.write_bytes(pem(key))
    assert read_signing_key(path).public_key() == key.public_key()


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (b"no key", "is not a private key"),
        (SM2.encode(), "is not a private key"),
        (pem(Ed25519PrivateKey.generate(), BestAvailableEncryption(b"secret")), "password"),
        (pem(ec.generate_private_key(ec.SECP256R1())), "is not an Ed25519 key"),
    ],
)
def test_what_cannot_sign_is_said(tmp_path, data, part):
    path = tmp_path / "some.key"
    path.write_bytes(data)
    with pytest.raises(UserError, match=part):
        read_signing_key(path)


def test_a_key_of_another_kind_is_a_private_key(tmp_path):
    path = tmp_path / "some.key"
    path.write_bytes(pem(ec.generate_private_key(ec.SECP256R1())))
    assert isinstance(read_private_key(path), ec.EllipticCurvePrivateKey)
