"""A policy file before onnxruntime loads it: signed, whole in itself, with a manifest that fits us.

The signature is Ed25519 over the whole file: `POLICY.onnx.sig`, 64 raw bytes; keys are PEM. The
file itself is walked field by field, without the onnx package: whatever could keep weights where
nobody looks is refused. The manifest is JSON in its metadata under MANIFEST_KEY: what the policy
sees, does, and where it comes from. Contract, section 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple, Union

import msgspec

from edge_runtime.util import PathLike, UserError, read_bytes
from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE, MAX_TEXT_CHARS

SIGNATURE_SUFFIX = ".sig"
SIGNATURE_BYTES = 64
DEFAULT_PUBLIC_KEY = Path("keys/policy.pub")

VERIFIED = "verified"
BESIDE = "signed by the key beside it"
UNVERIFIED = "signed, not verified"
UNSIGNED = "unsigned"

MANIFEST_KEY = "phil.manifest"
MANIFEST_SCHEMA = 1
# The runtime must know how to stop each action safely (controller.py), so it takes only these.
ACTION_NAMES = ("pedal", "steering")
FULL_BRAKE = -1.0


class OnnxFile(NamedTuple):
    """What the runtime must know of a model that onnxruntime does not tell."""

    ir_version: int
    opset: int
    metadata: Dict[str, str]


# Field numbers of onnx.proto (ONNX 1.12 and later; they never change), by kind of message: plain
# fields, messages by field, and what is refused by name. A field that is not listed is refused,
# too: it could keep weights where nobody looks, or in a file that nobody has signed.
_SPARSE, _OUTSIDE = "sparse weights", "weights in another file (export it in one file)"
_KINDS: Dict[str, Tuple[Tuple[int, ...], Dict[int, str], Dict[int, str]]] = {
    "model": (
        (1, 2, 3, 4, 5, 6, 8, 14),
        {7: "graph"},
        {20: "graphs for training", 25: "functions of its own"},
    ),
    "graph": ((2, 10, 11, 12, 13, 14, 16), {1: "node", 5: "tensor"}, {15: _SPARSE}),
    "node": ((1, 2, 3, 4, 6, 7, 8, 9), {5: "attribute"}, {}),
    "attribute": (
        (1, 2, 3, 4, 7, 8, 9, 13, 14, 15, 20),
        {5: "tensor", 6: "graph", 10: "tensor", 11: "graph"},
        {22: _SPARSE, 23: _SPARSE},
    ),
    "tensor": ((1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16), {}, {13: _OUTSIDE}),
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
    # Here: reading a manifest alone need not wait for it.
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    try:
        key = load_pem_public_key(public_key_pem)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise UserError("the public key is not a PEM public key") from None
    if not isinstance(key, Ed25519PublicKey):
        raise UserError("the public key is not an Ed25519 key")
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
    that of the working directory. Without it, such a key counts for nothing: a person who
    brings a policy could bring it, too.
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
    if is_beside:
        public_key = beside
    elif public_key is None and DEFAULT_PUBLIC_KEY.exists():
        public_key = DEFAULT_PUBLIC_KEY
    if public_key is None:
        if allow_unsigned:
            return UNVERIFIED
        raise UserError(
            f"no public key to verify {signature_path.name} with: name it with --public-key,"
            f" or put it at {DEFAULT_PUBLIC_KEY}"
        )
    key_pem = read_bytes(public_key, "public key")
    try:
        verify(policy_bytes, signature, key_pem)
    except UserError as error:
        raise UserError(
            f"signature {signature_path}, public key {public_key}: {error};"
            " name the key of its signer with --public-key"
        ) from None
    return BESIDE if is_beside else VERIFIED


def read_onnx(data: bytes) -> OnnxFile:
    """Check the bytes of a whole ONNX file.

    Raises UserError for truncated or foreign bytes, and for weights anywhere but in plain tensors
    inside the file.
    """
    try:
        model = _checked(memoryview(data), "model")
        # A protobuf library would merge two graphs into one that was not looked at here.
        graphs = sum(number == 7 for number, _ in model)
        versions = [value for number, value in model if number == 1 and isinstance(value, int)]
        if graphs != 1 or not versions:
            raise ValueError(f"it holds {graphs} graphs, not one")
        opsets = [dict(_fields(_bytes(value))) for number, value in model if number == 8]
        entries = [dict(_fields(_bytes(value))) for number, value in model if number == 14]
        known = [opset.get(2, 0) for opset in opsets if _text(opset.get(1)) in ("", "ai.onnx")]
        numbers = [value for value in known if isinstance(value, int)]
        if not numbers:
            raise ValueError("it names no operator set")
        metadata = {_text(entry.get(1)): _text(entry.get(2)) for entry in entries}
    except ValueError as error:
        raise UserError(f"not a whole ONNX file: {error}") from None
    return OnnxFile(versions[-1], max(numbers), metadata)


def _checked(message: memoryview, kind: str, depth: int = 0) -> _Fields:
    """The fields of a message, when it and all within it hold nothing that is refused."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"messages nest deeper than {_MAX_DEPTH}")
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
            raise ValueError("a field has number 0")
        if wire_type == _VARINT:
            value, position = _varint(message, position)
            yield number, value
            continue
        if wire_type == _BYTES:
            length, position = _varint(message, position)
        elif wire_type in _FIXED_BYTES:
            length = _FIXED_BYTES[wire_type]
        else:
            raise ValueError(f"unknown wire type {wire_type}")
        if position + length > len(message):
            raise ValueError("it ends within a field")
        yield number, message[position : position + length]
        position += length


def _varint(message: memoryview, position: int) -> Tuple[int, int]:
    """A number and where it ends."""
    result = 0
    for index, byte in enumerate(message[position : position + _MAX_VARINT_BYTES]):
        result |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return result, position + index + 1
    raise ValueError("it ends within a number, or one is longer than 10 bytes")


def _bytes(value: _Value) -> memoryview:
    if isinstance(value, int):
        raise ValueError("a number where bytes were expected")
    return value


def _text(value: Optional[_Value]) -> str:
    return "" if value is None else bytes(_bytes(value)).decode("utf-8")


class Observation(msgspec.Struct, frozen=True, kw_only=True):
    """The network's input. `order` says which frame is the newer one."""

    name: str = "frames"
    shape: List[int] = msgspec.field(default_factory=lambda: list(FRAMES_SHAPE))
    dtype: str = "uint8"
    order: str = "[t-1, t]"


class Action(msgspec.Struct, frozen=True, kw_only=True):
    """One number of the network's output, its physical meaning, unit and range."""

    name: str
    meaning: str
    unit: str
    low: float
    high: float


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """All of it. `training` holds at least seed, episodes, config and source revision.

    `created` is ISO 8601 in UTC. A field that is not listed, like an earlier version's `policy_id`,
    is not looked at.
    """

    scenario: str
    algorithm: str
    observation: Observation
    action: List[Action]
    training: Dict[str, Any]
    created: str
    control_period_s: float = CONTROL_PERIOD_S
    schema: int = MANIFEST_SCHEMA

    @property
    def task(self) -> str:
        """What the policy is for: what it is compared by when it meets a simulator."""
        return task_text(self.scenario, [(row.name, row.low, row.high) for row in self.action])


def task_text(scenario: str, actions: Sequence[Tuple[str, float, float]]) -> str:
    """Scenario, and each action's name, low and high: `left_turn, pedal -1 to 1`."""
    rows = (f"{name} {low:g} to {high:g}" for name, low, high in actions)
    return ", ".join((scenario, *rows))[:MAX_TEXT_CHARS]


def encode_manifest(manifest: Manifest) -> str:
    """The JSON text that goes into the file."""
    return msgspec.json.encode(manifest).decode()


def decode_manifest(text: str) -> Manifest:
    """The manifest of a policy file. Raises UserError where it is none, or none we can drive."""
    try:
        manifest = msgspec.json.decode(text.encode(), type=Manifest)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise UserError(f"the manifest in the policy file is not valid: {error}") from None
    if manifest.schema != MANIFEST_SCHEMA:
        raise UserError(
            f"the manifest has schema {manifest.schema}, this runtime reads {MANIFEST_SCHEMA}"
        )
    if manifest.control_period_s != CONTROL_PERIOD_S:
        raise UserError(
            f"the policy was made for a control period of {manifest.control_period_s} s,"
            f" this runtime runs at {CONTROL_PERIOD_S} s"
        )
    if manifest.observation != Observation():
        raise UserError(
            "the manifest's observation is not the wire's:"
            f" {Observation()} is needed, {manifest.observation} was found"
        )
    names = [action.name for action in manifest.action]
    if not names:
        raise UserError("the manifest names no action")
    if len(set(names)) != len(names):
        raise UserError(f"the manifest names an action twice: {', '.join(names)}")
    for action in manifest.action:
        _check_action(action)
    return manifest


def _check_action(action: Action) -> None:
    name, low, high = action.name, action.low, action.high
    if name not in ACTION_NAMES:
        raise UserError(
            f"the runtime does not know how to stop the action {name!r} safely;"
            f" it knows {', '.join(ACTION_NAMES)}"
        )
    if not -1.0 <= low < high <= 1.0:  # nor is NaN
        raise UserError(f"the range of {name} is {low} to {high}; it must lie in -1 to 1")
    if name == "pedal" and low != FULL_BRAKE:
        raise UserError(
            f"the range of pedal begins at {low}, not {FULL_BRAKE}: it could not brake"
            " fully in a safe stop"
        )
