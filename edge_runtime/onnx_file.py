"""Reads from an ONNX file what must be known before it is trusted, without the onnx package.

Field numbers are those of onnx.proto (ONNX 1.12 and later; they never change). Pure: bytes in,
OnnxFile out; bytes that are no ONNX model raise UserError.
"""

from __future__ import annotations

from typing import Dict, FrozenSet, Iterator, List, NamedTuple, Optional, Tuple, Union

from edge_runtime.errors import UserError
from edge_runtime.protobuf import Fields, ProtobufError, parse_fields

UINT8 = 2
FLOAT32 = 1

Dim = Union[int, str, None]


class _Kind(NamedTuple):
    """One kind of message: the fields that it may have, and what some of the others would hold."""

    known: FrozenSet[int]
    refused: Dict[int, str]


# A field that is not listed could keep weights where nobody looks, or in a file that nobody has
# signed; onnxruntime would take them.
_SPARSE, _OUTSIDE = "sparse weights", "weights in another file (export it in one file)"
_MODEL = _Kind(
    frozenset((1, 2, 3, 4, 5, 6, 7, 8, 14)), {20: "graphs for training", 25: "functions of its own"}
)
_GRAPH = _Kind(frozenset((1, 2, 5, 10, 11, 12, 13, 14, 16)), {15: _SPARSE})
_NODE = _Kind(frozenset((1, 2, 3, 4, 5, 6, 7, 8, 9)), {})
_ATTRIBUTE = _Kind(
    frozenset((1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 14, 15, 20)), {22: _SPARSE, 23: _SPARSE}
)
_TENSOR = _Kind(frozenset((1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16)), {13: _OUTSIDE})


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
    inputs: List[TensorInfo]
    outputs: List[TensorInfo]


def read_onnx(data: bytes) -> OnnxFile:
    """Parse the bytes of a whole ONNX file.

    Raises UserError for truncated or foreign bytes, and for weights anywhere but in plain tensors
    inside the file.
    """
    try:
        return _read_model(parse_fields(data))
    except ProtobufError as error:
        raise UserError(f"not a whole ONNX file: {error}") from None


def _read_model(model: Fields) -> OnnxFile:
    graphs = list(model.messages(7))
    # A protobuf library would merge two graphs into one that was not looked at here.
    if len(graphs) != 1 or not model.has(1):
        raise ProtobufError(f"it holds {len(graphs)} graphs, not one")
    graph = graphs[0]
    _check_fields(model, _MODEL)
    _check_graph(graph)
    weight_names = {tensor.text(8) for tensor in graph.messages(5)}
    return OnnxFile(
        ir_version=model.integer(1),
        opset=_default_opset(model),
        metadata={entry.text(1): entry.text(2) for entry in model.messages(14)},
        # Before IR 4 the weights were listed among the inputs, too.
        inputs=[i for i in _infos(graph, 11) if i.name not in weight_names],
        outputs=list(_infos(graph, 12)),
    )


def _default_opset(model: Fields) -> int:
    versions = [entry.integer(2) for entry in model.messages(8) if entry.text(1) in ("", "ai.onnx")]
    if not versions:
        raise ProtobufError("it names no operator set")
    return max(versions)


def _check_graph(graph: Fields) -> None:
    """Raise UserError for what may not be there: in the graph, its nodes and nested graphs."""
    _check_fields(graph, _GRAPH)
    _check_tensors(graph, 5)
    for node in graph.messages(1):
        _check_fields(node, _NODE)
        for attribute in node.messages(5):
            _check_fields(attribute, _ATTRIBUTE)
            _check_tensors(attribute, 5, 10)
            for number in (6, 11):
                for nested in attribute.messages(number):
                    _check_graph(nested)


def _check_tensors(holder: Fields, *numbers: int) -> None:
    for number in numbers:
        for tensor in holder.messages(number):
            _check_fields(tensor, _TENSOR)
            if any(tensor.integers(14)):  # 0 is inside
                raise _holds(_OUTSIDE)


def _check_fields(message: Fields, kind: _Kind) -> None:
    for number in sorted(message.numbers() - kind.known):
        raise _holds(kind.refused.get(number, f"an unknown field {number}"))


def _holds(what: str) -> UserError:
    return UserError(f"the policy file holds {what}, which the runtime does not read")


def _infos(graph: Fields, number: int) -> Iterator[TensorInfo]:
    for info in graph.messages(number):
        tensor_type = info.message(2).message(1)
        dims = tuple(_dim(dim) for dim in tensor_type.message(2).messages(1))
        yield TensorInfo(info.text(1), tensor_type.integer(1), dims)


def _dim(dim: Fields) -> Optional[Union[int, str]]:
    if dim.has(1):
        return dim.integer(1)
    return dim.text(2) or None
