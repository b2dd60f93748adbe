"""Boards for the tests: a folder, the real installer as a process, the real edge runtime in it."""

import json
import platform
import subprocess
import sys
import zipfile
from argparse import Namespace
from pathlib import Path

import numpy
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from deploy.bundle import NAME, build_edge_wheel, build_installer, make_bundle
from deploy.certs import write_key_pair
from deploy.installer.release import Manifest
from edge_runtime.reach import free_endpoint
from hil_tests.tests.shared.policies import public_pem, write_policy

HERE = (f"{sys.version_info[0]}.{sys.version_info[1]}", platform.machine(), "2.17")


class Workshop:
    """Makes bundles for this computer: one key, one endpoint, a policy for each value."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.edge_wheel = folder / "phil_edge_runtime-0.1.0-py3-none-any.whl"
        self.edge_wheel.write_bytes(build_edge_wheel())
        self.key, self.public_key = write_key_pair(folder / "keys")
        # No code: a path to the libraries of the Python that runs the tests.
        self.host = folder / "host-1.0-py3-none-any.whl"
        with zipfile.ZipFile(self.host, "w") as wheel:
            wheel.writestr("host.pth", f"{Path(numpy.__file__).parents[1]}\n")
            wheel.writestr("host-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\n")
            about = "Metadata-Version: 2.1\nName: host\nVersion: 1.0\n"
            wheel.writestr("host-1.0.dist-info/METADATA", about)
        self.endpoint = free_endpoint()
        (folder / NAME).write_bytes(build_installer())

    def inputs(self, value: float = 0.1, **changes: object) -> Namespace:
        """What a good bundle is made of; the policy always answers `value`."""
        policy, public = self.folder / f"{value}.onnx", self.folder / f"{value}.pub"
        if not policy.exists():
            key = Ed25519PrivateKey.generate()
            public.write_bytes(public_pem(key))
            write_policy(policy, "constant", value=value, key=key)
        config = self.folder / "config.toml"
        config.write_text(f'connect = "{self.endpoint}"\n')
        given = Namespace(policy=policy, public_key=public, key=self.key, config=config, tls=None)
        given.wheels, given.target = [self.edge_wheel, self.host], "here"
        given.out = self.folder / "bundles"
        vars(given).update(changes)
        return given

    def make(self, value: float = 0.1, **changes: object) -> tuple[Path, Manifest]:
        return make_bundle(self.inputs(value, **changes))

    def make_faulty(self, value: float, member: str, old: str, new: str, **changes: object):
        """Make a bundle whose edge runtime has a text replaced in one file."""
        wheel = self.folder / f"faulty-{value}-py3-none-any.whl"
        with zipfile.ZipFile(self.edge_wheel) as source, zipfile.ZipFile(wheel, "w") as target:
            texts = {name: source.read(name).decode() for name in source.namelist()}
            assert old in texts[member]
            texts[member] = texts[member].replace(old, new)
            for name, text in texts.items():
                target.writestr(name, text)
        return self.make(value, wheels=[wheel, self.host], **changes)


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

    def install(self, bundle: Path):
        return self.run("install", bundle, "--trust", self.workshop.public_key)

    def status(self) -> dict:
        done = self.run("status")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)
