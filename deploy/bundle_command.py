"""``python -m deploy bundle``: one archive for one board and vehicle, and what is in it."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from deploy import keys
from deploy.bundle import Inputs, Made, check_inputs, make_bundle
from deploy.installer.release import WHEELS
from deploy.targets import TARGETS, find_target, lock_path
from deploy.wheelhouse import DEFAULT_FOLDER, build_edge_wheel, gather
from edge_runtime.cli import examples
from edge_runtime.policy_file import DEFAULT_PUBLIC_KEY
from edge_runtime.util import UserError

DEFAULT_OUT = "build/bundles"
DEFAULT_KEY = f"{keys.DEFAULT_DIRECTORY}/policy.key"

EXAMPLE = examples(
    "python -m deploy bundle --policy results/policies/left_turn.onnx \\\n"
    "    --public-key results/policies/policy.pub --target jetpack5 --key keys/policy.key \\\n"
    "    --config edge.toml --tls certs/edge-hunter01",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--policy", metavar="POLICY.onnx", required=True, help="signed policy file")
    parser.add_argument(
        "--target", metavar="|".join(TARGETS), required=True, help="the board's kind"
    )
    parser.add_argument("--out", metavar="DIR", default=DEFAULT_OUT, help="where the archive goes")
    parser.add_argument(
        "--config",
        metavar="FILE.toml",
        help="settings of `edge_runtime run`: connect, vehicle, ...",
    )
    parser.add_argument(
        "--tls",
        metavar="DIR",
        help="the vehicle's folder of `deploy certs`, as certs/edge-hunter01",
    )
    parser.add_argument(
        "--public-key",
        metavar="FILE",
        default=str(DEFAULT_PUBLIC_KEY),
        help="of whoever signed the policy",
    )
    parser.add_argument(
        "--key", metavar="FILE", default=DEFAULT_KEY, help="private key that signs the bundle"
    )
    parser.add_argument(
        "--wheels", metavar="DIR", default=DEFAULT_FOLDER, help="wheels are kept here"
    )


def bundle(arguments: argparse.Namespace) -> int:
    """Make a bundle and print its size and contents."""
    target = find_target(arguments.target)
    with tempfile.TemporaryDirectory() as place:
        inputs = Inputs(
            policy=Path(arguments.policy),
            public_key=Path(arguments.public_key),
            key=Path(arguments.key),
            config=Path(arguments.config) if arguments.config else None,
            tls=Path(arguments.tls) if arguments.tls else None,
            wheels=[],
        )
        check_inputs(inputs)  # Before minutes of downloads.
        _check_out(Path(arguments.out))
        wheels = gather(target, lock_path(target), Path(arguments.wheels) / target.name)
        inputs = inputs._replace(wheels=[*wheels, build_edge_wheel(Path(place))])
        made = make_bundle(inputs, target, Path(arguments.out))
    print("\n".join(_lines(made)))
    return 0


def _check_out(out: Path) -> None:
    """Raise UserError where the folder cannot be made, without making it."""
    whole = out.absolute()
    there = next(place for place in (whole, *whole.parents) if place.exists())
    if not there.is_dir():
        raise UserError(f"--out {out}: {there} is a file, not a directory")


def _lines(made: Made) -> list[str]:
    manifest, size = made.manifest, made.path.stat().st_size
    rows = [f"{entry.size:>12,}  {entry.path}" for entry in manifest.files]
    wheels = sum(entry.size for entry in manifest.files if entry.path.startswith(WHEELS))
    return [
        *rows,
        f"{wheels:>12,}  of it wheels",
        f"{size:>12,}  {made.path}  ({size / 1e6:.1f} MB)",
        f"version {manifest.version}, for {manifest.vehicle_id}, Python {manifest.target.python}"
        f" on {manifest.target.machine} with glibc {manifest.target.glibc} or newer",
    ]
