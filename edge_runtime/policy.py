"""A policy file: signed, whole in itself, with a manifest that fits us; and the network in it.

The signature is Ed25519 over the whole file: `POLICY.onnx.sig`, 64 raw bytes; keys are PEM. Before
onnxruntime loads the file it is walked field by field, without the onnx package: whatever could
keep weights where nobody looks is refused. The manifest is JSON in its metadata under MANIFEST_KEY:
what the policy sees, does, and where it comes from. Contract, section 4.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

import msgspec
import numpy as np

from edge_runtime import log
from edge_runtime.util import DEFAULT_PUBLIC_KEY, PathLike, UserError, read_bytes
from edge_runtime.wire import CONTROL_PERIOD_S, FRAMES_SHAPE, MAX_TEXT_CHARS

if TYPE_CHECKING:  # `deploy` and an operator's commands need no onnxruntime.
    import onnxruntime

SIGNATURE_SUFFIX = ".sig"

VERIFIED = "verified"
BESIDE = "signed by the key beside it"
UNVERIFIED = "signed, not verified"
UNSIGNED = "unsigned"

MANIFEST_KEY = "phil.manifest"
MANIFEST_SCHEMA = 1
# The runtime must know how to stop each action safely (controller.py), so it takes only these.
ACTION_NAMES = ("pedal", "steering")
FULL_BRAKE = -1.0

OPSET = 17
MAX_IR_VERSION = 8
INPUT, OUTPUT = "frames", "action"
_RANGE_TOLERANCE = 1e-5


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
    schema, period_s = manifest.schema, manifest.control_period_s
    if schema != MANIFEST_SCHEMA:
        raise UserError(f"the manifest has schema {schema}, this runtime reads {MANIFEST_SCHEMA}")
    if period_s != CONTROL_PERIOD_S:
        raise UserError(f"its control period is {period_s} s, this runtime's {CONTROL_PERIOD_S} s")
    if manifest.observation != Observation():
        found = f"{Observation()} is needed, {manifest.observation} was found"
        raise UserError(f"the manifest's observation is not the wire's: {found}")
    names = [action.name for action in manifest.action]
    if not names or len(set(names)) != len(names):
        found = f"an action twice: {', '.join(names)}" if names else "no action"
        raise UserError(f"the manifest names {found}")
    for name, low, high in ((action.name, action.low, action.high) for action in manifest.action):
        if name not in ACTION_NAMES:
            known = " and ".join(ACTION_NAMES)
            raise UserError(f"the runtime does not know how to stop {name!r} safely, only {known}")
        if not -1.0 <= low < high <= 1.0:  # nor is NaN
            raise UserError(f"the range of {name} is {low} to {high}; it must lie in -1 to 1")
        if name == "pedal" and low != FULL_BRAKE:
            raise UserError(f"its pedal begins at {low}: it could not brake fully in a safe stop")
    return manifest


class Policy(NamedTuple):
    """A network that may drive, as `load_policy` makes it."""

    session: onnxruntime.InferenceSession
    manifest: Manifest
    trust: str
    policy_id: str

    def act(self, frames: np.ndarray) -> np.ndarray:
        """The action, float32 [n], for frames uint8 [2, 45, 80]. It may hold NaN: check it.

        Raises UserError for another type or shape, which can depend on the picture, and whatever
        onnxruntime raises.
        """
        answer: np.ndarray = self.session.run([OUTPUT], {INPUT: frames[np.newaxis]})[0]
        if answer.dtype != np.float32 or answer.shape != (1, len(self.manifest.action)):
            raise UserError(f"the policy answers with {answer.dtype} {list(answer.shape)}")
        return answer[0]


def load_policy(
    path: PathLike, public_key: Optional[PathLike] = None, allow_unsigned: bool = False
) -> Policy:
    """Load a policy that may drive: trusted, whole, its manifest and graph of one mind, probed.

    `public_key` is a PEM file; without it `keys/policy.pub` is taken where it exists, and with
    `allow_unsigned` before it a `policy.pub` beside the policy.
    Raises UserError with the first reason why the policy may not drive.
    """
    # Read once: what is verified is what is loaded, even if the file is replaced meanwhile.
    data = read_bytes(path, "policy file")
    trust = check_trust(path, data, public_key, allow_unsigned)
    try:
        ir_version, opset, metadata = read_onnx(data)
        if opset != OPSET or ir_version > MAX_IR_VERSION:
            needs = f"it needs opset {OPSET} and at most IR version {MAX_IR_VERSION}"
            raise UserError(f"it has opset {opset} and IR version {ir_version}; {needs}")
        if MANIFEST_KEY not in metadata:
            raise UserError(f"it holds no manifest (metadata {MANIFEST_KEY}); export it again")
        manifest = decode_manifest(metadata[MANIFEST_KEY])
        session = _open(data)
        _check_tensor("input", session.get_inputs(), INPUT, "tensor(uint8)", FRAMES_SHAPE)
        actions = (len(manifest.action),)
        _check_tensor("output", session.get_outputs(), OUTPUT, "tensor(float)", actions)
        policy = Policy(session, manifest, trust, policy_id_of(data))
        _probe(policy)
    except UserError as error:
        raise UserError(f"policy {Path(path)} may not drive: {error}") from None
    return policy


def policy_id_of(data: bytes) -> str:
    """The name of a policy: SHA-256 of its whole file, in hex. Two that act differently differ."""
    return hashlib.sha256(data).hexdigest()


def _check_tensor(what: str, found: List, name: str, kind: str, shape: Sequence[int]) -> None:
    """Raise UserError unless it is one tensor like this behind a batch that is 1 or open."""
    fits = (
        len(found) == 1
        and (found[0].name, found[0].type) == (name, kind)
        and list(found[0].shape[1:]) == list(shape)
        and (found[0].shape[0] == 1 or not isinstance(found[0].shape[0], int))
    )
    if not fits:
        shown = ", ".join(f"{each.name} {each.type} {each.shape}" for each in found)
        dims = ", ".join(map(str, shape))
        raise UserError(
            f"its {what} must be {name} {kind} [batch, {dims}], it is {shown or 'none'}"
        )


def _open(data: bytes) -> onnxruntime.InferenceSession:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # One thread: so small a network gains nothing from more, and the board has other work.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Read as what was checked: bytes can be an ONNX file and one of onnxruntime's own format.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        # It prints "EP Error" on stdout for some broken files; stdout belongs to our reports.
        with contextlib.redirect_stdout(io.StringIO()):
            return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no narrower base
        raise UserError(f"onnxruntime does not load it: {error}") from None


def probe_frames() -> Iterator[np.ndarray]:
    """The pictures every policy must answer before it drives: black, grey, and seeded noise."""
    yield np.full(FRAMES_SHAPE, 0, dtype=np.uint8)
    yield np.full(FRAMES_SHAPE, 128, dtype=np.uint8)
    yield np.random.RandomState(0).randint(0, 256, FRAMES_SHAPE).astype(np.uint8)


def _probe(policy: Policy) -> None:
    """Warm it up, too. Raises UserError for an unfit answer."""
    for frames in probe_frames():
        try:
            action = policy.act(frames)
        except Exception as error:  # as in _open
            raise UserError(f"onnxruntime does not run it: {error}") from None
        words = "it answers a probe picture with"
        if not np.all(np.isfinite(action)):
            raise UserError(f"{words} {action.tolist()}, not finite")
        for row, value in zip(policy.manifest.action, action.tolist()):
            if not row.low - _RANGE_TOLERANCE <= value <= row.high + _RANGE_TOLERANCE:
                outside = f"outside its manifest's {row.low} to {row.high}"
                raise UserError(f"{words} {row.name} {value:.3f}, {outside}")
    for _ in range(10):
        policy.act(frames)


def infer(policy: Policy, frames: np.ndarray) -> Tuple[Optional[np.ndarray], int]:
    """The action, float32 [n], for frames uint8 [2, 45, 80], and how long it took in nanoseconds.

    Where the policy raises, the answer is None.
    """
    begun_ns = time.perf_counter_ns()
    output: Optional[np.ndarray] = None
    try:
        output = policy.act(frames)
    except Exception as error:  # as in _open
        log.event("error", "inference_failed", detail=error)
    return output, time.perf_counter_ns() - begun_ns


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
    if len(signature) != 64:
        raise UserError(f"the signature holds {len(signature)} bytes, not 64")
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
        help_ = f"{signature_path.name} is missing; sign it, or allow it with --allow-unsigned"
        raise UserError(f"policy {path} is not signed: {help_}")
    signature = read_bytes(signature_path, "signature")
    trust, beside = VERIFIED, Path(path).with_name(DEFAULT_PUBLIC_KEY.name)
    if public_key is None and allow_unsigned and beside.exists():
        public_key, trust = beside, BESIDE
    elif public_key is None and DEFAULT_PUBLIC_KEY.exists():
        public_key = DEFAULT_PUBLIC_KEY
    if public_key is None:
        if allow_unsigned:
            return UNVERIFIED
        help_ = f"name it with --public-key, or put it at {DEFAULT_PUBLIC_KEY}"
        raise UserError(f"no public key to verify {signature_path.name} with: {help_}")
    key_pem = read_bytes(public_key, "public key")
    try:
        verify(policy_bytes, signature, key_pem)
    except UserError as error:
        raise UserError(
            f"signature {signature_path}, public key {public_key}: {error};"
            " name the key of its signer with --public-key"
        ) from None
    return trust


# Field numbers of onnx.proto (ONNX 1.12 and later; they never change), by kind of message: plain
# fields, messages by field, and what is refused by name. Any other field is refused, too: it could
# keep weights where nobody looks, or in a file that nobody has signed.
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
_MAX_DEPTH = 64  # a policy nests its graphs two or three deep; Python's stack would end soon after


def read_onnx(data: bytes) -> Tuple[int, int, Dict[str, str]]:
    """IR version, operator set and metadata of a whole ONNX file: onnxruntime does not tell them.

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
        known = [opset.get(2, 0) for opset in opsets if _text(opset.get(1)) in ("", "ai.onnx")]
        numbers = [value for value in known if isinstance(value, int)]
        if not numbers:
            raise ValueError("it names no operator set")
        entries = [dict(_fields(_bytes(value))) for number, value in model if number == 14]
        metadata = {_text(entry.get(1)): _text(entry.get(2)) for entry in entries}
    except ValueError as error:
        raise UserError(f"not a whole ONNX file: {error}") from None
    return versions[-1], max(numbers), metadata


def _checked(message: memoryview, kind: str, depth: int = 0) -> List[Tuple[int, Any]]:
    """The fields of a message, when it and all within it hold nothing that is refused."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"messages nest deeper than {_MAX_DEPTH}")
    plain, nested, refused = _KINDS[kind]
    fields = list(_fields(message))
    for number, value in fields:
        what = ""
        if number in nested:
            _checked(_bytes(value), nested[number], depth + 1)
        elif number not in plain:
            what = refused.get(number, f"an unknown field {number}")
        elif (kind, number) == ("tensor", 14) and value != 0:  # data_location; 0 is inside
            what = _OUTSIDE
        if what:
            raise UserError(f"the policy file holds {what}, which the runtime does not read")
    return fields


def _fields(message: memoryview) -> Iterator[Tuple[int, Any]]:
    """Number and value (int or memoryview) of each field.

    See https://protobuf.dev/programming-guides/encoding/.
    """
    position = 0
    while position < len(message):
        tag, position = _varint(message, position)
        number, wire_type = tag >> 3, tag & 7
        if number == 0:
            raise ValueError("a field has number 0")
        if wire_type == 0:  # a number
            value, position = _varint(message, position)
            yield number, value
            continue
        if wire_type == 2:  # bytes
            length, position = _varint(message, position)
        elif wire_type in (1, 5):  # numbers of 64 and 32 bits
            length = 8 if wire_type == 1 else 4
        else:
            raise ValueError(f"unknown wire type {wire_type}")
        if position + length > len(message):
            raise ValueError("it ends within a field")
        yield number, message[position : position + length]
        position += length


def _varint(message: memoryview, position: int) -> Tuple[int, int]:
    """A number and where it ends."""
    result = 0
    for index, byte in enumerate(message[position : position + 10]):
        result |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return result, position + index + 1
    raise ValueError("it ends within a number, or one is longer than 10 bytes")


def _bytes(value: Any) -> memoryview:
    if isinstance(value, int):
        raise ValueError("a number where bytes were expected")
    return value


def _text(value: Any) -> str:
    return "" if value is None else bytes(_bytes(value)).decode("utf-8")
