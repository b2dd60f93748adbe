"""``python -m hil_tests doctor``: try what this machine can do, and say how to get the rest.

It runs in a fresh clone, so only the standard library is imported up here; Python 3.8 must read it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from edge_runtime.cli import ArgumentParser, examples

ROOT = Path(__file__).parents[1]
SCRIPT_S = 60.0
EXAMPLE = examples("python -m hil_tests doctor")


class Ability(NamedTuple):
    """What a machine may be able to do: a script that fails where it cannot."""

    name: str
    script: str
    without: str
    remedy: str


def add_arguments(_: ArgumentParser) -> None:
    """There are none."""


def run(_: argparse.Namespace) -> int:
    """Try every ability and print a line for each; return 0 where the basics work."""
    missing = [ability for ability in ABILITIES if not can(ability)]
    print(f"\nmissing: {', '.join(ability.name for ability in missing) or 'nothing'}")
    return int(any(ability.without == NOTHING for ability in missing))


def can(ability: Ability) -> bool:
    """Run an ability's script in a process of its own; print a line, and more where it fails."""
    command = [sys.executable, "-c", ability.script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=SCRIPT_S, cwd=ROOT)
    if done.returncode == 0:
        print(f"  ok       {ability.name}", flush=True)
        return True
    why = (done.stderr.strip().splitlines() or ["no"])[-1]
    print(f"  missing  {ability.name}: {why}\n           without it: {ability.without}")
    print(f"           get it: {ability.remedy}", flush=True)
    return False


NOTHING = "nothing runs"
PYTHON = "import sys; assert sys.version_info >= (3, 11), sys.version"
PACKAGES = "import torch, highway_env, onnxruntime, zenoh, msgspec, rich"
LOOPBACK = """
import socket
server = socket.create_server(("127.0.0.1", 0))
socket.create_connection(server.getsockname(), 5.0)
"""
KERNEL = "from trainer.learner.kernel import load; assert load(), 'it cannot be built or is off'"
GPU = "import torch; assert torch.cuda.is_available(), f'torch {torch.__version__} sees none'"
DISPLAY = "from bridge.rerun import has_display; assert has_display(), 'DISPLAY is not set'"
SSH_KEYGEN = "import shutil; assert shutil.which('ssh-keygen'), 'it is not on PATH'"
CAN = """
import can
from edge_runtime.vehicles.hunter import open_bus, parse_bus
from hil_tests.faults.rig import free_bus
name = parse_bus(free_bus())
with open_bus(name) as sender, open_bus(name) as receiver:
    sender.send(can.Message(arbitration_id=0x111, data=b"doctor", is_extended_id=False))
    assert receiver.recv(5.0), "a frame did not arrive by UDP multicast on loopback"
"""
PRIORITY = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
ABILITIES = (
    Ability("Python", PYTHON, NOTHING, "Python 3.11 or newer"),
    Ability("packages", PACKAGES, NOTHING, "make install"),
    Ability("loopback", LOOPBACK, NOTHING, "`ip link set lo up`"),
    Ability("C++ kernel", KERNEL, "`trainer train` takes several times as long",
            "a C++ compiler: apt install g++"),
    Ability("GPU", GPU, "no `--device cuda`", "an NVIDIA GPU with its driver, and torch with CUDA"),
    Ability("display", DISPLAY, "no window that opens by itself",
            "a desktop session; without one: open the printed address, and --serve or --save"),
    Ability("ssh-keygen", SSH_KEYGEN, "no bundle for a board, no `make test`",
            "apt install openssh-client"),
    Ability("CAN over UDP", CAN, "no `hil_tests mock_hunter` without options",
            "a route for multicast on loopback: `ip route add 239.0.0.0/8 dev lo`"),
    Ability("real-time priority", PRIORITY,
            "a busy machine may make the edge runtime's commands late",
            "CAP_SYS_NICE, or `ulimit -r 99` (LimitRTPRIO=99 in a service)"),
)  # fmt: skip
