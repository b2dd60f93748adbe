"""Small policy files for tests, made with the onnx package (which the board never sees)."""

import hashlib
from pathlib import Path
from typing import Any, Dict, Optional, Sequence

import numpy as np
import onnx
import onnx.parser
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from onnx import helper, numpy_helper

from edge_runtime.policy import MANIFEST_KEY, Action, Manifest, Observation, encode_manifest

# Above this mean brightness (0 to 255) the faulty kinds show their fault; no probe picture of
# `load_policy` is as bright, so they load like a good policy and fail on white frames.
FAULT_BRIGHTNESS = 200.0
SLOW_LOOPS = 1500
_SLOW_SIZE = 256

PEDAL, STEERING = (
    Action(name=name, meaning="m", unit="u", low=-1.0, high=1.0) for name in ("pedal", "steering")
)


def write_policy(
    path: Any,
    kind: str = "constant",
    value: float = 0.3,
    key: Optional[Ed25519PrivateKey] = None,
    actions: Sequence[Action] = (PEDAL,),
    manifest_changes: Optional[Dict[str, Any]] = None,
    opset: int = 17,
    ir_version: int = 8,
    loops: int = SLOW_LOOPS,
) -> str:
    """Write a policy file and return its policy_id; sign it as `path`.sig where a key is given.

    kind: "constant" always answers `value`; "mean" the mean brightness scaled to [-1, 1]; "nan" is
    "constant" until the frames are brighter than FAULT_BRIGHTNESS, then NaN; "slow" likewise, then
    takes about a second at SLOW_LOOPS `loops`, and in proportion at others.
    """
    graph = _graph(kind, value, len(actions), loops)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = ir_version
    training = {"seed": 0, "episodes": 0, "config": {}, "source_revision": "test"}
    fields: Dict[str, Any] = {
        "scenario": "left_turn", "algorithm": "test", "observation": Observation(),
        "action": list(actions), "training": training, "created": "2025-01-01T00:00:00Z",
    }  # fmt: skip
    manifest = Manifest(**{**fields, **(manifest_changes or {})})
    helper.set_model_props(model, {MANIFEST_KEY: encode_manifest(manifest)})
    data = model.SerializeToString()
    Path(path).write_bytes(data)
    if key is not None:
        Path(f"{path}.sig").write_bytes(key.sign(data))
    return hashlib.sha256(data).hexdigest()


def public_pem(key: Any) -> bytes:
    """The PEM file of the public half of a key."""
    return key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )


# What each kind answers, in ONNX's own text form.
_ANSWERS = {
    "constant": "nothing = Mul(mean, zero) answer = Add(nothing, value)",
    "mean": "centred = Sub(mean, half_range) answer = Div(centred, half_range)",
    # The root of a negative number is NaN, and NaN times zero stays NaN.
    "nan": """room = Sub(fault_brightness, mean) root = Sqrt(room) nothing = Mul(root, zero)
        answer = Add(nothing, value)""",
    # Multiplies matrices in a loop, `loops` times for bright frames and never for others.
    "slow": """is_bright = Greater(mean, fault_brightness) bright = Cast<to = 7>(is_bright)
        trips = Mul(bright, loops)
        result = Loop(trips, always, matrix)<body =
            multiply (int64 index, bool going, float[] carried) => (bool go_on, float[] product) {
                go_on = Identity(going) product = MatMul(carried, carried)
            }>
        level = ReduceMean<axes = [0, 1], keepdims = 0>(result)
        nothing = Mul(level, zero) answer = Add(nothing, value)""",
}


def _graph(kind: str, value: float, n_actions: int, loops: int) -> onnx.GraphProto:
    weights: Dict[str, np.ndarray] = {
        "value": np.array([value], np.float32),
        "zero": np.array([0.0], np.float32),
        "half_range": np.array([127.5], np.float32),
        "fault_brightness": np.array([FAULT_BRIGHTNESS], np.float32),
        "ones": np.ones((1, n_actions), np.float32),
        "loops": np.array([loops], np.int64),
        "last_axis": np.array([1], np.int64),
        "always": np.array(True),
        "matrix": np.eye(_SLOW_SIZE if kind == "slow" else 1, dtype=np.float32),
    }
    graph = onnx.parser.parse_graph(
        f"""test_{kind} (uint8[batch, 2, 45, 80] frames) => (float[batch, {n_actions}] action) {{
            pixels = Cast<to = 1>(frames)
            mean = ReduceMean<axes = [1, 2, 3], keepdims = 0>(pixels)
            {_ANSWERS[kind]}
            column = Unsqueeze(answer, last_axis)
            action = Mul(column, ones)
        }}"""
    )
    graph.initializer.extend(
        numpy_helper.from_array(array, name) for name, array in weights.items()
    )
    return graph
