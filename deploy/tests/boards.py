"""Boards for the tests: a folder, the real installer as a process, the real edge runtime in it.

The bundle's wheels are the edge runtime's own and one of a single line, which points at the
libraries of the Python that runs the tests: nothing is downloaded and little is unpacked.
"""

import io
import json
import platform
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from deploy.bundle import NAME, Inputs, Made, build_installer, make_bundle
from deploy.certs import write_key_pair
from deploy.installer.verify import Target
from edge_runtime.reach import free_endpoint
from hil_tests.testing.policies import public_pem, write_policy

QUICK = ("--settle", "0.2")
PYTHON = f"{sys.version_info[0]}.{sys.version_info[1]}"
HERE = Target(name="here", python=PYTHON, machine=platform.machine(), glibc="2.17")


def changed_wheel(wheel: Path, out: Path, member: str, old: str, new: str) -> Path:
    """The wheel with a text replaced in one file: a release with a fault."""
    changed = io.BytesIO()
    with zipfile.ZipFile(wheel) as source, zipfile.ZipFile(changed, "w") as target:
        for info in source.infolist():
            data = source.read(info)
            if info.filename == member:
                assert old in data.decode()
                data = data.decode().replace(old, new).encode()
            target.writestr(info, data)
    out.mkdir(exist_ok=True)
    path = out / wheel.name
    path.write_bytes(changed.getvalue())
    return path


class Workshop:
    """Makes bundles: one key, one endpoint, a policy for each value."""

    def __init__(self, folder: Path, edge_wheel: Path) -> None:
        self.folder = folder
        self.edge_wheel = edge_wheel
        self.key, self.public_key = write_key_pair(folder / "keys")
        self.host = folder / "host-1.0-py3-none-any.whl"  # it holds a path file only
        with zipfile.ZipFile(self.host, "w") as wheel:
            wheel.writestr("host.pth", f"{Path(numpy.__file__).parents[1]}\n")
        self.endpoint = free_endpoint()
        (folder / NAME).write_bytes(build_installer())

    def inputs(self, value: float = 0.1, **changes: object) -> Inputs:
        """What a good bundle is made of; the policy always answers `value`."""
        policy, public = self.folder / f"{value}.onnx", self.folder / f"{value}.pub"
        if not policy.exists():
            key = Ed25519PrivateKey.generate()
            public.write_bytes(public_pem(key))
            write_policy(policy, "constant", value=value, key=key)
        config = self.folder / "config.toml"
        config.write_text(f'connect = "{self.endpoint}"\n')
        wheels = [self.edge_wheel, self.host]
        inputs = Inputs(policy, public, self.key, config, None, wheels)
        return inputs._replace(**changes)  # type: ignore[arg-type]

    def make(self, value: float = 0.1, **changes: object) -> Made:
        return make_bundle(self.inputs(value, **changes), HERE, self.folder / "bundles")


class Board:
    def __init__(self, root: Path, workshop: Workshop) -> None:
        self.root = root
        self.workshop = workshop
        self.installer = ["-I", str(workshop.folder / NAME)]

    def runs_a_process(self) -> None:
        """From now on the installer runs a release as a process (process_service.py)."""
        self.installer = ["-m", "deploy.tests.process_service"]

    def command(self, command: str, *arguments: object) -> list[str]:
        words = [*self.installer, command, "--root", self.root, *arguments]
        return [sys.executable, *map(str, words)]

    def run(self, command: str, *arguments: object):
        line = self.command(command, *arguments)
        return subprocess.run(line, capture_output=True, text=True, timeout=120)

    def install(self, bundle: Path, *more: str):
        return self.run("install", bundle, "--trust", self.workshop.public_key, *QUICK, *more)

    def status(self) -> dict:
        done = self.run("status", "--json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    def fingerprint(self) -> list[tuple]:
        """Every path with size and time: equal where nothing was written."""
        found = ((str(path), path.lstat()) for path in self.root.rglob("*"))
        return sorted((path, stat.st_size, stat.st_mtime_ns) for path, stat in found)
