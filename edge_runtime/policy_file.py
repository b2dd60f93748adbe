"""Ed25519 over the whole policy file: who made it, and that nothing changed since.

The signature is `POLICY.onnx.sig`, 64 raw bytes; keys are PEM. Contract, section 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Dict, FrozenSet, Iterator, List, NamedTuple, Optional, Set, Tuple, Union

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_public_key

from edge_runtime.util import PathLike, UserError, read_bytes

SIGNATURE_SUFFIX = ".sig"
SIGNATURE_BYTES = 64
DEFAULT_PUBLIC_KEY = Path("keys/policy.pub")

VERIFIED = "verified"
BESIDE = "signed by the key beside it"
UNVERIFIED = "signed, not verified"
UNSIGNED = "unsigned"


def verify(policy_bytes: bytes, signature: bytes, public_key_pem: bytes) -> None:
    """Raise UserError unless `signature` is the key owner's over exactly these bytes."""
    key = _load_key(public_key_pem)
    if len(signature) != SIGNATURE_BYTES:
        raise UserError(f"the signature holds {len(signature)} bytes, not {SIGNATURE_BYTES}")
    try:
        key.verify(signature, policy_bytes)
    except InvalidSignature:
        raise UserError(
            "the signature does not fit the policy file and public key:"
            " the file was changed, or another key signed it"
        ) from None


def check_trust(
    path: PathLike, policy_bytes: bytes, public_key: Optional[PathLike], allow_unsigned: bool
) -> str:
    """VERIFIED, BESIDE, UNVERIFIED or UNSIGNED for a policy that may drive; UserError for others.

    A signature is always verified where a public key is known; `allow_unsigned` lets through
    only what cannot be verified, never what fails to. With it, a key beside the policy comes before
    that of the working directory. Without it, such a key counts for nothing: who brings a policy
    could bring it, too.
    """
    signature_path = Path(f"{path}{SIGNATURE_SUFFIX}")
    if not signature_path.exists():
        if allow_unsigned:
            return UNSIGNED
        raise UserError(
            f"policy {path} is not signed ({signature_path.name} is missing);"
            " sign it, or allow it with --allow-unsigned"
        )
    signature = read_bytes(signature_path, "signature")
    beside = Path(path).with_name(DEFAULT_PUBLIC_KEY.name)
    is_beside = allow_unsigned and public_key is None and beside.exists()
    key_path = beside if is_beside else _find_public_key(public_key)
    if key_path is not None:
        key_pem = read_bytes(key_path, "public key")
        try:
            verify(policy_bytes, signature, key_pem)
        except UserError as error:
            raise UserError(
                f"signature {signature_path}, public key {key_path}: {error};"
                " name the key of its signer with --public-key"
            ) from None
        return BESIDE if is_beside else VERIFIED
    if allow_unsigned:
        return UNVERIFIED
    raise UserError(
        f"no public key to verify {signature_path.name} with: name it with --public-key,"
        f" or put it at {DEFAULT_PUBLIC_KEY}"
    )


def _find_public_key(public_key: Optional[PathLike]) -> Optional[PathLike]:
    if public_key is not None:
        return public_key
    return DEFAULT_PUBLIC_KEY if DEFAULT_PUBLIC_KEY.exists() else None


def _load_key(public_key_pem: bytes) -> Ed25519PublicKey:
    try:
        key = load_pem_public_key(public_key_pem)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise UserError("the public key is not a PEM public key") from None
    if not isinstance(key, Ed25519PublicKey):
        raise UserError("the public key is not an Ed25519 key")
    return key


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


_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_VARINT_BYTES = 10
# Python would run out of stack first; a policy nests its graphs two or three deep.
_MAX_DEPTH = 64

Value = Union[int, memoryview]


class ProtobufError(Exception):
    """The bytes are not the message that was expected."""


class Fields:
    """The fields of one message by number; a field that is absent reads as protobuf's default."""

    def __init__(self, values: Dict[int, List[Value]], depth: int) -> None:
        self._values = values
        self._depth = depth

    def has(self, number: int) -> bool:
        """Whether the field is there at all."""
        return number in self._values

    def numbers(self) -> Set[int]:
        """Those of all fields that are there."""
        return set(self._values)

    def integer(self, number: int) -> int:
        """The last value of an integer field, as protobuf defines it; 0 where absent."""
        values = self.integers(number)
        return values[-1] if values else 0

    def integers(self, number: int) -> List[int]:
        """All values of a repeated integer field, packed or not."""
        found: List[int] = []
        for value in self._values.get(number, []):
            if isinstance(value, int):
                found.append(value)
            else:
                found.extend(_unpack(value))
        return found

    def blob(self, number: int) -> bytes:
        """The last value of a bytes field; empty where absent."""
        values = self._values.get(number)
        if not values:
            return b""
        return bytes(_as_bytes(number, values[-1]))

    def text(self, number: int) -> str:
        """The last value of a string field; empty where absent."""
        try:
            return self.blob(number).decode("utf-8")
        except UnicodeDecodeError:
            raise ProtobufError(f"field {number} is not UTF-8 text") from None

    def messages(self, number: int) -> Iterator[Fields]:
        """The nested messages of a repeated field."""
        for value in self._values.get(number, []):
            yield parse_fields(_as_bytes(number, value), self._depth + 1)

    def message(self, number: int) -> Fields:
        """The nested message of a field; an empty one where absent."""
        return next(iter(self.messages(number)), Fields({}, self._depth + 1))


def parse_fields(data: Union[bytes, memoryview], depth: int = 0) -> Fields:
    """Split one message into its fields; nested messages stay bytes until they are asked for.

    Raises ProtobufError when the bytes end within a field or are no protobuf.
    """
    if depth > _MAX_DEPTH:
        raise ProtobufError(f"messages nest deeper than {_MAX_DEPTH}")
    view = memoryview(data)
    values: Dict[int, List[Value]] = {}
    position = 0
    while position < len(view):
        tag, position = _varint(view, position)
        number, kind = tag >> 3, tag & 7
        if number == 0:
            raise ProtobufError("a field has number 0")
        value, position = _value(view, position, kind)
        values.setdefault(number, []).append(value)
    return Fields(values, depth)


def _value(view: memoryview, position: int, kind: int) -> Tuple[Value, int]:
    if kind == _VARINT:
        return _varint(view, position)
    if kind == _BYTES:
        length, position = _varint(view, position)
    elif kind in (_FIXED32, _FIXED64):
        length = 4 if kind == _FIXED32 else 8
    else:
        raise ProtobufError(f"unknown wire type {kind}")
    end = position + length
    if end > len(view):
        raise ProtobufError("it ends within a field")
    return view[position:end], end


def _varint(view: memoryview, position: int) -> Tuple[int, int]:
    result = 0
    for index in range(_MAX_VARINT_BYTES):
        if position + index >= len(view):
            raise ProtobufError("it ends within a number")
        byte = view[position + index]
        result |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return result, position + index + 1
    raise ProtobufError("a number is longer than 10 bytes")


def _unpack(view: memoryview) -> Iterator[int]:
    position = 0
    while position < len(view):
        value, position = _varint(view, position)
        yield value


def _as_bytes(number: int, value: Value) -> memoryview:
    if isinstance(value, int):
        raise ProtobufError(f"field {number} is a number where bytes were expected")
    return value
