"""Private keys in PEM, of those who sign and of those who speak TLS."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from edge_runtime.errors import UserError
from edge_runtime.files import PathLike, read_bytes

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey


def read_private_key(path: PathLike) -> Any:
    """A private key of any kind, without a password. Raises UserError where the file holds none."""
    # Only who has a key pays for these, in memory and at the start.
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    pem = read_bytes(path, "private key")
    try:
        return load_pem_private_key(pem, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise UserError(f"{path} is not a private key in PEM without a password") from None


def read_signing_key(path: PathLike) -> Ed25519PrivateKey:
    """The Ed25519 key that signs policies and bundles. Raises UserError for anything else."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    if not os.path.exists(path):
        raise UserError(f"private key {path} does not exist; `python -m deploy keys` makes one")
    key = read_private_key(path)
    if not isinstance(key, Ed25519PrivateKey):
        raise UserError(f"{path} is not an Ed25519 key; `python -m deploy keys` makes one")
    return key
