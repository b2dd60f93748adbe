"""``python -m deploy``: make keys, certificates and bundles, and install them on a board."""

from __future__ import annotations

import sys

from edge_runtime.cli import program, run_cli

COMMANDS = {
    "keys": ("deploy.certs:keys", "make a key pair that signs policies and bundles"),
    "certs": ("deploy.certs:certs", "make an authority and certificates for TLS"),
    "policy": ("trainer.sb3:POLICY", "make a policy file from any ONNX model, or a model.zip"),
    "bundle": ("deploy.bundle:bundle", "make one signed archive for one board and vehicle"),
    "push": ("deploy.bundle:push", "copy a bundle to a board and install it"),
}

main = program(
    "python -m deploy",
    "Make keys, certificates and bundles, and install them on a board.",
    COMMANDS,
    "python -m deploy keys --out keys",
    "python -m deploy bundle --policy my.onnx --target jetpack5 --config edge.toml",
)

if __name__ == "__main__":
    sys.exit(run_cli(main))
