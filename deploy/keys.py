"""Ed25519 key pairs: the private one signs policies, the public one lets a board verify them."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)

from edge_runtime.cli import examples
from edge_runtime.files import make_directory, write_atomic
from edge_runtime.policy_file import DEFAULT_PUBLIC_KEY
from edge_runtime.util import UserError

DEFAULT_DIRECTORY = str(DEFAULT_PUBLIC_KEY.parent)
EXAMPLE = examples("python -m deploy keys --out keys")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--out",
        metavar="DIR",
        default=DEFAULT_DIRECTORY,
        help="directory for policy.key and policy.pub",
    )


def run(arguments: argparse.Namespace) -> int:
    """Make a pair and say where each half belongs."""
    private, public = write_key_pair(Path(arguments.out))
    print(f"private key (keep it on the workstation): {private}")
    print(f"public key (goes onto the board):         {public}")
    return 0


def write_key_pair(directory: Path) -> tuple[Path, Path]:
    """Write ``policy.key`` (PKCS8 PEM, readable by the owner alone) and ``policy.pub``.

    Raises:
        UserError: a key is there already (it may have signed policies that drive), or the
            directory cannot be written.
    """
    private_path, public_path = directory / "policy.key", directory / DEFAULT_PUBLIC_KEY.name
    for path in (private_path, public_path):
        if path.exists():
            raise UserError(f"{path} exists and is not overwritten; choose another --out")
    make_directory(directory)
    key = Ed25519PrivateKey.generate()
    # The umask, not a later chmod: the private key is never readable by others, even briefly.
    before = os.umask(0o077)
    try:
        private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        write_atomic(private_path, private)
    finally:
        os.umask(before)
    public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    try:
        write_atomic(public_path, public)
    except UserError:
        # Half a pair would make the next try refuse to overwrite it.
        private_path.unlink()
        raise
    return private_path, public_path
