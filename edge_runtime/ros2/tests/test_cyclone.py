"""Our bytes through Cyclone DDS itself, by the call with which zenoh-bridge-ros2dds hands them on.

Where its C library and compiler are installed (Debian: cyclonedds-dev, cyclonedds-tools, gcc).
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings

from edge_runtime.ros2 import cdr
from edge_runtime.ros2 import messages as ros
from edge_runtime.ros2.tests.strategies import MESSAGES

SOURCE = Path(__file__).parent / "cyclone"
REFUSED = 3
LOOPBACK_ONLY = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General></Domain></CycloneDDS>"
)
pytestmark = pytest.mark.skipif(
    shutil.which("idlc") is None or shutil.which("gcc") is None, reason="no Cyclone DDS in C here"
)


@pytest.fixture(scope="module")
def through_dds(tmp_path_factory):
    """Compile; the function returns DDS's own bytes and the type's name, None where it refuses."""
    folder = tmp_path_factory.mktemp("cyclone")
    program = folder / "through_dds"
    idl = ["idlc", "-x", "final", "-l", "c", str(SOURCE / "ros.idl")]
    subprocess.run(idl, cwd=folder, check=True, timeout=60)
    sources = [str(SOURCE / "through_dds.c"), "ros.c"]
    gcc = ["gcc", "-O1", "-I.", "-o", str(program), *sources, "-lddsc"]
    subprocess.run(gcc, cwd=folder, check=True, timeout=60)

    def go(payload, kind):
        (folder / "in").write_bytes(payload)
        done = subprocess.run(
            [str(program), kind.__name__, "in", "out"],
            cwd=folder, env={**os.environ, "CYCLONEDDS_URI": LOOPBACK_ONLY},
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        if done.returncode == REFUSED:
            return None
        assert done.returncode == 0, done.stderr
        return (folder / "out").read_bytes(), done.stdout.strip()

    return go


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(message=MESSAGES)
def test_dds_takes_any_message_and_gives_it_back(through_dds, message):
    ours, kind = cdr.encode(message), type(message)
    theirs, type_name = through_dds(ours, kind)
    assert cdr.decode(theirs, kind) == message
    # Filled up to 4 bytes; how many that are stands in the header's last two bits.
    padding = -len(ours) % 4
    assert theirs == ours[:3] + bytes([padding]) + ours[4:] + bytes(padding)
    package, part, name = kind.__idl_typename__.split("/")
    assert type_name == f"{package}::{part}::dds_::{name}_"


def test_dds_refuses_another_type(through_dds):
    assert through_dds(cdr.encode(ros.Twist()), ros.Odometry) is None
