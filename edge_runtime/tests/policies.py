"""Small policy files for tests, made with the onnx package (which the board never sees)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence

import numpy as np
import onnx
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from onnx import TensorProto, helper, numpy_helper

from edge_runtime.policy import (
    MANIFEST_KEY,
    Action,
    Manifest,
    Observation,
    encode_manifest,
    policy_id_of,
)

# Above this mean brightness (0 to 255) the faulty kinds show their fault; no probe picture of
# `load_policy` is as bright, so they load like a good policy and fail on white frames.
FAULT_BRIGHTNESS = 200.0
SLOW_LOOPS = 1500
_SLOW_SIZE = 256

PEDAL = Action(
    name="pedal",
    meaning="positive accelerates, negative brakes",
    unit="aperture",
    low=-1.0,
    high=1.0,
)
STEERING = Action(
    name="steering", meaning="positive steers left", unit="fraction of full", low=-1.0, high=1.0
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
    odd_shape: Sequence[int] = (1, 0),
) -> str:
    """Write a policy file and return its policy_id; sign it as `path`.sig where a key is given.

    kind: "constant" always answers `value`; "mean" answers the mean brightness scaled to
    [-1, 1], a different number for different frames; "nan" is "constant" until the frames are
    brighter than FAULT_BRIGHTNESS, then NaN; "slow" likewise, then takes about a second at
    SLOW_LOOPS `loops`, and in proportion at others; "odd" likewise, then answers with a tensor of
    `odd_shape`.
    `manifest_changes` replaces fields of the manifest, to write files that must be refused.
    """
    graph = _graph("constant" if kind == "odd" else kind, value, len(actions), loops)
    if kind == "odd":
        _answer_oddly(graph, odd_shape)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = ir_version
    manifest = _manifest(actions, manifest_changes or {})
    helper.set_model_props(model, {MANIFEST_KEY: encode_manifest(manifest)})
    data = model.SerializeToString()
    Path(path).write_bytes(data)
    if key is not None:
        Path(f"{path}.sig").write_bytes(key.sign(data))
    return policy_id_of(data)


def public_pem(key: Any) -> bytes:
    """The PEM file of the public half of a key."""
    return key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )


def _manifest(actions: Sequence[Action], changes: Dict[str, Any]) -> Manifest:
    fields: Dict[str, Any] = {
        "scenario": "left_turn",
        "algorithm": "test",
        "observation": Observation(),
        "action": list(actions),
        "training": {"seed": 0, "episodes": 0, "config": {}, "source_revision": "test"},
        "created": "2025-01-01T00:00:00Z",
    }
    return Manifest(**{**fields, **changes})


def _graph(kind: str, value: float, n_actions: int, loops: int) -> onnx.GraphProto:
    weights: Dict[str, np.ndarray] = {
        "value": np.array([value], np.float32),
        "zero": np.array([0.0], np.float32),
        "half_range": np.array([127.5], np.float32),
        "fault_brightness": np.array([FAULT_BRIGHTNESS], np.float32),
        f"{kind}_ones": np.ones((1, n_actions), np.float32),
        "loops": np.array([loops], np.int64),
    }
    nodes = [
        helper.make_node("Cast", ["frames"], ["pixels"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["pixels"], ["mean"], axes=[1, 2, 3], keepdims=0),
        *_ANSWERS[kind](weights),
        helper.make_node("Unsqueeze", ["answer", "last_axis"], ["column"]),
        helper.make_node("Mul", ["column", f"{kind}_ones"], ["action"]),
    ]
    weights["last_axis"] = np.array([1], np.int64)
    return helper.make_graph(
        nodes,
        f"test_{kind}",
        [helper.make_tensor_value_info("frames", TensorProto.UINT8, ["batch", 2, 45, 80])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["batch", n_actions])],
        [numpy_helper.from_array(array, name) for name, array in weights.items()],
    )


def _constant(weights: Dict[str, np.ndarray]) -> List[onnx.NodeProto]:
    return [
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "value"], ["answer"]),
    ]


def _mean(weights: Dict[str, np.ndarray]) -> List[onnx.NodeProto]:
    return [
        helper.make_node("Sub", ["mean", "half_range"], ["centred"]),
        helper.make_node("Div", ["centred", "half_range"], ["answer"]),
    ]


def _nan(weights: Dict[str, np.ndarray]) -> List[onnx.NodeProto]:
    """The root of a negative number is NaN, and NaN times zero stays NaN."""
    return [
        helper.make_node("Sub", ["fault_brightness", "mean"], ["room"]),
        helper.make_node("Sqrt", ["room"], ["root"]),
        helper.make_node("Mul", ["root", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "value"], ["answer"]),
    ]


def _slow(weights: Dict[str, np.ndarray]) -> List[onnx.NodeProto]:
    """Multiplies matrices in a loop, `loops` times for bright frames and never for others."""
    weights["always"] = np.array(True)
    weights["matrix"] = np.eye(_SLOW_SIZE, dtype=np.float32)
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["going"], ["go_on"]),
            helper.make_node("MatMul", ["carried", "carried"], ["product"]),
        ],
        "multiply",
        [
            helper.make_tensor_value_info("index", TensorProto.INT64, []),
            helper.make_tensor_value_info("going", TensorProto.BOOL, []),
            helper.make_tensor_value_info("carried", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("product", TensorProto.FLOAT, None),
        ],
    )
    return [
        helper.make_node("Greater", ["mean", "fault_brightness"], ["is_bright"]),
        helper.make_node("Cast", ["is_bright"], ["bright"], to=TensorProto.INT64),
        helper.make_node("Mul", ["bright", "loops"], ["trips"]),
        helper.make_node("Loop", ["trips", "always", "matrix"], ["result"], body=body),
        helper.make_node("ReduceMean", ["result"], ["level"], axes=[0, 1], keepdims=0),
        helper.make_node("Mul", ["level", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "value"], ["answer"]),
    ]


def _answer_oddly(graph: onnx.GraphProto, shape: Sequence[int]) -> None:
    """For bright frames a tensor of another shape than the graph says of its output."""
    graph.node[-1].output[0] = "as_said"
    branches = {}
    for name, node in (
        ("then", helper.make_node("Identity", ["odd"], ["then"])),
        ("else", helper.make_node("Identity", ["as_said"], ["else"])),
    ):
        output = helper.make_tensor_value_info(name, TensorProto.FLOAT, None)
        branches[f"{name}_branch"] = helper.make_graph([node], name, [], [output])
    graph.initializer.append(numpy_helper.from_array(np.full(shape, 0.5, np.float32), "odd"))
    graph.node.extend(
        [
            helper.make_node("Greater", ["mean", "fault_brightness"], ["is_bright"]),
            helper.make_node("If", ["is_bright"], ["action"], **branches),
        ]
    )


_ANSWERS = {"constant": _constant, "mean": _mean, "nan": _nan, "slow": _slow}
