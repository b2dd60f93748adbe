"""``python -m deploy``: what goes onto the board, and onto it."""

from __future__ import annotations

import sys

from edge_runtime.cli import program, run_cli

COMMANDS = {
    "keys": ("deploy.certs:KEYS", "make a key pair that signs policies and bundles"),
    "certs": ("deploy.certs:CERTS", "make an authority and certificates for TLS"),
    "policy": ("bridge.policy_file:POLICY", "make a policy file of any ONNX model"),
    "bundle": ("deploy.bundle:BUNDLE", "make one signed archive for one board and vehicle"),
    "lock": ("deploy.bundle:LOCK", "write the hashes of a board's wheels anew"),
    "push": ("deploy.push", "bring a bundle to a board and install it"),
    "router": ("deploy.certs:ROUTER_FILE", "write a fleet's router settings, for zenohd"),
}


main = program(
    "python -m deploy",
    "Prepares what goes onto the board, and brings it there.",
    COMMANDS,
    "python -m deploy keys --out keys",
    "python -m deploy bundle --policy results/policies/left_turn.onnx \\\n"
    "    --public-key results/policies/policy.pub --target jetpack5",
)

if __name__ == "__main__":
    sys.exit(run_cli(main))
