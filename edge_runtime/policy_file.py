"""What a policy file must be before onnxruntime loads it: signed, and whole in itself.

The signature is Ed25519 over the whole file: `POLICY.onnx.sig`, 64 raw bytes; keys are PEM. The
file itself is walked field by field, without the onnx package: whatever could keep weights where
nobody looks is refused. Pure but for the files of the signature. Contract, section 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Dict, Iterator, List, NamedTuple, Optional, Tuple, Union

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


class OnnxFile(NamedTuple):
    """What the runtime must know of a model that onnxruntime does not tell."""

    ir_version: int
    opset: int
    metadata: Dict[str, str]


class ProtobufError(Exception):
    """The bytes are not the message that was expected."""


class _Kind(NamedTuple):
    """One kind of message: its plain fields, its messages by field, and what is refused by name."""

    plain: Tuple[int, ...]
    nested: Dict[int, str]
    refused: Dict[int, str]


# Field numbers of onnx.proto (ONNX 1.12 and later; they never change). A field that is not listed
# could keep weights where nobody looks, or in a file that nobody has signed; onnxruntime would take
# them.
_SPARSE, _OUTSIDE = "sparse weights", "weights in another file (export it in one file)"
_KINDS: Dict[str, _Kind] = {
    "model": _Kind(
        (1, 2, 3, 4, 5, 6, 8, 14),
        {7: "graph"},
        {20: "graphs for training", 25: "functions of its own"},
    ),
    "graph": _Kind((2, 10, 11, 12, 13, 14, 16), {1: "node", 5: "tensor"}, {15: _SPARSE}),
    "node": _Kind((1, 2, 3, 4, 6, 7, 8, 9), {5: "attribute"}, {}),
    "attribute": _Kind(
        (1, 2, 3, 4, 7, 8, 9, 13, 14, 15, 20),
        {5: "tensor", 6: "graph", 10: "tensor", 11: "graph"},
        {22: _SPARSE, 23: _SPARSE},
    ),
    "tensor": _Kind((1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16), {}, {13: _OUTSIDE}),
}
_DATA_LOCATION = 14  # of a tensor: 0 is inside

_VARINT, _BYTES, _FIXED_BYTES = 0, 2, {1: 8, 5: 4}  # wire types
_MAX_VARINT_BYTES = 10
# Python would run out of stack first; a policy nests its graphs two or three deep.
_MAX_DEPTH = 64

_Value = Union[int, memoryview]
_Fields = List[Tuple[int, _Value]]


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


def read_onnx(data: bytes) -> OnnxFile:
    """Check the bytes of a whole ONNX file.

    Raises UserError for truncated or foreign bytes, and for weights anywhere but in plain tensors
    inside the file.
    """
    try:
        return _read_model(_checked(memoryview(data), "model"))
    except ProtobufError as error:
        raise UserError(f"not a whole ONNX file: {error}") from None


def _read_model(fields: _Fields) -> OnnxFile:
    # A protobuf library would merge two graphs into one that was not looked at here.
    graphs = sum(number == 7 for number, _ in fields)
    versions = [value for number, value in fields if number == 1 and isinstance(value, int)]
    if graphs != 1 or not versions:
        raise ProtobufError(f"it holds {graphs} graphs, not one")
    opsets = [dict(_fields(_bytes(value))) for number, value in fields if number == 8]
    entries = [dict(_fields(_bytes(value))) for number, value in fields if number == 14]
    known = [opset.get(2, 0) for opset in opsets if _text(opset.get(1)) in ("", "ai.onnx")]
    numbers = [value for value in known if isinstance(value, int)]
    if not numbers:
        raise ProtobufError("it names no operator set")
    metadata = {_text(entry.get(1)): _text(entry.get(2)) for entry in entries}
    return OnnxFile(versions[-1], max(numbers), metadata)


def _checked(message: memoryview, kind: str, depth: int = 0) -> _Fields:
    """The fields of a message, when it and all within it hold nothing that is refused."""
    if depth > _MAX_DEPTH:
        raise ProtobufError(f"messages nest deeper than {_MAX_DEPTH}")
    plain, nested, refused = _KINDS[kind]
    fields = list(_fields(message))
    for number, value in fields:
        if number in nested:
            _checked(_bytes(value), nested[number], depth + 1)
        elif number not in plain:
            raise _holds(refused.get(number, f"an unknown field {number}"))
        elif kind == "tensor" and number == _DATA_LOCATION and value != 0:
            raise _holds(_OUTSIDE)
    return fields


def _holds(what: str) -> UserError:
    return UserError(f"the policy file holds {what}, which the runtime does not read")


def _fields(message: memoryview) -> Iterator[Tuple[int, _Value]]:
    """Number and value of each field: https://protobuf.dev/programming-guides/encoding/."""
    position = 0
    while position < len(message):
        tag, position = _varint(message, position)
        number, wire_type = tag >> 3, tag & 7
        if number == 0:
            raise ProtobufError("a field has number 0")
        length = _FIXED_BYTES.get(wire_type)
        if wire_type == _VARINT:
            value, position = _varint(message, position)
            yield number, value
            continue
        if wire_type == _BYTES:
            length, position = _varint(message, position)
        if length is None:
            raise ProtobufError(f"unknown wire type {wire_type}")
        if position + length > len(message):
            raise ProtobufError("it ends within a field")
        yield number, message[position : position + length]
        position += length


def _varint(message: memoryview, position: int) -> Tuple[int, int]:
    """A number and where it ends."""
    result = 0
    for index, byte in enumerate(message[position : position + _MAX_VARINT_BYTES]):
        result |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return result, position + index + 1
    raise ProtobufError("it ends within a number, or one is longer than 10 bytes")


def _bytes(value: _Value) -> memoryview:
    if isinstance(value, int):
        raise ProtobufError("a number where bytes were expected")
    return value


def _text(value: Optional[_Value]) -> str:
    try:
        return "" if value is None else bytes(_bytes(value)).decode("utf-8")
    except UnicodeDecodeError:
        raise ProtobufError("a text is not UTF-8") from None
