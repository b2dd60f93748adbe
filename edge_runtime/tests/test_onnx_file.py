from __future__ import annotations

import contextlib

import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from edge_runtime.errors import UserError
from edge_runtime.manifest import MANIFEST_KEY, decode_manifest
from edge_runtime.onnx_file import FLOAT32, UINT8, read_onnx
from edge_runtime.tests.policies import write_policy


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "slow.onnx"
    policy_id = write_policy(path, "nan")
    return path, policy_id


def test_it_reads_what_the_onnx_package_wrote(written):
    path, policy_id = written
    model = read_onnx(path.read_bytes())
    assert (model.ir_version, model.opset) == (8, 17)
    assert model.weights_sha256 == policy_id
    assert model.inputs == [("frames", UINT8, ("batch", 2, 45, 80))]
    assert model.outputs == [("action", FLOAT32, ("batch", 1))]
    assert decode_manifest(model.metadata[MANIFEST_KEY]).policy_id == policy_id


def refused_or_without_manifest(data: bytes) -> bool:
    try:
        return MANIFEST_KEY not in read_onnx(data).metadata
    except UserError:
        return True


def test_every_truncation_is_refused(written):
    """A cut between two fields can leave a whole model, but then the manifest is gone."""
    data = written[0].read_bytes()
    assert not refused_or_without_manifest(data)
    for length in range(len(data)):
        assert refused_or_without_manifest(data[:length]), length


@given(st.binary(max_size=200))
def test_foreign_bytes_raise_only_user_errors(data):
    assert refused_or_without_manifest(data)


@settings(deadline=None)
@given(st.data())
def test_damaged_bytes_raise_only_user_errors(written, data):
    damaged = bytearray(written[0].read_bytes())
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(UserError):
        read_onnx(bytes(damaged))


def test_a_changed_weight_changes_the_digest(written):
    path, policy_id = written
    model = onnx.load(str(path))
    raw = bytearray(model.graph.initializer[0].raw_data)
    raw[0] ^= 1
    model.graph.initializer[0].raw_data = bytes(raw)
    assert read_onnx(model.SerializeToString()).weights_sha256 != policy_id


def test_two_graphs_are_refused(written):
    """A protobuf library merges them: weights would join that the digest never saw."""
    data = written[0].read_bytes()
    with pytest.raises(UserError, match="2 graphs"):
        read_onnx(data + data)


def test_weights_outside_the_file_are_refused(written):
    model = onnx.load(str(written[0]))
    tensor = model.graph.initializer[0]
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="elsewhere.bin")
    with pytest.raises(UserError, match="another file"):
        read_onnx(model.SerializeToString())


def test_weights_that_the_digest_cannot_cover_are_refused(written):
    model = onnx.load(str(written[0]))
    model.graph.initializer.append(helper.make_tensor("w", TensorProto.FLOAT, [1], [1.0]))
    with pytest.raises(UserError, match="raw data"):
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
