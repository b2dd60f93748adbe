"""A policy file: its signature, its ONNX graph, its manifest, and the network that it holds.

The signature is Ed25519 over the whole file: `POLICY.onnx.sig`, 64 raw bytes; keys are PEM. Before
onnxruntime loads the file it is read field by field, without the onnx package: fields that could
hide weights, or make the run time depend on the observation, are refused. The manifest
(manifest.py) is JSON in its metadata under MANIFEST_KEY. Contract, section 4.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import io
import time
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Iterator, Mapping, NamedTuple, Optional

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
_RANGE_TOLERANCE = 1e-5  # Share of an action's range: rounding of a network's tanh


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

        Raises UserError for another type or shape, and whatever onnxruntime raises.
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
    `allow_unsigned` before it a `policy.pub` beside the policy. Raises UserError.
    """
    # Read once: what is verified is what is loaded, even if the file is replaced meanwhile.
    data = read_bytes(path, "policy file", MAX_POLICY_MIB)
    trust, key_file = check_trust(path, data, public_key, allow_unsigned)
    try:
        return open_policy(data, trust)._replace(public_key=key_file)
    except UserError as error:
        raise UserError(f"policy {Path(path)} may not drive: {error}") from None


def load_manifest(
    path: PathLike, public_key: Optional[PathLike] = None, allow_unsigned: bool = False
) -> Manifest:
    """Read a trusted policy's manifest, without its network. Raises as `load_policy` does."""
    data = read_bytes(path, "policy file", MAX_POLICY_MIB)
    check_trust(path, data, public_key, allow_unsigned)
    try:
        return manifest_of(data)
    except UserError as error:
        raise UserError(f"policy {Path(path)} may not drive: {error}") from None


def manifest_of(data: bytes) -> Manifest:
    """Check the graph in a file's bytes, and return its manifest. Raises UserError."""
    metadata = check_graph(data)
    if MANIFEST_KEY not in metadata:
        raise UserError(f"it holds no manifest (metadata {MANIFEST_KEY}); export it again")
    return decode_manifest(metadata[MANIFEST_KEY])


def open_policy(data: bytes, trust: str) -> Policy:
    """Check and probe the policy in a file's bytes, without its signature. Raises UserError."""
    manifest = manifest_of(data)
    policy = Policy(open_network(data), manifest, Layout(manifest), trust, policy_id_of(data))
    check_tensors(policy.session, manifest)
    _probe(policy)
    return policy


def check_tensors(session: onnxruntime.InferenceSession, task: Task) -> None:
    """Raise UserError unless the network's inputs and output are the task's."""
    wanted = {}
    for name, entry in task.observation.items():
        kind = "float" if entry.dtype == "float32" else entry.dtype
        wanted[name] = (f"tensor({kind})", entry.shape)
    _compare("input", session.get_inputs(), wanted)
    _compare("output", session.get_outputs(), {OUTPUT: ("tensor(float)", [len(task.action)])})


def _compare(what: str, tensors: list, wanted: dict[str, tuple[str, list[int]]]) -> None:
    """Raise UserError unless the tensors are `wanted`, each behind a batch of 1 or any size."""
    actual = {each.name: (each.type, each.shape[1:]) for each in tensors}
    batches = [each.shape[0] if each.shape else 0 for each in tensors]
    if actual != wanted or any(batch != 1 and isinstance(batch, int) for batch in batches):
        must_be, has = (
            ", ".join(f"{name} {kind} {['batch', *shape]}" for name, (kind, shape) in each.items())
            for each in (wanted, actual)
        )
        raise UserError(f"its {what} must be {must_be}; it has {has or 'none'}")


def policy_id_of(data: bytes) -> str:
    """Name a policy: SHA-256 of its whole file, in hex."""
    return hashlib.sha256(data).hexdigest()


def open_network(data: bytes) -> onnxruntime.InferenceSession:
    """Load the network in an ONNX file's bytes, on one thread. Raises UserError."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    # One thread: so small a network gains nothing from more, and the board has other work.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Denormal numbers, as from a dark picture, would make a network ten times slower.
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    # Load the format that was checked: the same bytes may be valid in onnxruntime's own, too.
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
    """Flush denormals to zero in this block only: a process's first session does so for good."""
    before = ctypes.create_string_buffer(64)
    _libc.fegetenv(before)
    _libc.fesetenv(_flushing)
    try:
        yield
    finally:
        _libc.fegetenv(_flushing)
        _libc.fesetenv(before)


def probes(layout: Layout) -> Iterator[dict[str, np.ndarray]]:
    """Make the probe observations, each in range: zeros, middle values, seeded noise."""
    random = np.random.RandomState(0)
    for make in (np.zeros, lambda shape: np.full(shape, 0.5), random.random_sample):
        yield {
            name: np.asarray(make(shape) * {"u": 256, "i": 2}.get(dtype.kind, 1)).astype(dtype)
            for name, dtype, shape, _ in layout.parts
        }


def _probe(policy: Policy) -> None:
    for observation in probes(policy.layout):
        try:
            action = policy.act(observation)
        except Exception as error:  # as in open_network
            raise UserError(f"onnxruntime does not run it: {error}") from None
        check_answer(action, policy.manifest, "a probe")
    for _ in range(10):
        policy.act(observation)


def check_answer(action: np.ndarray, task: Task, what: str) -> None:
    """Raise UserError unless the answer to `what` is finite and in the manifest's ranges."""
    for row, value in zip(task.action, action.tolist()):
        slack = _RANGE_TOLERANCE * (row.high - row.low)
        if not row.low - slack <= value <= row.high + slack:  # NaN fails, too
            found = f"{row.name} {value:.3f}, outside its manifest's {row.low} to {row.high}"
            raise UserError(f"it answers {what} with {found}")


def infer(
    policy: Policy, observation: Mapping[str, np.ndarray]
) -> tuple[Optional[np.ndarray], int]:
    """Infer the action, float32 [n], and its duration in ns; no action where that fails."""
    begun_ns = time.perf_counter_ns()
    try:
        output: Optional[np.ndarray] = policy.act(observation)
    except Exception as error:  # as in open_network
        log.event("error", "inference_failed", detail=error)
        output = None
    return output, time.perf_counter_ns() - begun_ns


def verify(policy_bytes: bytes, signature: bytes, public_key_pem: bytes) -> None:
    """Raise UserError unless the owner of the key has signed exactly these bytes."""
    # Here: reading a manifest alone need not wait for it.
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    try:
        key = load_pem_public_key(public_key_pem)
        if not isinstance(key, Ed25519PublicKey):
            raise ValueError
        key.verify(signature, policy_bytes)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise UserError("the public key is not an Ed25519 key in PEM") from None
    except InvalidSignature:
        raise UserError("the file was changed, or another key signed it") from None


def check_trust(
    path: PathLike, policy_bytes: bytes, public_key: Optional[PathLike], allow_unsigned: bool
) -> tuple[str, Optional[str]]:
    """Return VERIFIED, BESIDE, UNVERIFIED or UNSIGNED, and the file of the key that verified.

    A signature is always verified where a key is known: `allow_unsigned` lets through only what
    cannot be verified. Without it a key beside the policy is ignored: whoever supplies a policy
    could supply the key, too. Raises UserError where the policy may not drive.
    """
    signature_path = Path(f"{path}{SIGNATURE_SUFFIX}")
    if not signature_path.exists():
        if allow_unsigned:
            return UNSIGNED, None
        raise UserError(f"policy {path} is not signed; --allow-unsigned lets it drive all the same")
    trust, beside = VERIFIED, Path(path).with_name(DEFAULT_PUBLIC_KEY.name)
    if public_key is None and allow_unsigned and beside.exists():
        public_key, trust = beside, BESIDE
    elif public_key is None and DEFAULT_PUBLIC_KEY.exists():
        public_key = DEFAULT_PUBLIC_KEY
    if public_key is None:
        if allow_unsigned:
            return UNVERIFIED, None
        raise UserError(f"no public key to verify {signature_path.name} with: use --public-key")
    signature = read_bytes(signature_path, "signature")
    try:
        verify(policy_bytes, signature, read_bytes(public_key, "public key"))
    except UserError as error:
        where = f"signature {signature_path}, public key {public_key}"
        raise UserError(f"{where}: {error}; name its signer's with --public-key") from None
    return trust, str(Path(public_key).absolute())


# Field numbers of onnx.proto (ONNX 1.12 and later; they never change), by kind of message: plain
# fields, and messages by field. Any other field is refused: weights in another file or sparse, a
# subgraph (a loop may take any time, a branch a time that no probe has met), functions, training.
_KINDS: dict[str, tuple[tuple[int, ...], dict[int, str]]] = {
    "model": ((1, 2, 3, 4, 5, 6, 8, 14), {7: "graph"}),
    "graph": ((2, 10, 11, 12, 13, 14, 16), {1: "node", 5: "tensor"}),
    "node": ((1, 2, 3, 4, 6, 7, 8, 9), {5: "attribute"}),
    "attribute": ((1, 2, 3, 4, 7, 8, 9, 13, 14, 15, 20), {5: "tensor", 10: "tensor"}),
    "tensor": ((1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16), {}),
}
_DATA_LOCATION = 14  # of a tensor: 0 is inside the file

_OWN_DOMAINS = ("", "ai.onnx")
# Refused operators: reason, the inputs that matter (None: always refused), names. _RANDOM: refused
# if one of these inputs is present; _COST: if one of them depends on the observation, not on
# weights and shapes alone.
_RANDOM, _COST = "answers at random", "takes as long as the observation makes it"
_OPERATORS: tuple[tuple[str, Optional[slice], tuple[str, ...]], ...] = (
    (_RANDOM, None, ("Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike",
                     "RandomUniform", "RandomUniformLike")),
    (_RANDOM, slice(2, 3), ("Dropout",)),
    (_COST, slice(0, 5), ("BlackmanWindow", "ConstantOfShape", "HammingWindow", "HannWindow",
                          "MaxUnpool", "MelWeightMatrix", "NonMaxSuppression", "NonZero",
                          "Range", "SequenceInsert", "StringNormalizer", "StringSplit", "Unique")),
    (_COST, slice(1, 5), ("AffineGrid", "CenterCropPad", "Col2Im", "Compress", "DFT", "Expand",
                          "GRU", "LSTM", "OneHot", "Pad", "Reshape", "Resize", "RoiAlign",
                          "SequenceAt", "SequenceErase", "Slice", "Split", "SplitToSequence",
                          "Squeeze", "STFT", "Tile", "TopK", "Unsqueeze", "ReduceL1", "ReduceL2",
                          "ReduceLogSum", "ReduceLogSumExp", "ReduceMax", "ReduceMean",
                          "ReduceMin", "ReduceProd", "ReduceSum", "ReduceSumSquare", "RNN")),
)  # fmt: skip


def check_graph(data: bytes) -> dict[str, str]:
    """Check an ONNX file, which onnxruntime does not; return its metadata. Raises UserError."""
    try:
        model = _checked(memoryview(data), "model")
        # A protobuf library would merge two graphs into one that was not looked at here.
        if len(model[7]) != 1:
            raise ValueError(f"it holds {len(model[7])} graphs, not one")
        opsets = [_fields(each) for each in model[8]]
        opset = max([0, *(each[2][-1] for each in opsets if _text(each, 1) in _OWN_DOMAINS)])
        ir_version = model[1][-1]
        entries = [_fields(each) for each in model[14]]
        metadata = {_text(each, 1): _text(each, 2) for each in entries}
        _check_operators(_fields(model[7][0]))
        if opset not in OPSETS or ir_version > MAX_IR_VERSION:
            needs = f"opset {OPSETS[0]} to {OPSETS[-1]} and at most IR version {MAX_IR_VERSION}"
            raise UserError(f"it has opset {opset} and IR version {ir_version}; it needs {needs}")
    except (ValueError, TypeError, IndexError) as error:  # also bytes where a number is expected
        raise UserError(f"not a whole ONNX file: {error}") from None
    return metadata


def _check_operators(graph: dict[int, Any]) -> None:
    """Raise UserError for an operator of `_OPERATORS`, or one that is not ONNX's own."""
    fixed = {"", *(_text(_fields(tensor), 8) for tensor in graph[5])}
    for node in map(_fields, graph[1]):
        name, domain = _text(node, 4), _text(node, 7)
        inputs, outputs = ([str(each, "utf-8") for each in node[number]] for number in (1, 2))
        if domain not in (*_OWN_DOMAINS, "ai.onnx.ml"):
            raise UserError(f"its operator {name} is of {domain}, and not ONNX's own")
        for reason, part, names in _OPERATORS:
            harmless = fixed if reason == _COST else {""}
            if name in names and (part is None or not harmless.issuperset(inputs[part])):
                raise UserError(f"its operator {name} {reason}")
        if name in ("SequenceLength", "Shape", "Size") or fixed.issuperset(inputs):
            fixed.update(outputs)


def _checked(message: memoryview, kind: str) -> dict[int, Any]:
    """Return the fields of a message; UserError where it or one inside it holds a refused field."""
    plain, nested = _KINDS[kind]
    fields = _fields(message)
    for number, values in list(fields.items()):
        for value in values if number in nested else ():
            _checked(value, nested[number])
        is_outside = kind == "tensor" and number == _DATA_LOCATION and any(values)
        if is_outside or number not in (*plain, *nested):
            only = "weights in plain tensors, and no control flow or functions"
            raise UserError(f"field {number} of its {kind} is refused: it may hold {only}")
    return fields


def _fields(message: Any) -> dict[int, Any]:
    """Read the values (int or memoryview) of each field by number; protobuf's wire format."""
    fields: dict[int, Any] = defaultdict(list)
    position = 0
    while position < len(message):
        tag, position = _varint(message, position)
        number, wire_type = tag >> 3, tag & 7
        if number == 0 or wire_type not in (0, 1, 2, 5):
            raise ValueError(f"it holds a field {number} of wire type {wire_type}")
        length = {1: 8, 5: 4}.get(wire_type, 0)  # numbers of 64 and 32 bits
        if wire_type in (0, 2):  # a number, or the length of bytes
            length, position = _varint(message, position)
        if wire_type == 0:
            fields[number].append(length)
            continue
        if position + length > len(message):
            raise ValueError("it ends within a field")
        fields[number].append(message[position : position + length])
        position += length
    return fields


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    result = 0
    for index, byte in enumerate(message[position : position + 10]):
        result |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return result, position + index + 1
    raise ValueError("it ends within a number, or one is longer than 10 bytes")


def _text(fields: dict[int, Any], number: int) -> str:
    return str(fields[number][-1], "utf-8") if fields[number] else ""
