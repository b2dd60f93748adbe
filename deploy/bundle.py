"""``python -m deploy bundle``: all that a board needs to drive one policy, in one signed archive.

The same inputs give the same bytes: the archive holds no time, place or user name. A lock names
every wheel of a kind of board by version and hash. A folder keeps the wheels between runs, so a
bundle made from a full folder needs no network. After a change of versions in a lock,
``python -m deploy lock TARGET`` writes the new hashes.
"""

from __future__ import annotations

import argparse
import configparser
import contextlib
import functools
import hashlib
import importlib.metadata
import io
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from packaging.tags import compatible_tags, cpython_tags
from packaging.utils import InvalidWheelFilename, canonicalize_name, parse_wheel_filename

import deploy.installer
import edge_runtime
from deploy.certs import DEFAULT_KEY, write_private
from deploy.installer.layout import CONFIG, NO_ZIP, POLICY, PUBLIC_KEY, TLS, WHEELS
from deploy.installer.verify import MANIFEST, NAMESPACE, Manifest, Target, to_json
from edge_runtime import tls
from edge_runtime.cli import Command, examples
from edge_runtime.config import BUILT_IN, NONE, Config, load_config
from edge_runtime.controller import shared_limits
from edge_runtime.files import check_writable, make_directory, write_atomic
from edge_runtime.policy import MAX_POLICY_MIB, Policy, load_policy
from edge_runtime.util import DEFAULT_PUBLIC_KEY, UserError, open_regular, read_bytes
from edge_runtime.vehicles import GROUP, find_vehicle, vehicle_limits

NAME = "install.pyz"
EDGE_PACKAGE = "phil-edge-runtime"
DEFAULT_OUT = "build/bundles"
UNITS = Path(__file__).parent / "systemd"
HOLD = "../../state/hold"  # Seen from a release's folder: what the installer locks while it judges
_OF_THE_BUNDLE = ("policy", "tls", "public_key", "allow_unsigned", "hold")
_DIGITS = 8
_MAIN = (
    "import sys\n\nif sys.version_info < (3, 8):\n"
    '    sys.stderr.write("error: Python 3.8 or newer is needed: try python3.8\\n")\n'
    "    sys.exit(2)\n\n"
    "from deploy.installer.__main__ import main\n\n"
    'if __name__ == "__main__":\n    sys.exit(main(sys.argv[1:]))\n'
)

ROOT = Path(__file__).parents[1]
LOCKS = ROOT / "requirements"
DEFAULT_FOLDER = "build/wheels"
TARGETS = {
    name: Target(name, python, machine, glibc="2.31")
    for name, python, machine in (
        ("jetpack5", "3.8", "aarch64"),  # Jetson Xavier NX: Ubuntu 20.04
        ("linux-aarch64", "3.9", "aarch64"),  # Debian bullseye
        ("linux-x86_64", "3.8", "x86_64"),  # jetpack5's versions on a workstation
    )
}
_PATCH = 2  # pip reads 3.9 as 3.9.0, which cryptography excludes; Debian bullseye has 3.9.2.
_LINE = re.compile(r"([A-Za-z0-9._-]+)==([A-Za-z0-9._+!-]+) --hash=sha256:([0-9a-f]{64})")
_SETUPTOOLS = 75  # as edge_runtime/pyproject.toml asks
_EPOCH_S = 315532800
"""1980-01-01, the first day that a ZIP file knows: the built wheel's files bear it."""


class Inputs(NamedTuple):
    """What a bundle is made of: a policy with its signature beside it and the signer's public key,
    the private key that signs the bundle, settings of `run` (None for its defaults), the vehicle's
    folder of `deploy certs`, and all wheels, a vehicle's driver among them.
    """

    policy: Path
    public_key: Path
    key: Path
    config: Path | None
    tls: Path | None
    wheels: list[Path]


class Made(NamedTuple):
    """A bundle on the disk, and the size of each file in it, bytes."""

    path: Path
    manifest: Manifest
    sizes: dict[str, int]


def _add_bundle_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--target", choices=TARGETS, required=True, help="the board's kind")
    add = functools.partial(parser.add_argument, type=Path, metavar="FILE")
    add("--policy", required=True, help="signed policy file")
    add("--config", help="settings of `edge_runtime run`: connect, vehicle, ... (TOML)")
    add("--public-key", default=str(DEFAULT_PUBLIC_KEY), help="public key of the policy's signer")
    add("--key", default=DEFAULT_KEY, help="private key that signs the bundle")
    add = functools.partial(parser.add_argument, type=Path, metavar="DIR")
    add("--tls", help="the vehicle's folder of `deploy certs`, as certs/edge-hunter01")
    driver = "another wheel to install, such as a vehicle's driver; may be repeated"
    parser.add_argument(
        "--with", dest="more", action="append", type=Path, default=[], metavar="WHEEL", help=driver
    )
    add("--wheels", default=DEFAULT_FOLDER, help="wheels are kept here")
    add("--out", default=DEFAULT_OUT, help="where the archive goes")


def _run_bundle(arguments: argparse.Namespace) -> int:
    """Make a bundle and print its size and contents."""
    target, out = TARGETS[arguments.target], arguments.out
    given = {name: getattr(arguments, name) for name in Inputs._fields if name != "wheels"}
    inputs = Inputs(**given, wheels=arguments.more)
    # Before minutes of downloads: the inputs, and where it goes.
    check_inputs(inputs)
    check_wheels(arguments.more, target)
    check_writable(out / "bundle.tar")
    wheels = arguments.more + gather(target, lock_path(target), arguments.wheels / target.name)
    with tempfile.TemporaryDirectory() as place:
        wheels.append(build_edge_wheel(Path(place)))
        made = make_bundle(inputs._replace(wheels=wheels), target, out)
    for name, size in made.sizes.items():
        print(f"{size:>12,}  {name}")
    print(f"{sum(s for n, s in made.sizes.items() if n.startswith(WHEELS)):>12,}  of that, wheels")
    size, manifest = made.path.stat().st_size, made.manifest
    print(f"{size:>12,}  {made.path}  ({size / 1e6:.1f} MB), signed by {made.path.name}.sig")
    print(
        f"version {manifest.version}, for {manifest.vehicle_id}, Python {target.python}"
        f" on {target.machine} with glibc {target.glibc} or newer"
    )
    return 0


def make_bundle(inputs: Inputs, target: Target, out: Path) -> Made:
    """Write `phil-TARGET-VEHICLE-VERSION.tar`, mode 0600, and its signature into `out`.

    Raises UserError, with nothing written, for a policy that may not drive or was not signed by
    the public key's owner, settings that do not hold, certificates of another party, and a key
    that cannot sign.
    """
    key, policy, config, text = check_inputs(inputs)
    contents = {
        NAME: build_installer(),
        POLICY: read_bytes(inputs.policy, "policy file", MAX_POLICY_MIB),
        f"{POLICY}.sig": read_bytes(f"{inputs.policy}.sig", "signature"),
        PUBLIC_KEY: read_bytes(inputs.public_key, "public key"),
        CONFIG: text.encode(),
    }
    for path in sorted(UNITS.glob("*.*")):
        contents[f"units/{path.name}"] = path.read_bytes()
    for path in inputs.wheels:
        # NAME-VERSION: the tags were pip's concern, and make some names too long for a tar.
        name = "-".join(path.name.split("-")[:2])
        if f"{WHEELS}{name}.whl" in contents:
            raise UserError(f"wheel {path}: the bundle has another {name}")
        contents[f"{WHEELS}{name}.whl"] = path.read_bytes()
    if inputs.tls is not None:  # The party's three files, and none that may stand beside them.
        for name in (tls.CA_FILE, tls.CERTIFICATE_FILE, tls.KEY_FILE):
            contents[f"{TLS}{name}"] = read_bytes(inputs.tls / name, "TLS file")
    manifest = _manifest(contents, target, config.vehicle_id, policy.policy_id)
    path = out / f"phil-{target.name}-{config.vehicle_id}-{manifest.version}.tar"
    packed = _pack({MANIFEST: to_json(manifest), **contents})
    signature = _sign(packed, key)
    write_atomic(f"{path}.sig", signature)
    try:
        write_private(path, packed)  # it holds a private key
    finally:
        if not path.exists():
            Path(f"{path}.sig").unlink()
    return Made(path, manifest, {name: len(data) for name, data in sorted(contents.items())})


def check_inputs(inputs: Inputs) -> tuple[Ed25519PrivateKey, Policy, Config, str]:
    """The key, the policy, the settings and their text; UserError for what no bundle may hold."""
    key = tls.read_signing_key(inputs.key)
    if inputs.policy.is_file() and not Path(f"{inputs.policy}.sig").exists():
        # Here, because load_policy would name a flag that no bundle has.
        raise UserError(
            f"policy {inputs.policy} is not signed ({inputs.policy.name}.sig is missing);"
            " `python -m trainer export ... --key KEY` signs it"
        )
    policy = load_policy(inputs.policy, inputs.public_key)
    config, text = _config(inputs)
    _check_vehicle(config, policy, set().union(*map(_drivers_in, inputs.wheels)))
    if inputs.tls is not None:
        tls.check_name(tls.load_tls(inputs.tls).name, tls.common_name(tls.EDGE, config.vehicle_id))
    return key, policy, config, text


def _check_vehicle(config: Config, policy: Policy, brought: set[str]) -> None:
    """Raise UserError for a vehicle that the board could not load, or whose settings do not hold.

    Those of another package's driver are read where it is installed here, too: it need not be.
    """
    name, colon, _ = config.vehicle.partition(":")
    if name in (NONE, *BUILT_IN) or (name in brought and _is_readable(name)):
        limits = vehicle_limits(config.vehicle, config.vehicle_settings, policy.manifest)
        shared_limits(policy.manifest.action, limits)
    elif name + colon not in brought:
        known = ", ".join((NONE, *BUILT_IN))
        raise UserError(
            f"vehicle {config.vehicle!r} is in no wheel of the bundle: name its driver's with"
            f" --with, or choose from {known}"
        )


def _is_readable(name: str) -> bool:
    """Whether a driver can be loaded here, and says its limits without being opened."""
    try:
        return hasattr(find_vehicle(name), "limits")
    except UserError:
        return False


def _drivers_in(path: Path) -> set[str]:
    """The vehicles that a wheel names in its entry points, and all of its modules, as `module:`."""
    try:
        with open_regular(path) as stream, zipfile.ZipFile(stream) as wheel:
            names = wheel.namelist()
            read = [wheel.read(one) for one in names if one.endswith(".dist-info/entry_points.txt")]
        points = configparser.ConfigParser(delimiters=("=",), interpolation=None)
        points.optionxform = str  # type: ignore[assignment,method-assign]  # Else in small letters
        points.read_string("\n".join(text.decode() for text in read))
    except (OSError, *NO_ZIP, configparser.Error, ValueError) as error:
        raise UserError(f"wheel {path} cannot be read: {error}") from None
    modules = {re.sub(r"(/__init__)?\.py$", "", one).replace("/", ".") + ":" for one in names}
    return modules | (set(points[GROUP]) if GROUP in points else set())


def check_wheels(wheels: Sequence[Path], target: Target) -> None:
    """Raise UserError for a wheel that the target cannot run, or whose package it has anyway."""
    version = tuple(map(int, target.python.split(".")))
    platforms = [*_platforms(target), f"linux_{target.machine}"]  # The last: built on the board
    fits = set(cpython_tags(version, platforms=platforms))
    interpreter = f"cp{version[0]}{version[1]}"
    fits.update(compatible_tags(version, interpreter, platforms))
    own = {canonicalize_name(pin.name) for pin in read_lock(lock_path(target))} | {EDGE_PACKAGE}
    for path in wheels:
        try:
            name, _, _, tags = parse_wheel_filename(path.name)
        except InvalidWheelFilename as error:
            raise UserError(f"wheel {path}: {error}") from None
        if not tags & fits:
            board = f"Python {target.python} on {target.machine} with glibc {target.glibc}"
            raise UserError(f"wheel {path} does not fit {board}")
        if name in own:
            raise UserError(f"wheel {path}: the bundle has a {name} of its own")


def _manifest(contents: dict[str, bytes], target: Target, vehicle: str, policy: str) -> Manifest:
    """The version ends with a hash of all the rest, so it always means the same bytes."""
    draft = Manifest("draft", target, vehicle, policy)
    digest = hashlib.sha256(to_json(draft))
    for name, data in sorted(contents.items()):
        digest.update(f"{name} {hashlib.sha256(data).hexdigest()}\n".encode())
    version = f"{edge_runtime.__version__}-{policy[:_DIGITS]}-{digest.hexdigest()[:_DIGITS]}"
    return draft._replace(version=version)


def _pack(contents: dict[str, bytes]) -> bytes:
    """A tar of files in the order of their names: owner 0, time 0, mode 0600."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in sorted(contents.items()):
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(data), 0o600
            try:
                tar.addfile(member, io.BytesIO(data))
            except ValueError:
                raise UserError(f"the name {name} is too long for a bundle") from None
    return packed.getvalue()


def _sign(data: bytes, key: Ed25519PrivateKey) -> bytes:
    """The signature that the board's `ssh-keygen -Y verify` takes; the same one each time.

    ssh-keygen reads the key from a file in memory: no copy of it comes onto the disk.
    """
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption())
    with open(os.memfd_create("key"), "wb") as file:
        os.fchmod(file.fileno(), 0o600)  # it takes no key that others could read
        file.write(pem)
        file.flush()
        command = ["ssh-keygen", "-q", "-Y", "sign", "-n", NAMESPACE, "-f",
                   f"/proc/self/fd/{file.fileno()}"]  # fmt: skip
        try:
            done = subprocess.run(
                command, input=data, capture_output=True, check=False, pass_fds=[file.fileno()]
            )
        except FileNotFoundError:
            raise UserError("ssh-keygen is not installed here (openssh-client)") from None
    if done.returncode != 0:
        raise UserError(f"ssh-keygen does not sign: {done.stderr.decode(errors='replace')}")
    return done.stdout


def _config(inputs: Inputs) -> tuple[Config, str]:
    """The settings, checked as `run` checks them, and the file that the board gets."""
    flags = {"policy": str(inputs.policy), **({"tls": str(inputs.tls)} if inputs.tls else {})}
    config = load_config(inputs.config, flags)
    given = read_bytes(inputs.config, "config file").decode() if inputs.config else ""
    keys = tomllib.loads(given).keys()
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
    text = "\n".join(lines).rstrip() + "\n"
    return config, text


def build_installer() -> bytes:
    """The bytes of `install.pyz`."""
    folder = Path(deploy.installer.__file__).parent
    members = {"__main__.py": _MAIN, "deploy/__init__.py": ""}
    shared = (ROOT / "edge_runtime" / f"{name}.py" for name in ("__init__", "cli", "util"))
    for path in (*sorted(folder.glob("*.py")), *shared):
        members[path.relative_to(ROOT).as_posix()] = path.read_text()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, text in members.items():
            info = zipfile.ZipInfo(name)  # of 1980, so that the same files give the same bytes
            info.external_attr = 0o100644 << 16
            archive.writestr(info, text)
    return packed.getvalue()


class Pin(NamedTuple):
    """One line of a lock; `sha256` in hex, of the one wheel that fits the target."""

    name: str
    version: str
    sha256: str


def lock_path(target: Target) -> Path:
    """The file that names every wheel of a target by version and hash."""
    return LOCKS / f"bundle-{target.name}.txt"


def read_lock(path: Path) -> list[Pin]:
    """The pins of a lock: `NAME==VERSION --hash=sha256:HEX`, one wheel a line."""
    pins = []
    for line in read_bytes(path, "lock").decode().splitlines():
        if line.strip() and not line.startswith("#"):
            found = _LINE.fullmatch(line.strip())
            if found is None:
                raise UserError(f"lock {path}: not NAME==VERSION --hash=sha256:HEX: {line}")
            pins.append(Pin(*found.groups()))
    return pins


def gather(target: Target, lock: Path, folder: Path) -> list[Path]:
    """The lock's wheels in `folder`, in the lock's order; pip fetches what is missing."""
    pins = read_lock(lock)
    found = _by_hash(folder)
    if any(pin.sha256 not in found for pin in pins):
        download(target, ["--require-hashes", "--requirement", str(lock)], folder)
        found = _by_hash(folder)
    missing = [pin.name for pin in pins if pin.sha256 not in found]
    if missing:
        raise UserError(f"no wheel with the lock's hash in {folder} for {', '.join(missing)}")
    return [found[pin.sha256] for pin in pins]


def download(target: Target, wanted: list[str], folder: Path) -> None:
    """`pip download` of wheels for another computer. Raises UserError with pip's own line."""
    make_directory(folder)
    pip(
        "download", "--only-binary=:all:", "--no-deps",
        f"--python-version={target.python}.{_PATCH}",
        *(f"--platform={platform}" for platform in _platforms(target)),
        "--dest", str(folder), *wanted,
    )  # fmt: skip


def _platforms(target: Target) -> list[str]:
    newest = int(target.glibc.split(".")[1])
    tags = [*(f"_2_{minor}" for minor in range(newest + 1)), "1", "2010", "2014"]
    return [f"manylinux{tag}_{target.machine}" for tag in tags]


def build_edge_wheel(folder: Path) -> Path:
    """The edge runtime's wheel, the same bytes from the same sources and the same setuptools."""
    with tempfile.TemporaryDirectory() as place:
        # Of a copy: building writes into its source folder.
        source = Path(place) / "edge_runtime"
        ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info", "tests")
        shutil.copytree(ROOT / "edge_runtime", source, ignore=ignored)
        for path in source.rglob("*"):
            path.chmod(0o755 if path.is_dir() else 0o644)  # the umask of whoever cloned it
        made = Path(place) / "made"
        # With the setuptools that is here, if it is new enough: no index is asked then.
        options = []
        with contextlib.suppress(importlib.metadata.PackageNotFoundError, ValueError):
            if int(importlib.metadata.version("setuptools").split(".")[0]) >= _SETUPTOOLS:
                options = ["--no-build-isolation"]
        pip("wheel", "--no-deps", *options, "--wheel-dir", str(made), str(source))
        make_directory(folder)
        return Path(shutil.move(next(made.glob("*.whl")), folder))


def pip(*arguments: str) -> None:
    """Run pip; on a terminal with its own progress.

    Raises UserError with the last line that begins with ERROR.
    """
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": str(_EPOCH_S)}
    shown = sys.stderr if sys.stderr.isatty() else subprocess.DEVNULL
    done = subprocess.run(
        command, stdout=shown, stderr=subprocess.PIPE, text=True, check=False, env=environment
    )
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise UserError(f"pip {arguments[0]}: {(lines or ['failed'])[-1]}")


def _by_hash(folder: Path) -> dict[str, Path]:
    wheels = sorted(folder.glob("*.whl"))
    return {hashlib.sha256(path.read_bytes()).hexdigest(): path for path in wheels}


def _add_lock_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("target", choices=TARGETS, help="the board's kind")


def _run_lock(arguments: argparse.Namespace) -> int:
    """Download each `NAME==VERSION` of the lock and write the hash of what came beside it."""
    target = TARGETS[arguments.target]
    path = lock_path(target)
    lines = read_bytes(path, "lock").decode().splitlines()
    for number, line in enumerate(lines):
        if line.strip() and not line.startswith("#"):
            pin = line.split()[0]
            with tempfile.TemporaryDirectory() as place:
                download(target, [pin], Path(place))
                (digest,) = _by_hash(Path(place))
            lines[number] = f"{pin} --hash=sha256:{digest}"
    write_atomic(path, ("\n".join(lines) + "\n").encode())
    print(path)
    return 0


BUNDLE = Command(
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
LOCK = Command(examples("python -m deploy lock jetpack5"), _add_lock_arguments, _run_lock)
