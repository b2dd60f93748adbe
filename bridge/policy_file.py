"""Write policy files; and ``python -m deploy policy``, which makes one of any ONNX model.

The manifest comes from the environment: names, shapes and ranges of observations and actions, and
the control period. The model then drives the environment for a while, in the board's own runtime.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import onnx

from bridge.environments import Adapter, Environment, describe, known_stops, make_environment
from edge_runtime import policy as edge
from edge_runtime.cli import Subcommand, examples, positive_number
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.manifest import MANIFEST_KEY, Action, Manifest, Task, check_task
from edge_runtime.tls import read_signing_key
from edge_runtime.util import UserError, read_bytes

REAL_OBSERVATIONS = 200
FOREIGN = "foreign"  # The algorithm of a model that says nothing of its own


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    env = "the environment that the model drives: scenario, gymnasium id or module:id"
    change = "action.N.stop (a number, or null to hold the last action), slew_per_s, unit, meaning"
    add("model", metavar="MODEL.onnx", type="path", help="the model, in one file")
    add("--env", metavar="ENV", required=True, help=env)
    add("--out", metavar="POLICY.onnx", type="path", required=True, help="the policy file")
    add("--key", metavar="KEY", type="path", help="the private key that signs it (deploy keys)")
    add("--set", metavar="KEY=VALUE", dest="changes", action="append", default=[], help=change)
    period = "control period in s (default: the environment's, else guessed from render_fps)"
    add("--period", metavar="SECONDS", type=positive_number, help=period)
    algorithm = "the training's algorithm, for the manifest"
    add("--algorithm", metavar="NAME", default=FOREIGN, help=algorithm)


def _run(arguments: argparse.Namespace) -> int:
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
        model = read_bytes(arguments.model, "model", edge.MAX_POLICY_MIB)
        training = {"source": Path(arguments.model).name, "environment": arguments.env}
        try:
            data = make_policy(model, task, arguments.algorithm, training)
            policy = edge.open_policy(data, edge.UNSIGNED)
            _try(policy, environment)
        except UserError as error:
            raise UserError(f"{arguments.model} cannot be a policy: {error}") from None
    write_policy(data, Path(out), key)
    print(f"{out}: {'signed' if key else 'not signed'}, policy_id {policy.policy_id}")
    print(f"it drives {task.text}")
    return 0


def changed(task: Task, changes: Sequence[str]) -> Task:
    """Return the task with changes such as ``action.0.stop=-1``; the value is JSON or plain text.

    ``stop``, ``slew_per_s``, ``meaning`` and ``unit`` of an action can be changed. Raises UserError
    for anything else.
    """
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
    """Return a policy file's bytes: the model with its manifest in it.

    A single input and a single output may have any name and get the manifest's. Raises UserError
    for anything but an ONNX model that the board can run.
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
    """Rename a value wherever it stands; another value of the new name makes room."""
    swap = {old: new, new: f"{new}_of_the_model"} if old != new else {}
    for value in (*graph.input, *graph.output, *graph.value_info, *graph.initializer):
        value.name = swap.get(value.name, value.name)
    for node in graph.node:
        for names in (node.input, node.output):
            names[:] = [swap.get(name, name) for name in names]


def _try(policy: edge.Policy, environment: Environment) -> None:
    """Ask the policy in REAL_OBSERVATIONS steps of random actions.

    Raises UserError for an action that the environment cannot take.
    """
    environment.action_space.seed(0)
    adapter, over, seen = Adapter(environment, policy.manifest), True, None
    for step in range(REAL_OBSERVATIONS):
        if over:
            seen, _ = environment.reset(seed=step)
        try:
            action = policy.act(policy.layout.arrays(adapter.pack(seen)))
        except Exception as error:  # onnxruntime's exceptions share no narrower base
            raise UserError(f"onnxruntime does not run it: {error}") from None
        edge.check_answer(action, policy.manifest, "a real observation")
        sampled = adapter.within(environment.action_space.sample())
        seen, _, terminated, truncated, _ = environment.step(sampled)
        over = terminated or truncated


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
    else:  # A signature of an older file beside it would only mislead.
        signature_path.unlink(missing_ok=True)


EXAMPLE = "python -m deploy policy a.onnx --env Pendulum-v1 --set action.0.stop=0 --out b.onnx"
POLICY = Subcommand(examples(EXAMPLE), _add_arguments, _run)
