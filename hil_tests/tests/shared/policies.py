"""Small policy files for tests, made with the onnx package (which the board never sees)."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import onnx.parser
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from onnx import helper, numpy_helper

from edge_runtime.manifest import MANIFEST_KEY, Action, Car, Entry, Manifest, Task

# Above this mean brightness (0 to 255) the faulty kinds show their fault; no probe picture of
# `load_policy` is as bright, so they load like a good policy and fail on white frames.
FAULT_BRIGHTNESS = 200.0

PEDAL, STEERING = (
    Action(name=name, meaning="m", unit="u", low=-1.0, high=1.0, stop=stop)
    for name, stop in (("pedal", -1.0), ("steering", None))
)
SHAPE = (2, 45, 80)
SIZE = 2 * 45 * 80
FRAMES = {"frames": Entry(dtype="uint8", shape=list(SHAPE), meaning="[t-1, t]")}
T = 0.1
CAR = Car(
    throttle_mps2=3.0, brake_mps2=4.0, max_speed_mps=6.0, full_steering_rad=0.785, wheelbase_m=5.0
)
TASK = Task(task="left_turn", observation=FRAMES, action=[PEDAL], control_period_s=T)


def write_policy(
    path: Any,
    kind: str = "constant",
    value: float = 0.3,
    key: Ed25519PrivateKey | None = None,
    actions: Sequence[Action] = (PEDAL,),
    manifest_changes: dict[str, Any] | None = None,
    opset: int = 17,
    ir_version: int = 8,
    graph: str = "",
) -> str:
    """Write a policy file and return its policy_id; sign it as `path`.sig where a key is given.

    kind: "constant" always answers `value`; "mean" the mean brightness scaled to [-1, 1]; "nan" is
    "constant" until the frames are brighter than FAULT_BRIGHTNESS, then NaN. `graph` is another
    network, in ONNX's text form; it may name the constants.
    """
    made = _graph(graph, kind, value, len(actions))
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = ir_version
    training = {"seed": 0, "episodes": 0, "config": {}, "source_revision": "test"}
    fields: dict[str, Any] = {
        "task": "left_turn", "algorithm": "test", "observation": FRAMES, "action": list(actions),
        "control_period_s": T, "car": CAR, "training": training, "created": "2025-01-01T00:00:00Z",
    }  # fmt: skip
    manifest = Manifest(**{**fields, **(manifest_changes or {})})
    helper.set_model_props(model, {MANIFEST_KEY: msgspec.json.encode(manifest).decode()})
    data = model.SerializeToString()
    Path(path).write_bytes(data)
    if key is not None:
        Path(f"{path}.sig").write_bytes(key.sign(data))
    return hashlib.sha256(data).hexdigest()


ROVER = {
    "camera": Entry(dtype="uint8", shape=[4, 6, 3]),
    "ranges": Entry(dtype="float32", shape=[2]),
    "lit": Entry(dtype="bool", shape=[]),
}
ROVER_INPUTS = {"camera": "uint8[b, 4, 6, 3]", "ranges": "float[b, 2]", "lit": "bool[b]"}
WHEELS = [*(Action(name=name, low=-40.0, high=80.0, stop=0.0) for name in ("left", "right"))]


def write_rover(path: Any, kinds: dict[str, str] = ROVER_INPUTS, **changes: Any) -> str:
    """A policy of another kind of robot: its wheels are its ranges, tenfold."""
    inputs = ", ".join(f"{kind} {name}" for name, kind in kinds.items())
    graph = f"rover ({inputs}) => (float[b, 2] action) {{ action = Mul(ranges, ten) }}"
    fields = {"task": "rover", "observation": ROVER, "control_period_s": 0.02, "car": None}
    options: dict[str, Any] = {"opset": 21, "ir_version": 10, "actions": WHEELS}
    return write_policy(path, graph=graph, manifest_changes={**fields, **changes}, **options)


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
}


def _graph(text: str, kind: str, value: float, n_actions: int) -> onnx.GraphProto:
    constants = {
        "value": [value], "zero": [0.0], "ten": 10.0, "faint": 1e-20, "half_range": [127.5],
        "fault_brightness": [FAULT_BRIGHTNESS], "ones": [[1.0] * n_actions],
    }  # fmt: skip
    text = (
        text
        or f"""test_{kind} (uint8[batch, 2, 45, 80] frames)
        => (float[batch, {n_actions}] action) {{
            pixels = Cast<to = 1>(frames)
            mean = ReduceMean<axes = [1, 2, 3], keepdims = 0>(pixels)
            {_ANSWERS[kind]}
            column = Unsqueeze(answer, last_axis)
            action = Mul(column, ones)
        }}"""
    )
    graph = onnx.parser.parse_graph(text)
    arrays = {name: np.array(number, np.float32) for name, number in constants.items()}
    arrays["last_axis"] = np.array([1], np.int64)
    graph.initializer.extend(numpy_helper.from_array(each, name) for name, each in arrays.items())
    return graph
