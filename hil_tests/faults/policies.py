"""The vehicle and the task of the fault rows, and one-line policies for it."""

from __future__ import annotations

from pathlib import Path

import onnx.parser

from bridge.policy_file import make_policy
from edge_runtime.manifest import Action, Car, Entry, Task

VEHICLE_ID = "faults"
TASK = Task(
    task="left_turn", observation={"frames": Entry(dtype="uint8", shape=[2, 45, 80])},
    action=[Action(name="pedal", low=-1.0, high=1.0, stop=-1.0)], control_period_s=0.1,
    car=Car(throttle_mps2=3.0, brake_mps2=4.0, max_speed_mps=6.0, full_steering_rad=0.785,
            wheelbase_m=5.0),
)  # fmt: skip
POLICIES = {"steady": (0.0, 0.6), "mean": (2.0 / 255.0, -1.0)}
"""Slope and offset of the pedal over the brightness: `mean` is at full throttle on white frames,
and brakes on those darker than grey."""
_GRAPH = """<ir_version: 8, opset_import: ["" : 17]>
faults (uint8[batch, 2, 45, 80] frames) => (float[batch, 1] action)
<float slope = {{{}}}, float offset = {{{}}}, int64[1] last_axis = {{1}}>
{{
    pixels = Cast<to = 1>(frames)
    mean = ReduceMean<axes = [1, 2, 3], keepdims = 0>(pixels)
    scaled = Mul(mean, slope)
    answer = Add(scaled, offset)
    action = Unsqueeze(answer, last_axis)
}}"""


def write_policy(folder: Path, kind: str) -> Path:
    path, model = folder / f"{kind}.onnx", onnx.parser.parse_model(_GRAPH.format(*POLICIES[kind]))
    path.write_bytes(make_policy(model.SerializeToString(), TASK, "faults", {}))
    return path
