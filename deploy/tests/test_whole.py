"""Whole bundles with every wheel: `make test-board`. They need pip's index the first time."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from deploy.bundle import NAME, Inputs, Made, build_installer, make_bundle
from deploy.keys import write_key_pair
from deploy.wheels import DEFAULT_FOLDER, ROOT, TARGETS, build_edge_wheel, gather, lock_path
from edge_runtime.link_probe import free_endpoint
from edge_runtime.tests.harness import Simulator, make_state
from edge_runtime.tests.test_wheel import find_python38
from edge_runtime.util import UserError

pytestmark = [pytest.mark.board, pytest.mark.timeout(900)]
POLICY = ROOT / "results/policies/left_turn.onnx"
MAX_JETPACK5_BYTES = 45_000_000


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Makes a bundle of the policy that comes with the repository."""
    folder = tmp_path_factory.mktemp("whole")
    private, public = write_key_pair(folder / "keys")
    edge = build_edge_wheel(folder / "edge")
    config = folder / "c.toml"
    endpoint = free_endpoint()
    config.write_text(f'connect = "{endpoint}"\n')

    def make(name: str, out: Path) -> tuple[Made, Path, str]:
        target = TARGETS[name]
        try:
            wheels = gather(target, lock_path(target), ROOT / DEFAULT_FOLDER / name)
        except UserError as error:
            if "No matching distribution" in str(error):
                pytest.skip("no package index can be reached")
            raise
        inputs = Inputs(POLICY, POLICY.with_name("policy.pub"), private, config, None,
                        [*wheels, edge])  # fmt: skip
        return make_bundle(inputs, target, out), public, endpoint

    return make


@pytest.mark.parametrize("name", TARGETS)
def test_a_bundle_is_the_same_again_and_the_boards_is_small(make, tmp_path, name):
    one, *_ = make(name, tmp_path / "one")
    two, *_ = make(name, tmp_path / "two")
    assert one.path.read_bytes() == two.path.read_bytes()
    if name == "jetpack5":
        assert one.path.stat().st_size < MAX_JETPACK5_BYTES


def test_the_twin_is_installed_without_network_and_drives(make, tmp_path):
    """Python 3.8, an empty environment, no network: install, drive, and away."""
    python = find_python38()
    if python is None:
        pytest.skip("no Python 3.8 on PATH or under ~/.pyenv")
    made, public, endpoint = make("linux-x86_64", tmp_path)
    (tmp_path / NAME).write_bytes(build_installer())
    alone = ["unshare", "--net"] if os.geteuid() == 0 and shutil.which("unshare") else []

    def run(*arguments: object, prefix: list[str] | None = None) -> str:
        command = [*(prefix or []), python, "-I", tmp_path / NAME, *arguments, "--root",
                   tmp_path / "board"]  # fmt: skip
        done = subprocess.run(
            [str(part) for part in command],
            capture_output=True, text=True, check=False, env={"PATH": os.environ["PATH"]},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    said = run("install", made.path, "--trust", public, "--service", "none", prefix=alone)
    assert made.manifest.version in said
    with Simulator(endpoint) as simulator:
        run("install", made.path, "--service", "process")
        try:
            simulator.wait_for_edge()
            command = simulator.ask(make_state(0, final=True))
            assert command.policy_id == made.manifest.policy_id
            assert json.loads(run("status", "--json"))["whole"] == "yes"
        finally:
            run("uninstall")
    assert not (tmp_path / "board").exists()
