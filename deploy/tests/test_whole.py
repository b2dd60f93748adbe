"""Whole bundles with every wheel: `make test-board`. They need pip's index the first time."""

from __future__ import annotations

from pathlib import Path

import pytest

from deploy.bundle import Inputs, Made, make_bundle
from deploy.certs import write_key_pair
from deploy.wheels import DEFAULT_FOLDER, ROOT, TARGETS, build_edge_wheel, gather, lock_path
from edge_runtime.util import UserError

pytestmark = [pytest.mark.board, pytest.mark.timeout(900)]
POLICY = ROOT / "results/policies/left_turn.onnx"
MAX_JETPACK5_BYTES = 45_000_000


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Makes a bundle of the policy that comes with the repository."""
    folder = tmp_path_factory.mktemp("whole")
    private, _ = write_key_pair(folder / "keys")
    edge = build_edge_wheel(folder / "edge")

    def make(name: str, out: Path) -> Made:
        target = TARGETS[name]
        try:
            wheels = gather(target, lock_path(target), ROOT / DEFAULT_FOLDER / name)
        except UserError as error:
            if "No matching distribution" in str(error):
                pytest.skip("no package index can be reached")
            raise
        public = POLICY.with_name("policy.pub")
        return make_bundle(
            Inputs(POLICY, public, private, None, None, [*wheels, edge]), target, out
        )

    return make


@pytest.mark.parametrize("name", TARGETS)
def test_a_bundle_is_the_same_again_and_the_boards_is_small(make, tmp_path, name):
    one = make(name, tmp_path / "one")
    two = make(name, tmp_path / "two")
    assert one.path.read_bytes() == two.path.read_bytes()
    if name == "jetpack5":
        assert one.path.stat().st_size < MAX_JETPACK5_BYTES
