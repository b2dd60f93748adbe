"""``python -m deploy bundle`` and ``push``: all that a board needs for one policy, in one archive.

The same inputs give the same bytes: the archive holds no time, path or user name. A lock file names
every wheel by version and hash; only the first bundle needs a network.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import io
import json
import shlex
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

from cryptography.hazmat.primitives import serialization as form
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from deploy.certs import DEFAULT_KEY, write_private
from deploy.installer import release
from deploy.installer.release import Manifest
from edge_runtime import __version__, tls
from edge_runtime.cli import command
from edge_runtime.config import BUILT_IN, load_config
from edge_runtime.controller import shared_limits
from edge_runtime.files import write_atomic
from edge_runtime.policy import MAX_POLICY_MIB, load_policy
from edge_runtime.util import DEFAULT_PUBLIC_KEY, UserError, read_bytes, read_toml
from edge_runtime.vehicles import vehicle_limits

ROOT = Path(__file__).parents[1]
NAME = "install.pyz"
DEFAULT_OUT, KEPT_WHEELS = Path("build/bundles"), Path("build/wheels")
_OF_THE_BUNDLE = {"policy", "tls", "public_key", "allow_unsigned", "armed_at_start"}
_MAIN = """\
import sys
from deploy.installer.__main__ import main
sys.exit(main(sys.argv[1:]))
"""
UNATTENDED = ("-o", "BatchMode=yes", "-o", "ConnectTimeout=10")
"""Without them a password prompt, or a board without power, would hang a script."""
TARGETS = {  # Python, processor, oldest glibc
    "jetpack5": ("3.8", "aarch64", "2.31"),  # Jetson Xavier NX: Ubuntu 20.04
    "linux-aarch64": ("3.9", "aarch64", "2.31"),  # Debian bullseye
    "linux-x86_64": ("3.8", "x86_64", "2.31"),  # jetpack5's versions on a workstation
}


@command(
    "deploy.bundle:run_bundle",
    "python -m deploy bundle --policy results/policies/left_turn.onnx \\\n"
    "    --public-key results/policies/policy.pub --target jetpack5 --key keys/policy.key \\\n"
    "    --config edge.toml --tls certs/edge-hunter01",
)
def bundle(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--target", choices=TARGETS, required=True, help="kind of board")
    add = functools.partial(parser.add_argument, type=Path, metavar="FILE")
    add("--policy", required=True, help="signed policy file")
    add("--config", help="settings of `edge_runtime run`: connect, vehicle, ... (TOML)")
    add("--public-key", default=DEFAULT_PUBLIC_KEY, help="public key of the policy's signer")
    add("--key", default=DEFAULT_KEY, help="private key that signs the bundle")
    add("--tls", metavar="DIR", help="the vehicle's certificates, such as certs/edge-hunter01")
    driver = "wheel to install, too, such as a vehicle's driver; may be repeated"
    add("--with", dest="wheels", action="append", default=[], help=driver)
    add("--out", metavar="DIR", default=DEFAULT_OUT, help="folder for the bundle")


def run_bundle(arguments: argparse.Namespace) -> int:
    collect(arguments)  # Reports errors before minutes of downloads.
    with tempfile.TemporaryDirectory() as place:
        if arguments.wheels:  # pip refuses those that do not fit the target.
            download(arguments.target, place, "--no-index", *map(str, arguments.wheels))
        gather(arguments.target, place)
        edge_wheel = Path(place, f"phil_edge_runtime-{__version__}-py3-none-any.whl")
        edge_wheel.write_bytes(build_edge_wheel())
        arguments.wheels = sorted(Path(place).iterdir())
        path, manifest = make_bundle(arguments)
    print(f"{path}  ({path.stat().st_size / 1e6:.1f} MB), signed by {path.name}.sig")
    print(f"version {manifest.version}, for {manifest.vehicle_id}")
    return 0


def make_bundle(arguments: argparse.Namespace) -> tuple[Path, Manifest]:
    """Write `phil-TARGET-VEHICLE-VERSION.tar`, mode 0600, and its signature into `out`."""
    contents, manifest = collect(arguments)
    packed = pack(contents)
    path = arguments.out / f"phil-{arguments.target}-{manifest.vehicle_id}-{manifest.version}.tar"
    write_atomic(f"{path}.sig", sign(packed, tls.read_signing_key(arguments.key)))
    write_private(path, packed)  # it holds a private key
    return path, manifest


def collect(arguments: argparse.Namespace) -> tuple[dict[str, bytes], Manifest]:
    """Check the options; return a bundle's files by path, and its manifest. Raises UserError."""
    tls.read_signing_key(arguments.key)
    policy = load_policy(arguments.policy, arguments.public_key)
    flags = {"policy": str(arguments.policy), "tls": arguments.tls and str(arguments.tls)}
    config = load_config(arguments.config, flags)
    if config.vehicle in BUILT_IN or not arguments.wheels:  # A wheel's driver is not installed here
        limits = vehicle_limits(
            config.vehicle, config.vehicle_settings, policy.manifest, config.bounds
        )
        shared_limits(policy.manifest.action, limits)
    contents = {
        NAME: build_installer(),
        release.POLICY: read_bytes(arguments.policy, "policy file", MAX_POLICY_MIB),
        f"{release.POLICY}.sig": read_bytes(f"{arguments.policy}.sig", "signature"),
        release.PUBLIC_KEY: read_bytes(arguments.public_key, "public key"),
        release.CONFIG: _settings(arguments.config, arguments.tls is not None),
        **{f"units/{path.name}": path.read_bytes() for path in (ROOT / "deploy/systemd").iterdir()},
    }
    if (folder := arguments.tls) is not None:  # The party's three files only
        tls.check_name(tls.load_tls(folder).name, tls.common_name(tls.EDGE, config.vehicle_id))
        for name in (tls.CA_FILE, tls.CERTIFICATE_FILE, tls.KEY_FILE):
            contents[f"{release.TLS}{name}"] = read_bytes(folder / name, "TLS file")
    for path in arguments.wheels:  # Without the tags, which make some names too long for a tar.
        package, version, *_ = path.name.split("-")
        contents[f"{release.WHEELS}{package}-{version}.whl"] = read_bytes(path, "wheel")
    # The version ends with a hash of everything else, so it always names the same bytes.
    draft = Manifest("", config.vehicle_id, policy.policy_id, *TARGETS[arguments.target])
    contents[release.MANIFEST] = json.dumps(draft._asdict()).encode()
    digest = hashlib.sha256(pack(contents)).hexdigest()
    manifest = draft._replace(version=f"{__version__}-{policy.policy_id[:8]}-{digest[:8]}")
    contents[release.MANIFEST] = json.dumps(manifest._asdict()).encode()
    return contents, manifest


def _settings(config: Path | None, with_tls: bool) -> bytes:
    """Return the board's settings file: the bundle's own settings, then those of ``config``."""
    table = read_toml(config, "config file") if config else {}
    if wrong := [name for name in table if name in _OF_THE_BUNDLE and table[name] is not False]:
        raise UserError(f"config file {config}: leave {', '.join(wrong)} to the bundle")
    lines = [
        "# Made by `deploy bundle`; paths start at the release's folder, where the service runs.",
        f'policy = "{release.POLICY}"',
        f'public_key = "{release.PUBLIC_KEY}"',
        ""
        if "armed_at_start" in table
        else "armed_at_start = false  # nobody sees a service start",
        f'tls = "{release.TLS}"' if with_tls else "",
        config.read_text("utf-8") if config else "",
    ]
    return "\n".join(lines).encode()


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
    """Make the signature that the board's `ssh-keygen -Y verify` takes; it is deterministic."""
    kind, no_password = form.PrivateFormat.OpenSSH, form.NoEncryption()
    with tempfile.NamedTemporaryFile() as file:  # mode 0600
        file.write(key.private_bytes(form.Encoding.PEM, kind, no_password))
        file.flush()
        command = ["ssh-keygen", "-q", "-Y", "sign", "-n", release.NAMESPACE, "-f", file.name]
        return subprocess.run(command, input=data, stdout=subprocess.PIPE, check=True).stdout


def build_installer() -> bytes:
    shared = (ROOT / f"edge_runtime/{name}.py" for name in ("__init__", "cli", "files", "util"))
    sources = [*(ROOT / "deploy/installer").glob("*.py"), *shared]
    return _zip(sources, {"__main__.py": _MAIN, "deploy/__init__.py": ""})


def build_edge_wheel() -> bytes:
    """Make a wheel of the edge runtime's packages, without metadata: pip does not install it."""
    folder = ROOT / "edge_runtime"
    return _zip([p for p in folder.rglob("*.py") if "tests" not in p.relative_to(folder).parts], {})


def _zip(sources: Sequence[Path], members: dict[str, str]) -> bytes:
    members |= {path.relative_to(ROOT).as_posix(): path.read_text() for path in sources}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, text in sorted(members.items()):
            info = zipfile.ZipInfo(name)  # of 1980: the same files give the same bytes
            archive.writestr(info, text, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def lock_path(target: str) -> Path:
    """Return the lock file of a target: pip's list of every wheel by version and hash."""
    return ROOT / f"requirements/bundle-{target}.txt"


def gather(target: str, place: str) -> None:
    """Copy the lock file's wheels to `place`; download only those that are not kept."""
    kept = str(KEPT_WHEELS / target)
    locked = ("--require-hashes", "--requirement", str(lock_path(target)), "--find-links", kept)
    try:
        download(target, place, "--no-index", *locked)
    except UserError:
        download(target, kept, *locked)
        download(target, place, "--no-index", *locked)


def download(target: str, folder: str, *wanted: str) -> None:
    """Download wheels for another computer by pip. Raises UserError with pip's last line."""
    python, machine, glibc = TARGETS[target]
    minors = range(int(glibc.split(".")[1]) + 1)
    tags = ["linux", *(f"manylinux{n}" for n in (1, 2010, 2014, *(f"_2_{m}" for m in minors)))]
    command = [
        *(sys.executable, "-m", "pip", "--disable-pip-version-check", "download"),
        *("--only-binary=:all:", "--no-deps", "--dest", folder),
        # pip reads 3.9 as 3.9.0, which cryptography excludes; Debian bullseye has 3.9.2.
        *(f"--python-version={python}.2", *wanted),
        *(f"--platform={tag}_{machine}" for tag in tags),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise UserError(f"pip: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")


@command(
    "deploy.bundle:run_push",
    "python -m deploy push user@board phil-jetpack5-1.tar --trust keys/policy.pub",
)
def push(parser: argparse.ArgumentParser) -> None:
    trust = "public half of the key that signed the bundle; a new board will trust it"
    add = parser.add_argument
    add("host", metavar="HOST", help="[user@]name, as ssh knows it")
    add("bundle", metavar="BUNDLE.tar", type=Path, help="bundle of `python -m deploy bundle`")
    add("--trust", metavar="KEY.pub", type=Path, default=DEFAULT_PUBLIC_KEY, help=trust)
    add("--dry-run", action="store_true", help="print each command and do nothing")


def run_push(arguments: argparse.Namespace) -> int:
    """Copy and install over ssh; return the first status that is not 0."""
    # Verified here, too: the board would refuse it only after the copy.
    manifest, _ = release.read_bundle(arguments.bundle, release.read_public_key(arguments.trust))
    place = f"phil-push-{manifest.version}"
    install = ["sudo", "-n", f"python{manifest.python}", f"{place}/{NAME}", "install"]
    install += [f"{place}/{arguments.bundle.name}", "--trust", f"{place}/{arguments.trust.name}"]
    with tempfile.TemporaryDirectory() as folder:
        # The workstation's own: the verifier must not come out of the bundle.
        installer = Path(folder, NAME)
        installer.write_bytes(build_installer())
        # Absolute paths: scp reads "a:b" as a file of the host a.
        files = (arguments.bundle, Path(f"{arguments.bundle}.sig"), arguments.trust, installer)
        ssh = ["ssh", *UNATTENDED, "--", arguments.host]
        for command in (
            [*ssh, f"umask 077 && mkdir -p {place}"],
            ["scp", "-q", *UNATTENDED, "--", *(str(path.absolute()) for path in files),
             f"{arguments.host}:{place}/"],
            [*ssh, f"{shlex.join(install)}; s=$?; rm -rf {place}; exit $s"],
        ):  # fmt: skip
            print(shlex.join(command), flush=True)
            if not arguments.dry_run:
                done = subprocess.run(command, stdin=subprocess.DEVNULL, check=False)
                if done.returncode != 0:
                    return done.returncode
    return 0
