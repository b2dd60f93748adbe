"""Write policy files; and ``python -m deploy policy``, which makes one from any ONNX model.

The manifest comes from the environment, on whose observations the model is then tried.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import onnx

from bridge.environments import Adapter, Environment, describe, known_stops, make_environment
from edge_runtime import policy as edge
from edge_runtime.cli import positive_number
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.manifest import MANIFEST_KEY, Action, Manifest, Task, check_task
from edge_runtime.tls import read_signing_key
from edge_runtime.util import UserError, read_bytes

REAL_OBSERVATIONS, HELD_STEPS = 200, 5  # A random action is held for 5 steps, to get farther
FOREIGN = "foreign"  # The algorithm of a model that does not name its own
TOLERANCE = 1e-5  # Of an action of about 1: two runtimes round differently
BEARABLE = 100.0
"""Largest plausible output of a first layer: trained networks have 0.5 to 5, and about 100 where
bytes are not scaled."""
FIRST_LAYERS = ("Conv", "Gemm", "MatMul")
Arrays = Mapping[str, np.ndarray]  # An observation, by entry
Act = Callable[[Arrays], np.ndarray]
"""The answer of a network's own library, in the environment's units."""


class Model(NamedTuple):
    data: bytes  # ONNX
    algorithm: str = FOREIGN
    act: Act | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    env = "the environment that the model drives: scenario, gymnasium id or module:id"
    change = "action.N.stop (a number, or null to hold the last action), slew_per_s, unit, meaning"
    model = "ONNX in one file, or Stable-Baselines3's model.zip (SAC, TD3, DDPG, PPO, A2C)"
    add("model", metavar="MODEL", type="path", help=model)
    add("--env", metavar="ENV", required=True, help=env)
    add("--out", metavar="POLICY.onnx", type="path", required=True, help="the policy file")
    add("--key", metavar="KEY", type="path", help="the private key that signs it (deploy keys)")
    add("--set", metavar="KEY=VALUE", dest="changes", action="append", default=[], help=change)
    period = "control period in s (default: the environment's, else guessed from render_fps)"
    add("--period", metavar="SECONDS", type=positive_number, help=period)
    pickled = "the VecNormalize that a model.zip was trained with, as the library saves it"
    add("--normalise", metavar="VECNORMALIZE.pkl", type="path", help=pickled)
    algorithm = f"the training's algorithm, for the manifest (default: the model's, or {FOREIGN})"
    add("--algorithm", metavar="NAME", help=algorithm)


def read_onnx(arguments: argparse.Namespace, *_: Any) -> Model:
    return Model(read_bytes(arguments.model, "model", edge.MAX_POLICY_MIB))


def run(arguments: argparse.Namespace, read: Callable[..., Model] = read_onnx) -> int:
    """Make a policy file of the model that ``read(arguments, environment, task)`` returns."""
    out, key = arguments.out, arguments.key
    check_writable(out)
    if key:
        read_signing_key(key)
    with closing(make_environment(arguments.env)) as environment:
        task = changed(describe(environment, arguments.period), arguments.changes)
        for number, row in enumerate(task.action if known_stops(environment) is None else ()):
            place = f"action.{number}.stop="
            if not any(change.startswith(place) for change in arguments.changes):
                ask = f"give --set {place}VALUE, or --set {place}null to hold the last one"
                raise UserError(f"the environment does not say how {row.name} stops safely; {ask}")
        model = read(arguments, environment, task)
        algorithm = arguments.algorithm or model.algorithm
        training = {"source": Path(arguments.model).name, "environment": arguments.env}
        try:
            data = make_policy(model.data, task, algorithm, training)
            policy = edge.open_policy(data, edge.UNSIGNED)
            apart = try_policy(policy, environment, data, model.act)
        except UserError as error:
            raise UserError(f"{arguments.model} cannot be a policy: {error}") from None
    write_policy(data, Path(out), key)
    print(f"{out}: {'signed' if key else 'not signed'}, policy_id {policy.policy_id}")
    if model.act:
        print(f"its own library answers the same, within {apart:.1e}")
    print(f"it drives {task.text}")
    return 0


def changed(task: Task, changes: Sequence[str]) -> Task:
    """Return the task with changes such as ``action.0.stop=-1`` (JSON or text); UserError."""
    rows = msgspec.to_builtins(task.action)
    for change in changes:
        match = re.fullmatch(r"action\.(\d+)\.(stop|slew_per_s|meaning|unit)=(.*)", change)
        if match is None or int(match[1]) >= len(rows):
            form = "action.N.stop=VALUE, or slew_per_s, meaning, unit"
            raise UserError(f"--set {change}: expected {form}, N from 0 to {len(rows) - 1}")
        value: Any = match[3]
        with suppress(ValueError):
            value = json.loads(value)
        rows[int(match[1])][match[2]] = value
    try:
        task = msgspec.structs.replace(task, action=msgspec.convert(rows, list[Action]))
    except msgspec.ValidationError as error:
        raise UserError(f"--set: {error}") from None
    check_task(task)
    return task


def make_policy(model: bytes, task: Task, algorithm: str, training: dict[str, Any]) -> bytes:
    """Return a policy file's bytes: the model with its manifest. Raises UserError.

    A single input or output may have any name; it is renamed to the manifest's.
    """
    edge.check_graph(model)
    graph = onnx.load_from_string(model)
    names = [each.name for each in graph.graph.input]
    known = {each.name for each in graph.graph.initializer}  # of a model of IR version 3
    inputs = [name for name in names if name not in known]
    if len(inputs) == len(task.observation) == 1:
        _rename(graph.graph, inputs[0], next(iter(task.observation)))
    if len(graph.graph.output) == 1:
        _rename(graph.graph, graph.graph.output[0].name, edge.OUTPUT)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    about: dict[str, Any] = {"algorithm": algorithm, "training": training, "created": created}
    manifest = Manifest(**msgspec.structs.asdict(task), **about)
    del graph.metadata_props[:]
    graph.metadata_props.add(key=MANIFEST_KEY, value=msgspec.json.encode(manifest).decode())
    return graph.SerializeToString()


def _rename(graph: onnx.GraphProto, old: str, new: str) -> None:
    swap = {old: new, new: f"{new}_of_the_model"} if old != new else {}
    for value in (*graph.input, *graph.output, *graph.value_info, *graph.initializer):
        value.name = swap.get(value.name, value.name)
    for node in graph.node:
        for names in (node.input, node.output):
            names[:] = [swap.get(name, name) for name in names]


def try_policy(
    policy: edge.Policy, environment: Environment, data: bytes, act: Act | None
) -> float:
    """Try the policy for REAL_OBSERVATIONS steps; return its largest difference from its library.

    ``data`` is its file, and ``act`` its library. Raises UserError for an action that is out of
    range, or differs. Warns where answers or observations are probably in other units.
    """
    environment.action_space.seed(0)
    adapter, over, observation = Adapter(environment, policy.manifest), True, None
    answers, reaches, apart = [], [], [0.0]
    reach_of = _first_layers(data)
    for step in range(REAL_OBSERVATIONS):
        if over:
            observation, _ = environment.reset(seed=step)
        entries = policy.layout.arrays(adapter.pack(observation))
        try:
            action = policy.act(entries)
            reaches.append(reach_of(entries))
        except Exception as error:  # onnxruntime's exceptions share no narrower base
            raise UserError(f"onnxruntime does not run it: {error}") from None
        edge.check_answer(action, policy.manifest, "a real observation")
        answers.append(np.abs(action).max())
        if act:
            apart.append(float(np.abs(act(entries) - action).max()))
        if step % HELD_STEPS == 0:
            driven = adapter.within(environment.action_space.sample())
        observation, _, terminated, truncated, _ = environment.step(driven)
        over = terminated or truncated
    widest = max(1.0, *(max(-row.low, row.high) for row in policy.manifest.action))
    if not max(apart) <= TOLERANCE * widest:
        raise UserError(f"the answers of its own library differ by {max(apart):.1e}")
    if not act and max(answers) <= 1.0 + TOLERANCE < widest:
        warn("all its answers lie within -1 to 1, and the range is wider: does it scale them?")
    if (reach := np.median(reaches)) > BEARABLE:
        why = f"the network's first layer reaches {reach:.0f}, and trained ones stay near 1"
        warn(f"{why}: does it normalise observations as in its training?")
    return max(apart)


def _first_layers(data: bytes) -> Callable[[Arrays], float]:
    """Make a function: 99th percentile of |output| of a model's first layers, before activation."""
    model, names, deep = onnx.load_from_string(data), list[str](), set[str]()
    for node in model.graph.node:
        is_deep, is_layer = not deep.isdisjoint(node.input), node.op_type in FIRST_LAYERS
        names += node.output[:1] if is_layer and not is_deep else []
        deep.update(node.output if is_layer or is_deep else [])
    if not names:
        return lambda entries: 0.0
    del model.graph.output[:]
    model.graph.output.extend(map(onnx.helper.make_empty_tensor_value_info, names))
    network = edge.open_network(model.SerializeToString())

    def reach_of(entries: Arrays) -> float:
        outputs = network.run(names, {name: array[np.newaxis] for name, array in entries.items()})
        return float(np.percentile(np.abs(np.concatenate([*map(np.ravel, outputs)])), 99))

    return reach_of


def warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def write_policy(data: bytes, path: Path, key_file: Path | str | None) -> None:
    """Write the policy file and, given a private key (PEM), its signature.

    The key is read first: a wrong one leaves no unsigned file behind.
    """
    key = read_signing_key(key_file) if key_file else None
    signature_path = Path(f"{path}{edge.SIGNATURE_SUFFIX}")
    check_writable(signature_path)
    write_atomic(path, data)
    if key is not None:
        write_atomic(signature_path, key.sign(data))
    else:  # The signature of an older file would mislead.
        signature_path.unlink(missing_ok=True)
