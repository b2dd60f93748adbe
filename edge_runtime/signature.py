"""Ed25519 over the whole policy file: who made it, and that nothing changed since.

The signature is `POLICY.onnx.sig`, 64 raw bytes; keys are PEM. Contract, section 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Optional

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_public_key

from edge_runtime.errors import UserError
from edge_runtime.files import PathLike, read_bytes

SIGNATURE_SUFFIX = ".sig"
SIGNATURE_BYTES = 64
DEFAULT_PUBLIC_KEY = Path("keys/policy.pub")

VERIFIED = "verified"
BESIDE = "signed by the key beside it"
UNVERIFIED = "signed, not verified"
UNSIGNED = "unsigned"


def verify(policy_bytes: bytes, signature: bytes, public_key_pem: bytes) -> None:
    """Raise UserError unless `signature` is the key owner's over exactly these bytes."""
    key = _load_key(public_key_pem)
    if len(signature) != SIGNATURE_BYTES:
        raise UserError(f"the signature holds {len(signature)} bytes, not {SIGNATURE_BYTES}")
    try:
        key.verify(signature, policy_bytes)
    except InvalidSignature:
        raise UserError(
            "the signature does not fit the policy file and public key:"
            " the file was changed, or another key signed it"
        ) from None


def check_trust(
    path: PathLike, policy_bytes: bytes, public_key: Optional[PathLike], allow_unsigned: bool
) -> str:
    """VERIFIED, BESIDE, UNVERIFIED or UNSIGNED for a policy that may drive; UserError for others.

    A signature is always verified where a public key is known; `allow_unsigned` lets through
    only what cannot be verified, never what fails to. With it, a key beside the policy comes before
    that of the working directory. Without it, such a key counts for nothing: who brings a policy
    could bring it, too.
    """
    signature_path = Path(f"{path}{SIGNATURE_SUFFIX}")
    if not signature_path.exists():
        if allow_unsigned:
            return UNSIGNED
        raise UserError(
            f"policy {path} is not signed ({signature_path.name} is missing);"
            " sign it, or allow it with --allow-unsigned"
        )
    signature = read_bytes(signature_path, "signature")
    beside = Path(path).with_name(DEFAULT_PUBLIC_KEY.name)
    is_beside = allow_unsigned and public_key is None and beside.exists()
    key_path = beside if is_beside else _find_public_key(public_key)
    if key_path is not None:
        key_pem = read_bytes(key_path, "public key")
        try:
            verify(policy_bytes, signature, key_pem)
        except UserError as error:
            raise UserError(
                f"signature {signature_path}, public key {key_path}: {error};"
                " name the key of its signer with --public-key"
            ) from None
        return BESIDE if is_beside else VERIFIED
    if allow_unsigned:
        return UNVERIFIED
    raise UserError(
        f"no public key to verify {signature_path.name} with: name it with --public-key,"
        f" or put it at {DEFAULT_PUBLIC_KEY}"
    )


def _find_public_key(public_key: Optional[PathLike]) -> Optional[PathLike]:
    if public_key is not None:
        return public_key
    return DEFAULT_PUBLIC_KEY if DEFAULT_PUBLIC_KEY.exists() else None


def _load_key(public_key_pem: bytes) -> Ed25519PublicKey:
    try:
        key = load_pem_public_key(public_key_pem)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise UserError("the public key is not a PEM public key") from None
    if not isinstance(key, Ed25519PublicKey):
        raise UserError("the public key is not an Ed25519 key")
    return key
