"""For all tests: signed policy files, and no plug-in that happens to be installed here."""

from collections.abc import Callable
from importlib.metadata import Distribution
from pathlib import Path
from typing import NamedTuple

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

discover = Distribution.discover


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
    from hil_tests.tests.shared.policies import public_pem, write_policy  # loads onnx

    def make(kind: str = "constant", **options: object) -> SignedPolicy:
        key = Ed25519PrivateKey.generate()
        path, public_key = tmp_path / f"{kind}.onnx", tmp_path / f"{kind}.pub"
        public_key.write_bytes(public_pem(key))
        return SignedPolicy(path, public_key, write_policy(path, kind, key=key, **options))  # type: ignore[arg-type]

    return make


@pytest.fixture(autouse=True)
def no_foreign_plugins(monkeypatch, tmp_path_factory):
    """Of other packages' vehicles, scenarios and algorithms only what a test itself brings."""
    base = tmp_path_factory.getbasetemp()

    def is_met(package):
        foreign = any(point.group.startswith("phil.") for point in package.entry_points)
        brought = Path(str(package.locate_file(""))).resolve().is_relative_to(base)
        return not foreign or brought or package.metadata["Name"] == "phil-hil"

    monkeypatch.setattr(Distribution, "discover", lambda **how: filter(is_met, discover(**how)))
