"""No byte of a signed policy can change, nor of its signature: every place is tried."""

from __future__ import annotations

import contextlib
import random
from pathlib import Path

import onnx
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from edge_runtime.policy_file import MANIFEST_KEY, decode_manifest, read_onnx, verify
from edge_runtime.tests.harness import run_command
from edge_runtime.tests.policies import public_pem, write_policy
from edge_runtime.util import UserError


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "slow.onnx"
    write_policy(path, "slow")
    return path


def test_it_reads_what_the_onnx_package_wrote(written):
    model = read_onnx(written.read_bytes())
    assert (model.ir_version, model.opset) == (8, 17)
    assert decode_manifest(model.metadata[MANIFEST_KEY]).scenario == "left_turn"


def refused_or_without_manifest(data: bytes) -> bool:
    try:
        return MANIFEST_KEY not in read_onnx(data).metadata
    except UserError:
        return True


def test_every_truncation_is_refused(written):
    """A cut between two fields can leave a whole model, but then the manifest is gone."""
    data = written.read_bytes()
    assert not refused_or_without_manifest(data)
    for length in range(len(data)):
        assert refused_or_without_manifest(data[:length]), length


@given(st.binary(max_size=200))
def test_foreign_bytes_raise_only_user_errors(data):
    assert refused_or_without_manifest(data)


@settings(deadline=None)
@given(st.data())
def test_damaged_bytes_raise_only_user_errors(written, data):
    damaged = bytearray(written.read_bytes())
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(UserError):
        read_onnx(bytes(damaged))


def test_two_graphs_are_refused(written):
    """A protobuf library merges them into one that was not looked at."""
    data = written.read_bytes()
    with pytest.raises(UserError, match="2 graphs"):
        read_onnx(data + data)


def outside(tensor):
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../elsewhere.bin")
    return tensor


def weight():
    return helper.make_tensor("w", TensorProto.FLOAT, [1], [1.0])


def sparse_weight():
    return helper.make_sparse_tensor(
        outside(helper.make_tensor("w", TensorProto.FLOAT, [1], [1.0])),
        helper.make_tensor("places", TensorProto.INT64, [1], [0]),
        [2],
    )


def loop_body(model):
    """The graph that stands inside of another one's attribute."""
    (loop,) = (node for node in model.graph.node if node.op_type == "Loop")
    return loop.attribute[0].g


def constant(**value):
    return helper.make_node("Constant", [], ["c"], **value)


HIDDEN = {
    "in an initializer": (lambda m: outside(m.graph.initializer[0]), "another file"),
    "in an initializer that says so and names no file": (
        lambda m: setattr(m.graph.initializer[0], "data_location", TensorProto.EXTERNAL),
        "another file",
    ),
    "in a constant": (
        lambda m: m.graph.node.append(constant(value=outside(weight()))), "another file",
    ),
    "in a nested graph": (
        lambda m: loop_body(m).initializer.append(outside(weight())), "another file",
    ),
    "in a constant of a nested graph": (
        lambda m: loop_body(m).node.append(constant(value=outside(weight()))), "another file",
    ),
    "in a sparse initializer": (
        lambda m: m.graph.sparse_initializer.append(sparse_weight()), "sparse weights",
    ),
    "in a sparse initializer of a nested graph": (
        lambda m: loop_body(m).sparse_initializer.append(sparse_weight()), "sparse weights",
    ),
    "in a sparse constant": (
        lambda m: m.graph.node.append(constant(sparse_value=sparse_weight())), "sparse weights",
    ),
    "in a list of sparse tensors": (
        lambda m: m.graph.node.append(constant(values=[sparse_weight()])), "sparse weights",
    ),
    "in a function of the model": (
        lambda m: m.functions.append(
            helper.make_function(
                "mine", "f", [], ["c"], [constant(value=outside(weight()))],
                [helper.make_opsetid("", 17)],
            )
        ),
        "functions of its own",
    ),
    "in a graph for training": (
        lambda m: m.training_info.add().algorithm.initializer.append(outside(weight())),
        "graphs for training",
    ),
}  # fmt: skip


@pytest.mark.parametrize("place", HIDDEN)
def test_weights_that_may_lie_outside_the_file_are_refused(written, place):
    hide, what = HIDDEN[place]
    model = onnx.load(str(written))
    hide(model)
    with pytest.raises(UserError, match=what):
        read_onnx(model.SerializeToString())


def test_weights_that_say_they_are_inside_are_read(written):
    model = onnx.load(str(written))
    model.graph.initializer[0].data_location = TensorProto.DEFAULT
    assert read_onnx(model.SerializeToString()).opset == 17


def test_a_field_whose_number_protobuf_would_cut_to_a_known_one_is_refused(written):
    """Protobuf takes 32 bits of a tag: there this is field 25, the model's functions."""
    tag = (1 << 32) + (25 << 3) + 2
    data = bytes([tag >> 7 * i & 127 | (128 if i < 4 else 0) for i in range(5)]) + b"\0"
    with pytest.raises(UserError, match="unknown field"):
        read_onnx(written.read_bytes() + data)


def test_a_graph_that_is_a_number_is_refused(written):
    with pytest.raises(UserError, match="a number where bytes were expected"):
        read_onnx(written.read_bytes() + b"\x38\x01")  # field 7, a varint


def test_a_model_without_an_operator_set_is_refused(written):
    model = onnx.load(str(written))
    model.ClearField("opset_import")
    with pytest.raises(UserError, match="names no operator set"):
        read_onnx(model.SerializeToString())


def test_endless_nesting_ends():
    data = b""
    for _ in range(300):
        node = b"\x0a" + _length(data) + data  # graph.node
        data = node
    refused_or_without_manifest(b"\x08\x08\x3a" + _length(data) + data)


def _length(data: bytes) -> bytes:
    size, out = len(data), b""
    while size > 127:
        out += bytes([size & 127 | 128])
        size >>= 7
    return out + bytes([size])


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
