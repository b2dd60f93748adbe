"""Write a trained actor as the policy file that may drive (contract section 4)."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray

from edge_runtime.cli import examples
from edge_runtime.files import check_writable, write_atomic
from edge_runtime.policy import (
    MANIFEST_KEY,
    SIGNATURE_SUFFIX,
    Manifest,
    Observation,
    encode_manifest,
    policy_id_of,
)
from edge_runtime.tls import read_signing_key
from edge_runtime.util import UserError
from trainer.drivers import ACTIONS, load_actor, make_environment
from trainer.learner.networks import Actor
from trainer.options import existing_directory, read_json
from trainer.training.run import CONFIG_FILE

EXAMPLE = examples(
    "python -m trainer export runs/phil_1 --out left_turn.onnx --key keys/policy.key",
)
OPSET, IR_VERSION = 17, 8
"""The oldest onnxruntime that a board may have reads these."""
PARITY_OBSERVATIONS = 1000
PARITY_TOLERANCE = 1e-5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("run_dir", metavar="RUN_DIR", help="the directory of a training run")
    parser.add_argument("--out", required=True, metavar="POLICY.onnx", help="the policy file")
    parser.add_argument("--key", metavar="KEY", help="the private key (PEM) to sign it with")


def run(arguments: argparse.Namespace) -> int:
    """Export, check, sign; returns the exit status."""
    run_dir = existing_directory(arguments.run_dir, "run directory")
    out, key = Path(arguments.out), Path(arguments.key) if arguments.key else None
    if out.suffix != ".onnx":
        raise UserError(f"--out {out}: a policy file's name ends in .onnx")
    check_writable(out)
    if key:
        read_signing_key(key)
    actor, label = load_actor(run_dir)
    training = read_json(run_dir / CONFIG_FILE, "run config")
    export = export_policy(actor, label, training)
    write_policy(export, out, key)
    signed = "signed" if key else "not signed"
    print(f"{out}: {len(export.model) / 1e6:.1f} MB, {signed}, policy_id {export.policy_id}")
    print(f"torch and onnxruntime differ by at most {export.max_difference:.1e}")
    return 0


@dataclass(frozen=True)
class Export:
    """A policy file's bytes and how far onnxruntime is from torch on real observations."""

    model: bytes
    policy_id: str
    max_difference: float


def export_policy(actor: Actor, label: dict[str, Any], training: dict[str, Any]) -> Export:
    """Convert, describe, check and compare.

    Args:
        actor: the network.
        label: ``scenario``, ``algorithm``, ``seed`` and ``episode`` of the run.
        training: the run's whole config, for the manifest.

    Raises:
        UserError: the file would not do what the network does.
    """
    graph = _to_onnx(actor)
    manifest = Manifest(
        scenario=label["scenario"],
        algorithm=label["algorithm"],
        observation=Observation(),
        action=[ACTIONS[label["scenario"]]],
        training={
            "seed": label["seed"],
            "episodes": label["episode"],
            "config": training,
            "source_revision": training.get("source_revision", "unknown"),
        },
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    graph.metadata_props.add(key=MANIFEST_KEY, value=encode_manifest(manifest))
    onnx.checker.check_model(graph, full_check=True)
    model = graph.SerializeToString()
    observations = real_observations(label["scenario"], PARITY_OBSERVATIONS)
    difference = parity(actor, model, observations)
    if not difference < PARITY_TOLERANCE:
        raise UserError(
            f"onnxruntime and torch differ by {difference:.1e} (allowed: {PARITY_TOLERANCE:.0e}); "
            "nothing was written"
        )
    return Export(model, policy_id_of(model), difference)


def write_policy(export: Export, path: Path, key_file: Path | None) -> None:
    """Write the policy file and, given a private key (PEM), its signature.

    The key is read first: a wrong one leaves no unsigned file behind.
    """
    key = read_signing_key(key_file) if key_file else None
    signature_path = Path(f"{path}{SIGNATURE_SUFFIX}")
    check_writable(signature_path)
    if key is None:
        # A signature of an older file beside it would only mislead.
        signature_path.unlink(missing_ok=True)
    write_atomic(path, export.model)
    if key is not None:
        write_atomic(signature_path, key.sign(export.model))


def real_observations(scenario: str, count: int, seed: int = 0) -> NDArray[np.uint8]:
    """Observations [count, 2, 45, 80] from driving the scenario at random."""
    env, random = make_environment(scenario), np.random.default_rng(seed)
    size = env.action_space.shape
    observation, _ = env.reset(seed=seed)
    seen: list[NDArray[np.uint8]] = []
    action = np.zeros(size, np.float32)
    while len(seen) < count:
        seen.append(observation)
        # A pedal that wanders instead of trembling: the car gets everywhere.
        action = np.clip(action + random.normal(0.0, 0.3, size), -1, 1).astype(np.float32)
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            observation, _ = env.reset(seed=seed + len(seen))
    return np.stack(seen)


def parity(actor: Actor, model: bytes, observations: NDArray[np.uint8]) -> float:
    """Largest absolute difference between torch and onnxruntime over the observations."""
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    with torch.no_grad():
        wanted = actor(torch.from_numpy(observations)).numpy()
    (got,) = session.run(["action"], {"frames": observations})
    return float(np.abs(wanted - got).max())


def _to_onnx(actor: Actor) -> onnx.ModelProto:
    example = torch.zeros(1, 2, 45, 80, dtype=torch.uint8)
    buffer = BytesIO()
    with warnings.catch_warnings():
        # The newer exporter writes opset 18 and IR 10, which old boards refuse.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            actor.eval(),
            (example,),
            buffer,  # type: ignore[arg-type]  # torch's own stubs forget file objects
            dynamo=False,
            opset_version=OPSET,
            input_names=["frames"],
            output_names=["action"],
            dynamic_axes={"frames": {0: "batch"}, "action": {0: "batch"}},
        )
    model = onnx.load_from_string(buffer.getvalue())
    opset = {entry.domain: entry.version for entry in model.opset_import}[""]
    if (opset, model.ir_version) != (OPSET, IR_VERSION):
        raise UserError(
            f"torch wrote opset {opset}, IR {model.ir_version}; "
            f"boards need opset {OPSET}, IR {IR_VERSION}"
        )
    return model
