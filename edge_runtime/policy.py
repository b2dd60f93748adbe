"""A policy file: its signature, its ONNX graph, its manifest, and the network that it holds.

The signature is Ed25519 over the whole file: `POLICY.onnx.sig`, 64 raw bytes; keys are PEM. Before
onnxruntime loads the file it is read field by field, without the onnx package: anything that could
keep weights where nobody looks, or make the run time depend on the observation, is refused. The
manifest (manifest.py) is JSON in its metadata under MANIFEST_KEY. Contract, section 4.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import io
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Iterator, Mapping, NamedTuple, Optional, Sequence

import numpy as np

from edge_runtime import log
from edge_runtime.manifest import MANIFEST_KEY, Layout, Manifest, Task, decode_manifest
from edge_runtime.util import DEFAULT_PUBLIC_KEY, PathLike, UserError, read_bytes

if TYPE_CHECKING:  # `deploy` and an operator's commands need no onnxruntime.
    import onnxruntime

SIGNATURE_SUFFIX = ".sig"

VERIFIED = "verified"
BESIDE = "signed by the key beside it"
UNVERIFIED = "signed, not verified"
UNSIGNED = "unsigned"

OPSETS = range(13, 22)
MAX_IR_VERSION = 10
MAX_POLICY_MIB = 96
"""Loading takes 90 MB and up to 3.9 times the file: that fits phil-edge.service's MemoryMax."""
OUTPUT = "action"
_RANGE_TOLERANCE = 1e-5  # Of an action's whole range: the last bits of a network's tanh


class Policy(NamedTuple):
    """A network that may drive, made by `load_policy`."""

    session: onnxruntime.InferenceSession
    manifest: Manifest
    layout: Layout
    trust: str
    policy_id: str
    public_key: Optional[str] = None  # The file of the key that verified it

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Infer the action, float32 [n], from the arrays of `layout`. It may hold NaN: check it.

        Raises UserError for another type or shape, which can depend on the observation, and
        whatever onnxruntime raises.
        """
        inputs = {name: array[np.newaxis] for name, array in observation.items()}
        with _flushed():
            answer: np.ndarray = self.session.run([OUTPUT], inputs)[0]
        if answer.dtype != np.float32 or answer.shape != (1, len(self.manifest.action)):
            raise UserError(f"the policy answers with {answer.dtype} {list(answer.shape)}")
        return answer[0]


def load_policy(
    path: PathLike, public_key: Optional[PathLike] = None, allow_unsigned: bool = False
) -> Policy:
    """Load a policy that may drive: trusted, whole and probed, with a manifest that fits its graph.

    `public_key` is a PEM file; without it `keys/policy.pub` is taken where it exists, and with
    `allow_unsigned` before it a `policy.pub` beside the policy.
    Raises UserError with the first reason why the policy may not drive.
    """
    # Read once: what is verified is what is loaded, even if the file is replaced meanwhile.
    data = read_bytes(path, "policy file", MAX_POLICY_MIB)
    trust, key_file = check_trust(path, data, public_key, allow_unsigned)
    try:
        return open_policy(data, trust)._replace(public_key=key_file)
    except UserError as error:
        raise UserError(f"policy {Path(path)} may not drive: {error}") from None


def open_policy(data: bytes, trust: str) -> Policy:
    """Check and probe the policy in a file's bytes, without its signature. Raises UserError."""
    metadata = check_graph(data)
    if MANIFEST_KEY not in metadata:
        raise UserError(f"it holds no manifest (metadata {MANIFEST_KEY}); export it again")
    manifest = decode_manifest(metadata[MANIFEST_KEY])
    policy = Policy(open_network(data), manifest, Layout(manifest), trust, policy_id_of(data))
    check_tensors(policy.session, manifest)
    _probe(policy)
    return policy


def check_tensors(session: onnxruntime.InferenceSession, task: Task) -> None:
    """Raise UserError unless the network's inputs and output are the task's."""
    inputs = {each.name: each for each in session.get_inputs()}
    for name, entry in task.observation.items():
        found = [inputs.pop(name)] if name in inputs else session.get_inputs()
        kind = "float" if entry.dtype == "float32" else entry.dtype
        _check_tensor("input", found, name, f"tensor({kind})", entry.shape)
    if inputs:
        raise UserError(f"its input {next(iter(inputs))} is not in the manifest's observation")
    _check_tensor("output", session.get_outputs(), OUTPUT, "tensor(float)", (len(task.action),))


def policy_id_of(data: bytes) -> str:
    """Name a policy: SHA-256 of its whole file, in hex."""
    return hashlib.sha256(data).hexdigest()


def _check_tensor(what: str, found: list, name: str, kind: str, shape: Sequence[int]) -> None:
    """Raise UserError unless one tensor is found, of this kind behind a batch that is 1 or open."""
    shown = [(each.name, each.type, *each.shape[1:]) for each in found]
    batch = found[0].shape[0] if found and found[0].shape else 0
    if shown != [(name, kind, *shape)] or (batch != 1 and isinstance(batch, int)):
        has = ", ".join(f"{each.name} {each.type} {each.shape}" for each in found) or "none"
        raise UserError(f"its {what} must be {name} {kind} {['batch', *shape]}, it is {has}")


def open_network(data: bytes) -> onnxruntime.InferenceSession:
    """Load the network in an ONNX file's bytes, on one thread. Raises UserError."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # One thread: so small a network gains nothing from more, and the board has other work.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Numbers near zero, as of a dark picture, would make a network ten times slower.
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    # The format that was checked: bytes can be an ONNX file and one of onnxruntime's own format.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        # It prints "EP Error" on stdout for some broken files; stdout belongs to our reports.
        with contextlib.redirect_stdout(io.StringIO()), _flushed():
            return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no narrower base
        raise UserError(f"onnxruntime does not load it: {error}") from None


_libc = ctypes.PyDLL(None)
_flushing = ctypes.create_string_buffer(64)  # An fenv_t: how a thread computes
_libc.fegetenv(_flushing)


@contextlib.contextmanager
def _flushed() -> Iterator[None]:
    """Flush numbers near zero in this block only: a process's first session does so for good."""
    before = ctypes.create_string_buffer(64)
    _libc.fegetenv(before)
    _libc.fesetenv(_flushing)
    try:
        yield
    finally:
        _libc.fegetenv(_flushing)
        _libc.fesetenv(before)


def probes(layout: Layout) -> Iterator[dict[str, np.ndarray]]:
    """Make the observations that a policy must answer first: zeros, middling values, seeded noise.

    Bytes over their range, floats from 0 to 1, integers 0 and 1.
    """
    random = np.random.RandomState(0)
    for make in (np.zeros, lambda shape: np.full(shape, 0.5), random.random_sample):
        yield {
            name: np.asarray(make(shape) * {"u": 256, "i": 2}.get(dtype.kind, 1)).astype(dtype)
            for name, dtype, shape, _ in layout.parts
        }


def _probe(policy: Policy) -> None:
    """Warm the network up and check its answers. Raises UserError."""
    for seen in probes(policy.layout):
        try:
            action = policy.act(seen)
        except Exception as error:  # as in open_network
            raise UserError(f"onnxruntime does not run it: {error}") from None
        check_answer(action, policy.manifest, "a probe")
    for _ in range(10):
        policy.act(seen)


def check_answer(action: np.ndarray, task: Task, what: str) -> None:
    """Raise UserError unless the answer to `what` is finite and in the manifest's ranges."""
    words = f"it answers {what} with"
    if not np.all(np.isfinite(action)):
        raise UserError(f"{words} {action.tolist()}, not finite")
    for row, value in zip(task.action, action.tolist()):
        slack = _RANGE_TOLERANCE * (row.high - row.low)
        if not row.low - slack <= value <= row.high + slack:
            outside = f"outside its manifest's {row.low} to {row.high}"
            raise UserError(f"{words} {row.name} {value:.3f}, {outside}")


def infer(
    policy: Policy, observation: Mapping[str, np.ndarray]
) -> tuple[Optional[np.ndarray], int]:
    """Infer the action, float32 [n], and its duration in ns; no action where that fails."""
    begun_ns = time.perf_counter_ns()
    output: Optional[np.ndarray] = None
    try:
        output = policy.act(observation)
    except Exception as error:  # as in open_network
        log.event("error", "inference_failed", detail=error)
    return output, time.perf_counter_ns() - begun_ns


def verify(policy_bytes: bytes, signature: bytes, public_key_pem: bytes) -> None:
    """Raise UserError unless the owner of the key has signed exactly these bytes."""
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
        raise UserError("the file was changed, or another key signed it") from None


def check_trust(
    path: PathLike, policy_bytes: bytes, public_key: Optional[PathLike], allow_unsigned: bool
) -> tuple[str, Optional[str]]:
    """Verify a policy: VERIFIED, BESIDE, UNVERIFIED or UNSIGNED; UserError where it may not drive.

    Also returns the file of the public key that verified it, if any. A signature is always
    verified where a key is known; `allow_unsigned` lets through only what cannot be verified, never
    what fails to. With it, a key beside the policy comes before that of the working directory.
    Without it, such a key counts for nothing: who brings a policy could bring it, too.
    """
    signature_path = Path(f"{path}{SIGNATURE_SUFFIX}")
    if not signature_path.exists():
        if allow_unsigned:
            return UNSIGNED, None
        raise UserError(f"policy {path} is not signed; --allow-unsigned lets it drive all the same")
    signature = read_bytes(signature_path, "signature")
    trust, beside = VERIFIED, Path(path).with_name(DEFAULT_PUBLIC_KEY.name)
    if public_key is None and allow_unsigned and beside.exists():
        public_key, trust = beside, BESIDE
    elif public_key is None and DEFAULT_PUBLIC_KEY.exists():
        public_key = DEFAULT_PUBLIC_KEY
    if public_key is None:
        if allow_unsigned:
            return UNVERIFIED, None
        raise UserError(f"no public key to verify {signature_path.name} with: use --public-key")
    key_pem = read_bytes(public_key, "public key")
    try:
        verify(policy_bytes, signature, key_pem)
    except UserError as error:
        where = f"signature {signature_path}, public key {public_key}"
        raise UserError(f"{where}: {error}; name its signer's with --public-key") from None
    return trust, str(Path(public_key).absolute())


# Field numbers of onnx.proto (ONNX 1.12 and later; they never change), by kind of message: plain
# fields, messages by field, and refused fields with a name. Any other field is refused, too: it
# could keep weights where nobody looks, or in a file that nobody has signed.
_SPARSE, _OUTSIDE = "sparse weights", "weights in another file (export it in one file)"
# A loop may take any time, and a branch a time that no probe has met.
_FLOW = "control flow (a Loop, an If or a Scan)"
_KINDS: dict[str, tuple[tuple[int, ...], dict[int, str], dict[int, str]]] = {
    "model": (
        (1, 2, 3, 4, 5, 6, 8, 14),
        {7: "graph"},
        {20: "graphs for training", 25: "functions of its own"},
    ),
    "graph": ((2, 10, 11, 12, 13, 14, 16), {1: "node", 5: "tensor"}, {15: _SPARSE}),
    "node": ((1, 2, 3, 4, 6, 7, 8, 9), {5: "attribute"}, {}),
    "attribute": (
        (1, 2, 3, 4, 7, 8, 9, 13, 14, 15, 20),
        {5: "tensor", 10: "tensor"},
        {6: _FLOW, 11: _FLOW, 22: _SPARSE, 23: _SPARSE},
    ),
    "tensor": ((1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16), {}, {13: _OUTSIDE}),
}

# Refused operators: why, which inputs matter, and the names. _RANDOM: refused where one of these
# inputs is there; _COST: where one follows from the observation, not from weights and shapes alone.
# None: always.
_RANDOM, _COST = "answers at random", "takes as long as the observation makes it"
_OPERATORS: tuple[tuple[str, Optional[slice], tuple[str, ...]], ...] = (
    (_RANDOM, None, ("Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike",
                     "RandomUniform", "RandomUniformLike")),
    (_RANDOM, slice(2, 3), ("Dropout",)),
    (_COST, slice(0, 5), ("BlackmanWindow", "ConstantOfShape", "HammingWindow", "HannWindow",
                          "MelWeightMatrix", "NonMaxSuppression", "NonZero", "Range",
                          "StringNormalizer", "StringSplit", "Unique")),
    (_COST, slice(1, 5), ("AffineGrid", "CenterCropPad", "Col2Im", "Compress", "DFT", "Expand",
                          "OneHot", "Pad", "Reshape", "Resize", "RoiAlign", "SequenceAt",
                          "SequenceErase", "Slice", "Split", "SplitToSequence", "Squeeze", "STFT",
                          "Tile", "TopK", "Unsqueeze", "ReduceL1", "ReduceL2", "ReduceLogSum",
                          "ReduceLogSumExp", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceProd",
                          "ReduceSum", "ReduceSumSquare")),
    (_COST, slice(2, 3), ("MaxUnpool", "SequenceInsert")),
    (_COST, slice(4, 5), ("GRU", "LSTM", "RNN")),
)  # fmt: skip


def check_graph(data: bytes) -> dict[str, str]:
    """Check a whole ONNX file, which onnxruntime does not, and return its metadata.

    Raises UserError for truncated or foreign bytes, for weights anywhere but in plain tensors
    inside the file, for a refused operator, and for another IR version or operator set.
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
        _check_operators(next(_bytes(value) for number, value in model if number == 7))
    except ValueError as error:
        raise UserError(f"not a whole ONNX file: {error}") from None
    ir_version, opset = versions[-1], max(numbers)
    if opset not in OPSETS or ir_version > MAX_IR_VERSION:
        needs = f"opset {OPSETS[0]} to {OPSETS[-1]} and at most IR version {MAX_IR_VERSION}"
        raise UserError(f"it has opset {opset} and IR version {ir_version}; it needs {needs}")
    return metadata


def _check_operators(graph: memoryview) -> None:
    """Raise UserError for an operator of `_OPERATORS`, or one that is not ONNX's own."""
    fields = list(_fields(graph))
    fixed = {"", *(_text(dict(_fields(tensor)).get(8)) for number, tensor in fields if number == 5)}
    for node in (list(_fields(value)) for number, value in fields if number == 1):
        name, domain = (_text(dict(node).get(number)) for number in (4, 7))
        inputs, outputs = ([_text(v) for n, v in node if n == number] for number in (1, 2))
        if domain not in ("", "ai.onnx", "ai.onnx.ml"):
            raise UserError(f"its operator {name} is of {domain}, and not ONNX's own")
        for reason, part, names in _OPERATORS:
            harmless = fixed if reason == _COST else {""}
            if name in names and (part is None or not harmless.issuperset(inputs[part])):
                raise UserError(f"its operator {name} {reason}")
        if name in ("SequenceLength", "Shape", "Size") or fixed.issuperset(inputs):
            fixed.update(outputs)


def _checked(message: memoryview, kind: str) -> list[tuple[int, Any]]:
    """Return the fields of a message; UserError where it or one inside it holds a refused field."""
    plain, nested, refused = _KINDS[kind]
    fields = list(_fields(message))
    for number, value in fields:
        what = ""
        if number in nested:
            _checked(_bytes(value), nested[number])
        elif number not in plain:
            what = refused.get(number, f"an unknown field {number}")
        elif (kind, number) == ("tensor", 14) and value != 0:  # data_location; 0 is inside
            what = _OUTSIDE
        if what:
            raise UserError(f"the policy file holds {what}, which the runtime does not read")
    return fields


def _fields(message: memoryview) -> Iterator[tuple[int, Any]]:
    """Read number and value (int or memoryview) of each field; protobuf's wire format."""
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


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """Read a number; returns it and where it ends."""
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
