"""Write a run's actor as the policy file that an edge runtime drives."""

from __future__ import annotations

import argparse
from pathlib import Path

from edge_runtime.cli import examples
from edge_runtime.files import check_writable
from edge_runtime.tls import read_signing_key
from edge_runtime.util import UserError
from trainer.commands.options import existing_directory, read_json
from trainer.drivers import load_actor
from trainer.export import export_policy, write_policy
from trainer.training.run import CONFIG_FILE

EXAMPLE = examples(
    "python -m trainer export runs/phil_1 --out left_turn.onnx --key keys/policy.key",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("run_dir", metavar="RUN_DIR", help="directory of a training run")
    parser.add_argument("--out", required=True, metavar="POLICY.onnx", help="the policy file")
    parser.add_argument("--key", metavar="KEY", help="private key (PEM) to sign with")


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
