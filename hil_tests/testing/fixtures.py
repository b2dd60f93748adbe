"""Fixtures for the tests of all folders; `conftest.py` of the repository loads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey


class SignedPolicy(NamedTuple):
    path: Path
    public_key: Path
    policy_id: str

    @property
    def flags(self) -> list[str]:
        return ["--policy", str(self.path), "--public-key", str(self.public_key)]


@pytest.fixture
def make_policy(tmp_path: Path) -> Callable[..., SignedPolicy]:
    """Write a signed policy file of a kind, with the public key beside it."""
    from hil_tests.testing.policies import public_pem, write_policy  # loads onnx

    def make(kind: str = "constant", **options: object) -> SignedPolicy:
        key = Ed25519PrivateKey.generate()
        path, public_key = tmp_path / f"{kind}.onnx", tmp_path / f"{kind}.pub"
        public_key.write_bytes(public_pem(key))
        return SignedPolicy(path, public_key, write_policy(path, kind, key=key, **options))  # type: ignore[arg-type]

    return make
