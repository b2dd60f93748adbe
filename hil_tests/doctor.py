"""``python -m hil_tests doctor``: try what this machine can do, and say how to get the rest.

It runs in a fresh clone, so only the standard library is imported up here; Python 3.8 must read it.
"""

from __future__ import annotations

import argparse
import socket
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.util import UserError

ROOT = Path(__file__).parents[1]
ARRIVAL_S, SCRIPT_S = 5.0, 60.0
EXAMPLE = examples("python -m hil_tests doctor")


class Ability(NamedTuple):
    """What a machine may be able to do; ``probe`` does it and returns a few words, or raises."""

    name: str
    probe: Callable[[], str]
    without: str
    remedy: str
    is_basic: bool = False


def add_arguments(_: ArgumentParser) -> None:
    """There are none."""


def run(_: argparse.Namespace) -> int:
    """Try every ability and print a line for each; return 0 where the basics work."""
    missing = []
    for ability in ABILITIES:
        try:
            print(f"  ok       {ability.name}: {ability.probe()}", flush=True)
        except Exception as error:  # A broken library may raise anything.
            missing.append(ability)
            said = " ".join(str(error).split()) or type(error).__name__
            print(f"  missing  {ability.name}: {said}\n           without it: {ability.without}")
            print(f"           get it: {ability.remedy}", flush=True)
    print(f"\nmissing: {', '.join(ability.name for ability in missing) or 'nothing'}")
    return int(any(ability.is_basic for ability in missing))


def python_does(script: str) -> str:
    """Run a script that loads heavy libraries in a process of its own."""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=SCRIPT_S, cwd=ROOT)
    if done.returncode:
        raise UserError((done.stderr.strip().splitlines() or ["no"])[-1])
    return "works"


def _packages() -> str:
    wanted = ("torch", "highway_env", "onnxruntime", "zenoh", "msgspec", "rich")
    absent = [name for name in wanted if find_spec(name) is None]
    if absent:
        raise UserError(f"not installed: {', '.join(absent)}")
    return "installed"


def _loopback() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        socket.create_connection(server.getsockname(), ARRIVAL_S).close()
    return "TCP on 127.0.0.1"


def _can_over_udp() -> str:
    import can

    from edge_runtime.vehicles.hunter import open_bus, parse_bus
    from hil_tests.faults.rig import free_bus

    name = parse_bus(free_bus())
    with open_bus(name) as sender, open_bus(name) as receiver:
        sender.send(can.Message(arbitration_id=0x111, data=b"doctor", is_extended_id=False))
        if receiver.recv(ARRIVAL_S) is None:
            raise UserError("a frame did not arrive on loopback")
    return "a frame went through UDP multicast on loopback"


PYTHON = "import sys; assert sys.version_info >= (3, 11), sys.version"
KERNEL = "from trainer.learner.kernel import load; assert load(), 'it cannot be built or is off'"
GPU = "import torch; assert torch.cuda.is_available(), f'torch {torch.__version__} sees none'"
DISPLAY = "from bridge.rerun import has_display; assert has_display(), 'DISPLAY is not set'"
SSH_KEYGEN = "import shutil; assert shutil.which('ssh-keygen'), 'it is not on PATH'"
PRIORITY = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
ABILITIES = (
    Ability("Python", partial(python_does, PYTHON), "nothing runs", "Python 3.11 or newer", True),
    Ability("packages", _packages, "nothing runs", "make install", True),
    Ability("loopback", _loopback, "no drive over Zenoh", "`ip link set lo up`", True),
    Ability("C++ kernel", partial(python_does, KERNEL),
            "`trainer train` takes several times as long", "a C++ compiler: apt install g++"),
    Ability("GPU", partial(python_does, GPU), "no `--device cuda`",
            "an NVIDIA GPU with its driver, and torch with CUDA"),
    Ability("display", partial(python_does, DISPLAY), "no window that opens by itself",
            "a desktop session; without one: open the printed address, and --serve or --save"),
    Ability("ssh-keygen", partial(python_does, SSH_KEYGEN),
            "no bundle for a board, no `make test`", "apt install openssh-client"),
    Ability("CAN over UDP", _can_over_udp, "no `hil_tests mock_hunter` without options",
            "a route for multicast on loopback: `ip route add 239.0.0.0/8 dev lo`"),
    Ability("real-time priority", partial(python_does, PRIORITY),
            "a busy machine may make the edge runtime's commands late",
            "CAP_SYS_NICE, or `ulimit -r 99` (LimitRTPRIO=99 in a service)"),
)  # fmt: skip
