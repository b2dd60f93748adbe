"""A policy file, verified and loaded: frames in, action out. Contract, section 4."""

from __future__ import annotations

import contextlib
import hashlib
import io
import time
from pathlib import Path
from typing import Iterator, List, NamedTuple, Optional, Sequence

import numpy as np
import onnxruntime

from edge_runtime import log
from edge_runtime.policy_file import MANIFEST_KEY, Manifest, check_trust, decode_manifest, read_onnx
from edge_runtime.util import PathLike, UserError, read_bytes
from edge_runtime.wire import FRAMES_SHAPE

OPSET = 17
MAX_IR_VERSION = 8
INPUT, OUTPUT = "frames", "action"
_RANGE_TOLERANCE = 1e-5
_WARM_UP_RUNS = 10


class Policy:
    """A network that may drive. Make it with `load_policy`."""

    def __init__(
        self, session: onnxruntime.InferenceSession, manifest: Manifest, trust: str, policy_id: str
    ) -> None:
        self.manifest = manifest
        self.trust = trust
        self.policy_id = policy_id
        self._session = session

    def act(self, frames: np.ndarray) -> np.ndarray:
        """The action, float32 [n], for frames uint8 [2, 45, 80]. It may hold NaN: check it.

        Raises UserError for another type or shape (which can depend on the picture), and
        whatever onnxruntime raises.
        """
        answer: np.ndarray = self._session.run([OUTPUT], {INPUT: frames[np.newaxis]})[0]
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
        manifest = _read_manifest(data)
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


def _read_manifest(data: bytes) -> Manifest:
    model = read_onnx(data)
    if model.opset != OPSET or model.ir_version > MAX_IR_VERSION:
        raise UserError(
            f"it has opset {model.opset} and IR version {model.ir_version};"
            f" opset {OPSET} and IR version {MAX_IR_VERSION} or lower are needed"
        )
    if MANIFEST_KEY not in model.metadata:
        raise UserError(f"it holds no manifest (metadata {MANIFEST_KEY}); export it again")
    return decode_manifest(model.metadata[MANIFEST_KEY])


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
    """Run it on the probe pictures and warm it up. Raises UserError for an unfit answer."""
    for frames in probe_frames():
        try:
            action = policy.act(frames)
        except Exception as error:  # as in _open
            raise UserError(f"onnxruntime does not run it: {error}") from None
        if not np.all(np.isfinite(action)):
            raise UserError(f"it answers a probe picture with {action.tolist()}, not finite")
        for row, value in zip(policy.manifest.action, action.tolist()):
            if not row.low - _RANGE_TOLERANCE <= value <= row.high + _RANGE_TOLERANCE:
                raise UserError(
                    f"it answers a probe picture with {row.name} {value:.3f},"
                    f" outside its manifest's {row.low} to {row.high}"
                )
    for _ in range(_WARM_UP_RUNS):
        policy.act(frames)


class Inference(NamedTuple):
    """An answer of the policy, float32 [n] or None where it failed, and how long it took."""

    output: Optional[np.ndarray]
    duration_ns: int


def infer(policy: Policy, frames: np.ndarray) -> Inference:
    """Run the policy on frames, uint8 [2, 45, 80]. Where it raises, there is no answer.

    Called by the policy's own thread: the watchdog runs on while it computes.
    """
    begun_ns = time.perf_counter_ns()
    output: Optional[np.ndarray] = None
    try:
        output = policy.act(frames)
    except Exception as error:  # onnxruntime's exceptions share no narrower base
        log.event("error", "inference_failed", detail=error)
    return Inference(output, time.perf_counter_ns() - begun_ns)
