"""``python -m deploy bundle`` and ``push``: what a board needs to drive one policy, in one archive.

The same inputs give the same bytes: the archive holds no time, place or user name. A lock names
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
"""A password asked for in the middle would hang a script, and so would a board without power."""
TARGETS = {  # Python, processor, and the oldest C library
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


def run_bundle(given: argparse.Namespace) -> int:
    collect(given)  # What can be wrong is said before minutes of downloads.
    with tempfile.TemporaryDirectory() as place:
        if given.wheels:  # pip refuses those that do not fit the target.
            download(given.target, place, "--no-index", *map(str, given.wheels))
        gather(given.target, place)
        edge_wheel = Path(place, f"phil_edge_runtime-{__version__}-py3-none-any.whl")
        edge_wheel.write_bytes(build_edge_wheel())
        given.wheels = sorted(Path(place).iterdir())
        path, manifest = make_bundle(given)
    print(f"{path}  ({path.stat().st_size / 1e6:.1f} MB), signed by {path.name}.sig")
    print(f"version {manifest.version}, for {manifest.vehicle_id}")
    return 0


def make_bundle(given: argparse.Namespace) -> tuple[Path, Manifest]:
    """Write `phil-TARGET-VEHICLE-VERSION.tar`, mode 0600, and its signature into `out`."""
    contents, manifest = collect(given)
    packed = pack(contents)
    path = given.out / f"phil-{given.target}-{manifest.vehicle_id}-{manifest.version}.tar"
    write_atomic(f"{path}.sig", sign(packed, tls.read_signing_key(given.key)))
    write_private(path, packed)  # it holds a private key
    return path, manifest


def collect(given: argparse.Namespace) -> tuple[dict[str, bytes], Manifest]:
    """Return a bundle's files, by path, and its manifest. Raises UserError for what is wrong."""
    tls.read_signing_key(given.key)
    policy = load_policy(given.policy, given.public_key)
    flags = {"policy": str(given.policy), "tls": given.tls and str(given.tls)}
    config = load_config(given.config, flags)
    if config.vehicle in BUILT_IN or not given.wheels:  # A driver in a wheel is not installed here.
        limits = vehicle_limits(
            config.vehicle, config.vehicle_settings, policy.manifest, config.bounds
        )
        shared_limits(policy.manifest.action, limits)
    contents = {
        NAME: build_installer(),
        release.POLICY: read_bytes(given.policy, "policy file", MAX_POLICY_MIB),
        f"{release.POLICY}.sig": read_bytes(f"{given.policy}.sig", "signature"),
        release.PUBLIC_KEY: read_bytes(given.public_key, "public key"),
        release.CONFIG: _settings(given.config, given.tls is not None),
        **{f"units/{path.name}": path.read_bytes() for path in (ROOT / "deploy/systemd").iterdir()},
    }
    if given.tls is not None:  # The party's three files, and none that may stand beside them.
        tls.check_name(tls.load_tls(given.tls).name, tls.common_name(tls.EDGE, config.vehicle_id))
        for name in (tls.CA_FILE, tls.CERTIFICATE_FILE, tls.KEY_FILE):
            contents[f"{release.TLS}{name}"] = read_bytes(given.tls / name, "TLS file")
    for path in given.wheels:  # Without the tags, which make some names too long for a tar.
        package, version, *_ = path.name.split("-")
        contents[f"{release.WHEELS}{package}-{version}.whl"] = read_bytes(path, "wheel")
    # The version ends with a hash of all the rest, so it always means the same bytes.
    draft = Manifest("", config.vehicle_id, policy.policy_id, *TARGETS[given.target])
    contents[release.MANIFEST] = json.dumps(draft._asdict()).encode()
    digest = hashlib.sha256(pack(contents)).hexdigest()
    manifest = draft._replace(version=f"{__version__}-{policy.policy_id[:8]}-{digest[:8]}")
    contents[release.MANIFEST] = json.dumps(manifest._asdict()).encode()
    return contents, manifest


def _settings(config: Path | None, with_tls: bool) -> bytes:
    """Return the file that the board gets: the given settings behind those of the bundle."""
    given = read_toml(config, "config file") if config else {}
    if wrong := [name for name in given if name in _OF_THE_BUNDLE and given[name] is not False]:
        raise UserError(f"config file {config}: leave {', '.join(wrong)} to the bundle")
    lines = [
        "# Made by `deploy bundle`; paths are of the release's folder, where the service starts.",
        f'policy = "{release.POLICY}"',
        f'public_key = "{release.PUBLIC_KEY}"',
        ""
        if "armed_at_start" in given
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
    """Make the signature that the board's `ssh-keygen -Y verify` takes; the same one each time."""
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
    """Make what the board imports of the edge runtime: packages only, for it is not installed."""
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
    """The file that names every wheel of a target by version and hash, as pip reads it."""
    return ROOT / f"requirements/bundle-{target}.txt"


def gather(target: str, place: str) -> None:
    """Bring the lock's wheels to `place`; an index is asked only for those that are not kept."""
    kept = str(KEPT_WHEELS / target)
    locked = ("--require-hashes", "--requirement", str(lock_path(target)), "--find-links", kept)
    try:
        download(target, place, "--no-index", *locked)
    except UserError:
        download(target, kept, *locked)
        download(target, place, "--no-index", *locked)


def download(target: str, folder: str, *wanted: str) -> None:
    """Let pip bring wheels for another computer. Raises UserError with pip's last line."""
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


def run_push(given: argparse.Namespace) -> int:
    """Copy and install over ssh; return the first status that is not 0."""
    # What the board would refuse is not sent.
    manifest, _ = release.read_bundle(given.bundle, release.read_public_key(given.trust))
    place = f"phil-push-{manifest.version}"
    install = ["sudo", "-n", f"python{manifest.python}", f"{place}/{NAME}", "install"]
    install += [f"{place}/{given.bundle.name}", "--trust", f"{place}/{given.trust.name}"]
    with tempfile.TemporaryDirectory() as folder:
        # This workstation's own: what verifies the bundle must not come out of it.
        installer = Path(folder, NAME)
        installer.write_bytes(build_installer())
        # Absolute: scp would take "a:b" for a file of the host a.
        files = (given.bundle, Path(f"{given.bundle}.sig"), given.trust, installer)
        ssh = ["ssh", *UNATTENDED, "--", given.host]
        for command in (
            [*ssh, f"umask 077 && mkdir -p {place}"],
            ["scp", "-q", *UNATTENDED, "--", *(str(path.absolute()) for path in files),
             f"{given.host}:{place}/"],
            [*ssh, f"{shlex.join(install)}; s=$?; rm -rf {place}; exit $s"],
        ):  # fmt: skip
            print(shlex.join(command), flush=True)
            if not given.dry_run:
                done = subprocess.run(command, stdin=subprocess.DEVNULL, check=False)
                if done.returncode != 0:
                    return done.returncode
    return 0
