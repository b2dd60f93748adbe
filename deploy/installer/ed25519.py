"""Verifies an Ed25519 signature with integers alone (RFC 8032, section 5.1).

A stock board has no cryptography package, and its OpenSSL 1.1.1 cannot verify Ed25519 over a file
(`pkeyutl -rawin` came with 3.0). Verifying handles nothing secret, so time may depend on the data;
for the same reason nothing here can sign.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
from typing import NamedTuple

from deploy.installer.errors import UserError

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
