"""``python -m deploy bundle``: all that a board needs to drive one policy, in one signed archive.

The same inputs give the same bytes: the archive holds no time, place or user name. A lock names
every wheel of a kind of board by version and hash. A folder keeps the wheels between runs, so that
only the first bundle needs a network.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from importlib.metadata import distributions
from pathlib import Path
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

import edge_runtime
from deploy.certs import DEFAULT_KEY, write_private
from deploy.installer.layout import CONFIG, POLICY, PUBLIC_KEY, TLS, WHEELS
from deploy.installer.verify import MANIFEST, NAMESPACE, BundleManifest, Target, to_json
from edge_runtime import tls
from edge_runtime.cli import Subcommand, examples
from edge_runtime.config import BUILT_IN, NONE, Config, load_config
from edge_runtime.controller import shared_limits
from edge_runtime.files import check_writable, make_directory, write_atomic
from edge_runtime.manifest import Manifest
from edge_runtime.policy import MAX_POLICY_MIB, load_policy
from edge_runtime.util import DEFAULT_PUBLIC_KEY, UserError, read_bytes, read_toml
from edge_runtime.vehicles import GROUP, vehicle_limits

ROOT = Path(__file__).parents[1]
UNITS = ROOT / "deploy/systemd"
NAME = "install.pyz"
DEFAULT_OUT, DEFAULT_FOLDER = "build/bundles", "build/wheels"
HOLD = "../../state/hold"  # Seen from a release's folder: what the installer locks while it judges
_OF_THE_BUNDLE = ("policy", "tls", "public_key", "allow_unsigned", "hold")
_DIGITS = 8
_MAIN = """\
import sys

if sys.version_info < (3, 8):
    sys.stderr.write("error: Python 3.8 or newer is needed: try python3.8\\n")
    sys.exit(2)

from deploy.installer.__main__ import main

sys.exit(main(sys.argv[1:]))
"""
TARGETS = {
    name: Target(name, python, machine, glibc="2.31")
    for name, python, machine in (
        ("jetpack5", "3.8", "aarch64"),  # Jetson Xavier NX: Ubuntu 20.04
        ("linux-aarch64", "3.9", "aarch64"),  # Debian bullseye
        ("linux-x86_64", "3.8", "x86_64"),  # jetpack5's versions on a workstation
    )
}
_PATCH = 2  # pip reads 3.9 as 3.9.0, which cryptography excludes; Debian bullseye has 3.9.2.
_EPOCH_S = 315532800
"""1980-01-01, the first day that a ZIP file knows: the built wheel's files bear it."""


class Inputs(NamedTuple):
    """What a bundle is made of.

    `policy` has its signature beside it, and `public_key` is its signer's; `key` signs the bundle.
    `config` holds settings of `run` (None for its defaults), `tls` is the vehicle's folder of
    `deploy certs`, and `wheels` are all wheels, a vehicle's driver among them.
    """

    policy: Path
    public_key: Path
    key: Path
    config: Path | None
    tls: Path | None
    wheels: list[Path]


class Made(NamedTuple):
    """A bundle on the disk."""

    path: Path
    manifest: BundleManifest


def _add_bundle_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--target", choices=TARGETS, required=True, help="kind of board")
    add = functools.partial(parser.add_argument, type=Path, metavar="FILE")
    add("--policy", required=True, help="signed policy file")
    add("--config", help="settings of `edge_runtime run`: connect, vehicle, ... (TOML)")
    add("--public-key", default=str(DEFAULT_PUBLIC_KEY), help="public key of the policy's signer")
    add("--key", default=DEFAULT_KEY, help="private key that signs the bundle")
    add = functools.partial(parser.add_argument, type=Path, metavar="DIR")
    add("--tls", help="the vehicle's folder of `deploy certs`, such as certs/edge-hunter01")
    driver = "another wheel to install, such as a vehicle's driver; may be repeated"
    parser.add_argument(
        "--with", dest="more", action="append", type=Path, default=[], metavar="WHEEL", help=driver
    )
    add("--wheels", default=DEFAULT_FOLDER, help="folder that keeps the wheels")
    add("--out", default=DEFAULT_OUT, help="folder for the bundle")


def _run_bundle(arguments: argparse.Namespace) -> int:
    target, out, more = TARGETS[arguments.target], arguments.out, arguments.more
    given = {name: getattr(arguments, name) for name in Inputs._fields if name != "wheels"}
    inputs = Inputs(**given, wheels=more)
    kept = arguments.wheels / target.name
    # All that can be wrong, before minutes of downloads.
    for folder in (out, kept):
        check_writable(folder / "file")
    collect(inputs, target)
    with tempfile.TemporaryDirectory() as place:
        if more:  # pip refuses those that do not fit the target.
            _download(target, Path(place), "--no-index", *map(str, more))
        build_edge_wheel(Path(place))
        wheels = gather(target, lock_path(target), kept, Path(place))
        path, manifest = make_bundle(inputs._replace(wheels=wheels), target, out)
    print(f"{path}  ({path.stat().st_size / 1e6:.1f} MB), signed by {path.name}.sig")
    print(f"version {manifest.version}, for {manifest.vehicle_id}, {target} or newer")
    return 0


def make_bundle(inputs: Inputs, target: Target, out: Path) -> Made:
    """Write `phil-TARGET-VEHICLE-VERSION.tar`, mode 0600, and its signature into `out`.

    Raises UserError as `collect` does, with nothing written.
    """
    contents, manifest = collect(inputs, target)
    path = out / f"phil-{target.name}-{manifest.vehicle_id}-{manifest.version}.tar"
    packed = pack({MANIFEST: to_json(manifest), **contents})
    write_atomic(f"{path}.sig", sign(packed, tls.read_signing_key(inputs.key)))
    try:
        write_private(path, packed)  # it holds a private key
    finally:
        if not path.exists():
            Path(f"{path}.sig").unlink()
    return Made(path, manifest)


def collect(inputs: Inputs, target: Target) -> tuple[dict[str, bytes], BundleManifest]:
    """The files of a bundle but its manifest, by path, and the manifest.

    Raises UserError for a policy that may not drive or was not signed by the public key's owner,
    settings that do not hold, certificates of another party, and a key that cannot sign.
    """
    tls.read_signing_key(inputs.key)
    contents = {
        NAME: build_installer(),
        POLICY: read_bytes(inputs.policy, "policy file", MAX_POLICY_MIB),
        f"{POLICY}.sig": read_bytes(f"{inputs.policy}.sig", "signature"),
        PUBLIC_KEY: read_bytes(inputs.public_key, "public key"),
        **{f"units/{path.name}": path.read_bytes() for path in UNITS.iterdir()},
    }
    policy = load_policy(inputs.policy, inputs.public_key)
    config, contents[CONFIG] = _settings(inputs)
    _check_vehicle(config, policy.manifest, inputs.wheels)
    if inputs.tls is not None:  # The party's three files, and none that may stand beside them.
        tls.check_name(tls.load_tls(inputs.tls).name, tls.common_name(tls.EDGE, config.vehicle_id))
        for name in (tls.CA_FILE, tls.CERTIFICATE_FILE, tls.KEY_FILE):
            contents[f"{TLS}{name}"] = read_bytes(inputs.tls / name, "TLS file")
    packages = set()
    for path in inputs.wheels:
        package, _, rest = path.name.partition("-")
        if package.lower() in packages:
            raise UserError(f"wheel {path}: the bundle has another {package}")
        packages.add(package.lower())
        # Without the tags, which were pip's concern and make some names too long for a tar.
        name = f"{WHEELS}{package}-{rest.split('-')[0]}.whl"
        contents[name] = read_bytes(path, "wheel")
    # The version ends with a hash of all the rest, so it always means the same bytes.
    draft = BundleManifest("draft", target, config.vehicle_id, policy.policy_id)
    digest = hashlib.sha256(to_json(draft))
    for name, data in sorted(contents.items()):
        digest.update(f"{name} {hashlib.sha256(data).hexdigest()}\n".encode())
    hashes = policy.policy_id[:_DIGITS], digest.hexdigest()[:_DIGITS]
    return contents, draft._replace(version="-".join([edge_runtime.__version__, *hashes]))


def _check_vehicle(config: Config, manifest: Manifest, wheels: list[Path]) -> None:
    """Raise UserError for a vehicle that no wheel brings, or settings that do not hold."""
    name, colon, _ = config.vehicle.partition(":")
    brought = set().union(*map(_drivers_in, wheels))
    if name in (NONE, *BUILT_IN):
        limits = vehicle_limits(config.vehicle, config.vehicle_settings, manifest)
        shared_limits(manifest.action, limits)
    elif (name.split(".")[0] if colon else name) + colon not in brought:
        known = ", ".join((NONE, *BUILT_IN))
        raise UserError(
            f"vehicle {config.vehicle!r} is in no wheel of the bundle: name its driver's with"
            f" --with, or choose from {known}"
        )


def _drivers_in(path: Path) -> set[str]:
    """The vehicles that a wheel names in its entry points, and its top modules, as `module:`."""
    try:
        with zipfile.ZipFile(path) as wheel:
            names = wheel.namelist()
    except (OSError, zipfile.BadZipFile) as error:
        raise UserError(f"wheel {path} cannot be read: {error}") from None
    points = [point for each in distributions(path=[str(path)]) for point in each.entry_points]
    modules = {name.split("/")[0].removesuffix(".py") for name in names}
    return {point.name for point in points if point.group == GROUP} | {f"{m}:" for m in modules}


def _settings(inputs: Inputs) -> tuple[Config, bytes]:
    """The settings, checked as `run` checks them, and the file that the board gets."""
    flags = {"policy": str(inputs.policy), "tls": inputs.tls and str(inputs.tls)}
    config = load_config(inputs.config, flags)
    given = inputs.config.read_text("utf-8") if inputs.config else ""
    keys = read_toml(inputs.config, "config file") if inputs.config else {}
    for name in _OF_THE_BUNDLE:
        if name in keys:
            raise UserError(f"config file {inputs.config}: the bundle sets {name}; leave it out")
    if "armed_at_start" in keys and config.armed_at_start and config.vehicle != NONE:
        raise UserError(
            f"config file {inputs.config}: armed_at_start would let a machine move the vehicle"
            " when it starts; leave it out"
        )
    lines = [
        "# Made by `deploy bundle`; paths are of the release's folder, where the service starts.",
        f'policy = "{POLICY}"',
        f'public_key = "{PUBLIC_KEY}"',
        f'hold = "{HOLD}"',
        *([f'tls = "{TLS.rstrip("/")}"'] if inputs.tls else []),
        *([] if "armed_at_start" in keys else ["armed_at_start = false"]),
        "",
        given.strip(),
    ]
    return config, ("\n".join(lines).rstrip() + "\n").encode()


def pack(contents: dict[str, bytes]) -> bytes:
    """Make a tar of files in the order of their names: owner 0, time 0, mode 0600."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in sorted(contents.items()):
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(data), 0o600
            tar.addfile(member, io.BytesIO(data))
    return packed.getvalue()


def sign(data: bytes, key: Ed25519PrivateKey) -> bytes:
    """Make the signature that the board's `ssh-keygen -Y verify` takes; the same one each time.

    ssh-keygen reads the key from a file in memory: no copy of it comes onto the disk.
    """
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption())
    with open(os.memfd_create("key"), "wb", buffering=0) as file:
        os.fchmod(file.fileno(), 0o600)  # it takes no key that others could read
        file.write(pem)
        command = ["ssh-keygen", "-q", "-Y", "sign", "-n", NAMESPACE, "-f",
                   f"/proc/self/fd/{file.fileno()}"]  # fmt: skip
        done = subprocess.run(
            command, input=data, capture_output=True, check=False, pass_fds=[file.fileno()]
        )
    if done.returncode != 0:
        raise UserError(f"ssh-keygen does not sign: {done.stderr.decode(errors='replace')}")
    return done.stdout


def build_installer() -> bytes:
    """Make `install.pyz`."""
    sources = [
        *sorted((ROOT / "deploy/installer").glob("*.py")),
        *(ROOT / f"edge_runtime/{name}.py" for name in ("__init__", "cli", "files", "util")),
    ]
    members = {"__main__.py": _MAIN, "deploy/__init__.py": ""}
    members.update((path.relative_to(ROOT).as_posix(), path.read_text()) for path in sources)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, text in members.items():
            info = zipfile.ZipInfo(name)  # of 1980, so that the same files give the same bytes
            info.external_attr = 0o100644 << 16
            archive.writestr(info, text)
    return packed.getvalue()


def lock_path(target: Target) -> Path:
    """The file that names every wheel of a target by version and hash, as pip reads it."""
    return ROOT / f"requirements/bundle-{target.name}.txt"


def gather(target: Target, lock: Path, kept: Path, place: Path) -> list[Path]:
    """Bring the lock's wheels to `place`, by way of the folder where they are kept.

    pip checks every hash, and asks an index only where a wheel is missing.
    """
    make_directory(kept)
    locked = ("--require-hashes", "--requirement", str(lock), "--find-links", str(kept))
    try:
        _download(target, place, "--no-index", *locked)
    except UserError:
        _download(target, kept, *locked)
        _download(target, place, "--no-index", *locked)
    return sorted(place.glob("*.whl"))


def _download(target: Target, folder: Path, *wanted: str) -> None:
    """Let pip bring wheels for another computer. Raises UserError with pip's own line."""
    newest = int(target.glibc.split(".")[1])
    tags = [*(f"manylinux_2_{minor}" for minor in range(newest + 1)), "manylinux1", "manylinux2010",
            "manylinux2014", "linux"]  # fmt: skip
    pip(
        "download", "--only-binary=:all:", "--no-deps",
        f"--python-version={target.python}.{_PATCH}",
        *(f"--platform={tag}_{target.machine}" for tag in tags),
        "--dest", str(folder), *wanted,
    )  # fmt: skip


def build_edge_wheel(folder: Path) -> Path:
    """Make the edge runtime's wheel, the same bytes from the same sources and setuptools."""
    with tempfile.TemporaryDirectory() as place:
        # Of a copy: building writes into its source folder.
        source = Path(place) / "edge_runtime"
        ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info", "tests")
        shutil.copytree(ROOT / "edge_runtime", source, ignore=ignored)
        for path in source.rglob("*"):
            path.chmod(0o755 if path.is_dir() else 0o644)  # the umask of whoever cloned it
        # With the setuptools that is here: no index is asked.
        pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(source))
    return next(folder.glob("phil_edge_runtime-*.whl"))


def pip(*arguments: str) -> None:
    """Run pip, on a terminal with its progress. Raises UserError with its last line of an error."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": str(_EPOCH_S)}
    shown = sys.stderr if sys.stderr.isatty() else subprocess.DEVNULL
    done = subprocess.run(
        command, stdout=shown, stderr=subprocess.PIPE, text=True, check=False, env=environment
    )
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise UserError(f"pip {arguments[0]}: {(lines or ['failed'])[-1]}")


def _add_lock_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("target", choices=TARGETS, help="kind of board")


def _run_lock(arguments: argparse.Namespace) -> int:
    """Download each NAME==VERSION of the lock and write the hash of its wheel beside it."""
    target = TARGETS[arguments.target]
    path = lock_path(target)
    lines = path.read_text().splitlines()
    for number, line in enumerate(lines):
        if "==" in line and not line.startswith("#"):
            pin = line.split()[0]
            with tempfile.TemporaryDirectory() as place:
                _download(target, Path(place), pin)
                (wheel,) = Path(place).iterdir()
                digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
            lines[number] = f"{pin} --hash=sha256:{digest}"
    write_atomic(path, ("\n".join(lines) + "\n").encode())
    print(path)
    return 0


BUNDLE = Subcommand(
    examples(
        "python -m deploy bundle --policy results/policies/left_turn.onnx \\\n"
        "    --public-key results/policies/policy.pub --target jetpack5 --key keys/policy.key \\\n"
        "    --config edge.toml --tls certs/edge-hunter01",
        "python -m deploy bundle --policy my.onnx --target jetpack5 --config edge.toml \\\n"
        "    --with my_vehicle-0.1.0-py3-none-any.whl",
    ),
    _add_bundle_arguments,
    _run_bundle,
)
LOCK = Subcommand(examples("python -m deploy lock jetpack5"), _add_lock_arguments, _run_lock)
