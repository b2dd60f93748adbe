"""``python -m hil_tests doctor``: try what this machine can do, and say how to get the rest.

It runs in a fresh clone, so only the standard library is imported up here; Python 3.8 must read it.
"""

from __future__ import annotations

import argparse
import contextlib
import platform
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.util import UserError

BASICS, INSTALL = "basics", "make install"
NOT_READY = 1  # Exit status where a basic is missing
ROOT = Path(__file__).parents[1]
OLDEST = (3, 11)
DISK_GB, MEMORY_GB = 2, 2  # A run with its checkpoint takes 0.5 GB; torch and a full replay 1.2 GB
ARRIVAL_S, SCRIPT_S = 5.0, 60.0
KERNEL = "from trainer.learner.kernel import load; assert load(), 'it cannot be built or is off'"
GPU = "import torch; assert torch.cuda.is_available(), f'torch {torch.__version__} sees none'"
DISPLAY = "from bridge.rerun import has_display; assert has_display(), 'DISPLAY is not set'"
SSH_KEYGEN = "import shutil; assert shutil.which('ssh-keygen'), 'it is not on PATH'"
PRIORITY = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
EXAMPLE = examples("python -m hil_tests doctor --only basics vehicle")


class Ability(NamedTuple):
    """What a machine may be able to do. ``probe`` does it and returns a few words, or raises."""

    group: str
    name: str
    probe: Callable[[], str]
    without: str
    remedy: str


def add_arguments(parser: ArgumentParser) -> None:
    groups = f"groups of checks: {', '.join(GROUPS)} (default: all)"
    parser.add_argument("--only", metavar="GROUP", nargs="+", choices=GROUPS, help=groups)


def run(arguments: argparse.Namespace) -> int:
    """Try every ability and print a line for each; return 0 where the basics work."""
    missing = []
    for ability in ABILITIES:
        if arguments.only and ability.group not in arguments.only:
            continue
        try:
            print(f"  ok       {ability.name}: {ability.probe()}", flush=True)
        except Exception as error:  # A broken library may raise anything.
            missing.append(ability)
            unknown = isinstance(error, ModuleNotFoundError)
            said = " ".join(str(error).split()) or type(error).__name__
            print(f"  missing  {ability.name}: {said}\n           without it: {ability.without}")
            print(f"           get it: {INSTALL if unknown else ability.remedy}", flush=True)
    print(f"\nmissing: {', '.join(ability.name for ability in missing) or 'nothing'}")
    return NOT_READY if any(ability.group == BASICS for ability in missing) else 0


def _python() -> str:
    if sys.version_info[:2] < OLDEST:
        raise UserError(f"this is Python {platform.python_version()}")
    return f"{platform.python_version()}, {sys.executable}"


def _packages() -> str:
    import tomllib  # An older Python has none.

    def version_of(name: str) -> str:
        with contextlib.suppress(metadata.PackageNotFoundError):
            return metadata.version(name).split("+")[0]  # torch says +cpu behind its version.
        return ""

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [re.split(r"[^\w.-]", line)[0] for line in project["dependencies"]]
    absent = [name for name in wanted if not version_of(name)]
    if absent:
        raise UserError(f"not installed: {', '.join(absent)}")
    lines = (ROOT / "requirements" / "workstation.txt").read_text().splitlines()
    locked = dict(line.split("==") for line in lines if "==" in line)
    other = [name for name, version in locked.items() if version_of(name) not in ("", version)]
    return f"{', '.join(other)} not as locked: results may differ" if other else "as locked"


def _loopback() -> str:
    from edge_runtime.reach import free_endpoint
    from edge_runtime.transport import open_session

    came, endpoint = threading.Event(), free_endpoint()
    with contextlib.ExitStack() as stack:
        router = stack.enter_context(open_session(listen=endpoint, mode="router"))
        client = stack.enter_context(open_session(connect=endpoint, mode="client"))
        stack.enter_context(router.declare_subscriber("phil/doctor", lambda _: came.set()))
        client.put("phil/doctor", b"doctor")
        if not came.wait(ARRIVAL_S):
            raise UserError(f"no message within {ARRIVAL_S:.0f} s over {endpoint}")
    return f"a message went over {endpoint}"


def _room() -> str:
    lines = Path("/proc/meminfo").read_text().splitlines()
    memory = next(int(line.split()[1]) * 1024 for line in lines if "MemAvailable" in line)
    disk = shutil.disk_usage(Path.cwd()).free
    said = f"{memory / 1e9:.1f} GB of memory, {disk / 1e9:.1f} GB of disk"
    if memory < MEMORY_GB * 10**9 or disk < DISK_GB * 10**9:
        raise UserError(f"{said}; {MEMORY_GB} and {DISK_GB} GB are wanted")
    return said


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


def python_does(script: str) -> str:
    """Run a script that loads heavy libraries in a process of its own."""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=SCRIPT_S, cwd=ROOT)
    if done.returncode:
        kind, _, said = (done.stderr.strip().splitlines() or [""])[-1].partition(": ")
        raise (ModuleNotFoundError if kind == "ModuleNotFoundError" else UserError)(said or kind)
    return "works"


ABILITIES = (
    Ability(BASICS, "Python", _python, "nothing runs", "Python 3.11 or newer; make PYTHON=..."),
    Ability(BASICS, "packages", _packages, "nothing runs", INSTALL),
    Ability(BASICS, "loopback", _loopback, "no drive over Zenoh, no `make demo`, no `make test`",
            "TCP on 127.0.0.1: `ip link set lo up`, or a rule in the firewall"),
    Ability(BASICS, "room", _room, "no training, no recordings",
            "end other programs, free some disk, or work in another directory"),
    Ability("training", "C++ kernel", partial(python_does, KERNEL),
            "`trainer train` takes several times as long", "a C++ compiler: apt install g++"),
    Ability("training", "GPU", partial(python_does, GPU), "no `--device cuda`",
            "an NVIDIA GPU with its driver, and torch with CUDA"),
    Ability("person", "display", partial(python_does, DISPLAY),
            "no cockpit that opens by itself, no rerun window (--spawn)",
            "a desktop session; without one: open the printed address, and --serve or --save"),
    Ability("vehicle", "ssh-keygen", partial(python_does, SSH_KEYGEN),
            "no bundle for a board, no `make test`", "apt install openssh-client"),
    Ability("vehicle", "CAN over UDP", _can_over_udp, "no `hil_tests mock_hunter` without options",
            "a route for multicast on loopback: `ip route add 239.0.0.0/8 dev lo`"),
    Ability("vehicle", "real-time priority", partial(python_does, PRIORITY),
            "a busy machine may make the edge runtime's commands late",
            "CAP_SYS_NICE, or `ulimit -r 99` (LimitRTPRIO=99 in a service)"),
)  # fmt: skip
GROUPS = tuple(dict.fromkeys(ability.group for ability in ABILITIES))
