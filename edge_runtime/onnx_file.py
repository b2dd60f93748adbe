"""Reads from an ONNX file what must be known before it is trusted, without the onnx package.

Field numbers are those of onnx.proto (ONNX 1.12 and later; they never change). Pure: bytes in,
OnnxFile out; bytes that are no ONNX model raise UserError.
"""

from __future__ import annotations

import hashlib
from typing import Dict, Iterator, List, NamedTuple, Optional, Tuple, Union

from edge_runtime.errors import UserError
from edge_runtime.protobuf import Fields, ProtobufError, parse_fields

UINT8 = 2
FLOAT32 = 1
_EXTERNAL = 1

Dim = Union[int, str, None]


class TensorInfo(NamedTuple):
    """An input or output of the graph. A dimension is a number, a name, or unknown (None)."""

    name: str
    element_type: int
    dims: Tuple[Dim, ...]


class OnnxFile(NamedTuple):
    """The parts of a model that the runtime checks."""

    ir_version: int
    opset: int
    metadata: Dict[str, str]
    weights_sha256: str
    inputs: List[TensorInfo]
    outputs: List[TensorInfo]


def read_onnx(data: bytes) -> OnnxFile:
    """Parse the bytes of a whole ONNX file.

    Raises UserError for truncated or foreign bytes, weights outside the file, and weights that
    are not stored as raw bytes (the digest would not cover them).
    """
    try:
        return _read_model(parse_fields(data))
    except ProtobufError as error:
        raise UserError(f"not a whole ONNX file: {error}") from None


def _read_model(model: Fields) -> OnnxFile:
    graphs = list(model.messages(7))
    # A protobuf library would merge two graphs into one whose weights this digest has not seen.
    if len(graphs) != 1 or not model.has(1):
        raise ProtobufError(f"it holds {len(graphs)} graphs, not one")
    graph = graphs[0]
    initializers = list(graph.messages(5))
    if graph.has(15):
        raise UserError("the policy file holds sparse weights, which the runtime does not read")
    for tensor in _tensors(graph):
        if tensor.integer(14) == _EXTERNAL or tensor.has(13):
            raise UserError("the policy file keeps weights in another file; export it in one file")
    weight_names = {tensor.text(8) for tensor in initializers}
    return OnnxFile(
        ir_version=model.integer(1),
        opset=_default_opset(model),
        metadata={entry.text(1): entry.text(2) for entry in model.messages(14)},
        weights_sha256=_digest(initializers),
        # Before IR 4 the weights were listed among the inputs, too.
        inputs=[i for i in _infos(graph, 11) if i.name not in weight_names],
        outputs=list(_infos(graph, 12)),
    )


def _default_opset(model: Fields) -> int:
    versions = [entry.integer(2) for entry in model.messages(8) if entry.text(1) in ("", "ai.onnx")]
    if not versions:
        raise ProtobufError("it names no operator set")
    return max(versions)


def _digest(initializers: List[Fields]) -> str:
    """SHA-256 over the weights sorted by name: name in UTF-8, NUL, raw bytes."""
    digest = hashlib.sha256()
    for tensor in sorted(initializers, key=lambda t: t.text(8)):
        if not tensor.has(9) and 0 not in tensor.integers(1):
            raise UserError(f"weight {tensor.text(8)!r} of the policy is not stored as raw data")
        digest.update(tensor.text(8).encode() + b"\0" + tensor.blob(9))
    return digest.hexdigest()


def _tensors(graph: Fields) -> Iterator[Fields]:
    """Every tensor of a graph: weights, constants in nodes, and those of nested graphs."""
    yield from graph.messages(5)
    for node in graph.messages(1):
        for attribute in node.messages(5):
            yield from attribute.messages(5)
            yield from attribute.messages(10)
            for number in (6, 11):
                for nested in attribute.messages(number):
                    yield from _tensors(nested)


def _infos(graph: Fields, number: int) -> Iterator[TensorInfo]:
    for info in graph.messages(number):
        tensor_type = info.message(2).message(1)
        dims = tuple(_dim(dim) for dim in tensor_type.message(2).messages(1))
        yield TensorInfo(info.text(1), tensor_type.integer(1), dims)


def _dim(dim: Fields) -> Optional[Union[int, str]]:
    if dim.has(1):
        return dim.integer(1)
    return dim.text(2) or None
