"""An environment that somebody else has published: installed by pip, served by its bare id."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import pytest

from bridge.tests.processes import BridgeProcess, make_policy, read, start_edge
from edge_runtime.link_probe import free_endpoint

PROJECT = """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"
[project]
name = "somebodys-envs"
version = "1.0"
[project.entry-points."gymnasium.envs"]
somebody = "somebodys_envs:register"
"""
MODULE = """
import gymnasium
import numpy as np

class Creep(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (2, 45, 80), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.travelled_m = 0.0
        return self.picture(), {"speed_mps": 1.0, "distance_m": 0.0}

    def step(self, action):
        self.travelled_m += 0.1
        ended = self.travelled_m > 1.95
        info = {"speed_mps": 1.0, "distance_m": self.travelled_m}
        return self.picture(), float(action[0]), ended, False, info

    def picture(self):
        return np.full((2, 45, 80), 7, np.uint8)

def register():
    gymnasium.register("Creep-v0", entry_point="somebodys_envs:Creep")
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder into which pip has installed the package, from source and without a network."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    (source / "pyproject.toml").write_text(textwrap.dedent(PROJECT))
    (source / "somebodys_envs.py").write_text(MODULE)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    command = [*pip, "--no-build-isolation", "--target", str(target), str(source)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return target


def test_an_installed_environment_is_served_by_its_id(site, tmp_path):
    endpoint, out = free_endpoint(), tmp_path / "r.json"
    arguments = ["simulate", "--env", "somebody/Creep-v0", "--listen", endpoint, "--out", str(out)]
    with (
        BridgeProcess(*arguments, environment={"PYTHONPATH": str(site)}) as run,
        start_edge(endpoint, make_policy(tmp_path, "constant")),
    ):
        assert run.wait() == 0, run.errors
    report = read(out)
    assert report["scenario"] == "somebody/Creep-v0"
    (row,) = report["per_episode"]
    assert (row["steps"], row["outcome"]) == (20, "ended")
    assert row["reward"] == pytest.approx(20 * 0.3, rel=1e-6)


def test_what_is_not_installed_is_one_line_and_status_2():
    with BridgeProcess("simulate", "--env", "somebody/Creep-v0") as run:
        assert run.wait() == 2
    (line,) = run.errors.splitlines()
    assert "somebody" in line
    assert "a gymnasium id" in line
