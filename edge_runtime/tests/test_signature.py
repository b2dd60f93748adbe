"""No byte of a signed policy can change, nor of its signature: every place is tried."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from edge_runtime.errors import UserError
from edge_runtime.signature import verify
from edge_runtime.tests.harness import run_command
from edge_runtime.tests.policies import public_pem, write_policy

POLICIES = Path(__file__).parents[2] / "results" / "policies"
GROUP_ORDER = 2**252 + 27742317777372353535851937790883648493  # of Ed25519, RFC 8032


@pytest.fixture
def signed(tmp_path):
    """A small policy's bytes, its signature and the public key."""
    key = Ed25519PrivateKey.generate()
    path = tmp_path / "p.onnx"
    write_policy(path, key=key)
    return path.read_bytes(), Path(f"{path}.sig").read_bytes(), public_pem(key)


def is_accepted(policy, signature, public_key):
    try:
        verify(policy, signature, public_key)
    except UserError:
        return False
    return True


def changed(data, place, flip):
    return data[:place] + bytes([data[place] ^ flip]) + data[place + 1 :]


def test_every_byte_of_a_small_policy_counts(signed):
    data, signature, public_key = signed
    assert is_accepted(data, signature, public_key)
    draw = random.Random(1)
    for place in range(len(data)):
        flip = draw.randint(1, 255)
        assert not is_accepted(changed(data, place, flip), signature, public_key), (place, flip)


def test_every_bit_of_the_signature_counts(signed):
    data, signature, public_key = signed
    for place in range(len(signature)):
        for bit in range(8):
            assert not is_accepted(data, changed(signature, place, 1 << bit), public_key), place


def test_a_second_form_of_the_same_signature_is_refused(signed):
    """S plus the group's order solves the same equation; it must not pass as another file."""
    data, signature, public_key = signed
    number = int.from_bytes(signature[32:], "little") + GROUP_ORDER
    assert not is_accepted(data, signature[:32] + number.to_bytes(32, "little"), public_key)


def test_bytes_more_less_or_elsewhere_are_refused(signed):
    data, signature, public_key = signed
    half = len(data) // 2
    for other in (b"", data[:-1], data[1:], data + b"\0", b"\0" + data, data[half:] + data[:half]):
        assert not is_accepted(other, signature, public_key)


def test_the_kept_policy_in_all_its_regions():
    """Two megabytes: every byte at both ends (header, manifest), the weights in between drawn."""
    data = (POLICIES / "left_turn.onnx").read_bytes()
    signature = (POLICIES / "left_turn.onnx.sig").read_bytes()
    public_key = (POLICIES / "policy.pub").read_bytes()
    assert is_accepted(data, signature, public_key)
    draw = random.Random(2)
    stride = len(data) // 50
    places = {*range(40), *range(len(data) - 40, len(data))}
    places |= {start + draw.randrange(stride) for start in range(0, len(data) - stride, stride)}
    for place in sorted(places):
        assert not is_accepted(changed(data, place, 1 << draw.randrange(8)), signature, public_key)


@pytest.mark.parametrize("region", ["graph", "manifest", "signature"])
def test_the_check_command_refuses_it(make_policy, region):
    signed = make_policy()
    path = Path(f"{signed.path}.sig") if region == "signature" else signed.path
    data = path.read_bytes()
    place = {"graph": 12, "manifest": data.find(b"algorithm"), "signature": 40}[region]
    assert place >= 0
    path.write_bytes(changed(data, place, 1))
    result = run_command("check", str(signed.path), "--public-key", str(signed.public_key))
    assert (result.returncode, result.stdout) == (2, "")
    assert "the file was changed" in result.stderr
    assert result.stderr.count("\n") == 1
