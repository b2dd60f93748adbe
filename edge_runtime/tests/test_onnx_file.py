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
    write_policy(path, "slow")
    return path


def test_it_reads_what_the_onnx_package_wrote(written):
    model = read_onnx(written.read_bytes())
    assert (model.ir_version, model.opset) == (8, 17)
    assert model.inputs == [("frames", UINT8, ("batch", 2, 45, 80))]
    assert model.outputs == [("action", FLOAT32, ("batch", 1))]
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
