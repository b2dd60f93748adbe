"""``python -m hil_tests doctor``: what this machine can and cannot do, and how to get the rest.

Each probe does the thing instead of looking for it; CHECKS, at the end, says what each is for. It
runs in a fresh clone, before anything is installed, so only the standard library is
imported up here; heavy libraries are tried in a process of their own.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.util import UserError

BASICS = "basics"
INSTALL = "make install"
NOT_READY = 1  # Exit status where a basic is missing
TIMEOUT_S = 60.0  # For a program that a probe starts
ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements" / "workstation.txt"
OLDEST = (3, 11)
DISK_GB = 2
"""A training run with its checkpoint takes some 0.5 GB, recordings and pictures come on top."""
MEMORY_GB = 2  # A full replay buffer and torch take 1.2 GB.
ARRIVAL_S = 5.0
_KERNEL = """
import os, sys, torch
from trainer.learner.kernel import load
if load() is None:  # it has said why
    sys.exit("turned off by PHIL_KERNEL=0" if os.environ.get("PHIL_KERNEL") == "0" else 1)
print("the learner's kernel is built and loaded")
"""
_GPU = """
import sys, torch
if not torch.cuda.is_available():
    sys.exit(f"torch {torch.__version__} sees no CUDA device")
print(torch.cuda.get_device_name(0))
"""
EXAMPLE = examples("python -m hil_tests doctor --only basics vehicle")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    groups = f"of {', '.join(GROUPS)} (default: all)"
    parser.add_argument("--only", metavar="GROUP", nargs="+", default=GROUPS, help=groups)


def run(arguments: argparse.Namespace) -> int:
    """Make the checks and print them; 0 where the basics work. UserError for an unknown group."""
    for group in arguments.only:
        if group not in GROUPS:
            raise UserError(f"no group {group!r}: choose from {', '.join(GROUPS)}")
    found: list[Finding] = []
    for check in CHECKS:
        if check.group not in arguments.only:
            continue
        if not found or check.group != found[-1].check.group:
            print(f"\n{check.group}")
        found.append(examine(check))
        print(lines(found[-1]), flush=True)
    print(f"\n{summary(found)}")
    return NOT_READY if lacking(found, BASICS) else 0


class Check(NamedTuple):
    """One thing that a machine may have.

    ``probe`` does it, and says in a few words what it found; any exception says that it is missing.
    ``without`` says what fails or is worse where it is missing; ``remedy``, how to get it.
    """

    group: str
    name: str
    probe: Callable[[], str]
    without: str
    remedy: str


class Finding(NamedTuple):
    """A check that was made: whether it is there, what was found, and how to get it."""

    check: Check
    ok: bool
    detail: str
    remedy: str


def examine(check: Check) -> Finding:
    """Make a check; whatever goes wrong in it is its finding."""
    ok, remedy = False, check.remedy
    try:
        ok, detail = True, check.probe()
    except ModuleNotFoundError as error:  # the thing itself was not tried
        detail, remedy = f"Python finds no module {error.name}", INSTALL
    except UserError as error:
        detail = str(error)
    # A broken library may raise anything at all, and the checks after it are still wanted.
    except Exception as error:
        detail = f"{type(error).__name__}: {error}"
    return Finding(check, ok, " ".join(detail.split()), remedy)


def lines(finding: Finding) -> str:
    """A line where it is there; what it is for and how to get it where it is not."""
    said = f"{finding.check.name}: {finding.detail}"
    if finding.ok:
        return f"  ok       {said}"
    needs = (f"without it: {finding.check.without}", f"get it: {finding.remedy}")
    return ("\n" + 11 * " ").join((f"  missing  {said}", *needs))


def lacking(found: list[Finding], group: str | None = None) -> list[str]:
    """The names of what is missing, of all groups or one."""
    return [one.check.name for one in found if not one.ok and group in (None, one.check.group)]


def summary(found: list[Finding]) -> str:
    """The last line."""
    if basic := lacking(found, BASICS):
        return f"The basics do not work here: {', '.join(basic)}."
    basics = "The basics work. " if any(one.check.group == BASICS for one in found) else ""
    if not (names := lacking(found)):
        return f"{basics}Nothing is missing."
    return f"{basics}Missing{' besides' if basics else ''}: {', '.join(names)}."


def _python() -> str:
    if sys.version_info[:2] < OLDEST:
        raise UserError(f"this is Python {platform.python_version()}")
    return f"{platform.python_version()}, {sys.executable}"


def _packages() -> str:
    import tomllib  # An older Python has none, and is to say so in the check before.

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [re.split(r"[^\w.-]", line)[0] for line in project["dependencies"]]
    if absent := [name for name in wanted if _installed(name) is None]:
        raise UserError(f"not installed: {', '.join(absent)}")
    return f"all {len(wanted)} that pyproject.toml asks for"


def _versions() -> str:
    locked = dict(line.split("==") for line in LOCK.read_text().splitlines() if "==" in line)
    found = {name: version for name in locked if (version := _installed(name)) is not None}
    # torch says +cpu or +cu130 behind its version.
    other = {n: version for n, version in found.items() if version.split("+")[0] != locked[n]}
    if other:
        each = (f"{name} {version} (locked: {locked[name]})" for name, version in other.items())
        raise UserError(f"other versions: {', '.join(each)}")
    return f"{len(found)} packages as in {LOCK.name}"


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _loopback() -> str:
    from edge_runtime.reach import free_endpoint
    from edge_runtime.transport import open_session

    came = threading.Event()
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:  # Python 3.8 must read this, to be told so.
        router = stack.enter_context(open_session(listen=endpoint, mode="router"))
        client = stack.enter_context(open_session(connect=endpoint, mode="client"))
        stack.enter_context(router.declare_subscriber("phil/doctor", lambda _: came.set()))
        client.put("phil/doctor", b"doctor")
        if not came.wait(ARRIVAL_S):
            raise UserError(f"no message within {ARRIVAL_S:.0f} s over {endpoint}")
    return f"a message went over {endpoint}"


def _window() -> str:
    from bridge.rerun import has_display

    if not has_display():
        raise UserError("neither DISPLAY nor WAYLAND_DISPLAY is set")
    return "there is a display"


def _ssh_keygen() -> str:
    found = shutil.which("ssh-keygen")
    if found is None:
        raise UserError("not found")
    return found


def _disk() -> str:
    with tempfile.NamedTemporaryFile(dir=Path.cwd(), prefix=".doctor-") as file:
        file.write(b"doctor")
    return _enough(shutil.disk_usage(Path.cwd()).free, DISK_GB, f"free in {Path.cwd()}")


def _memory() -> str:
    rows = Path("/proc/meminfo").read_text().splitlines()
    available = next(int(row.split()[1]) * 1024 for row in rows if "MemAvailable" in row)
    return _enough(available, MEMORY_GB, f"available, {os.cpu_count()} cores")


def _enough(size: int, wanted_gb: int, what: str) -> str:
    said = f"{size / 1e9:.1f} GB {what}"
    if size < wanted_gb * 10**9:
        raise UserError(f"{said}; {wanted_gb} are wanted")
    return said


def _can_over_udp() -> str:
    import can

    from edge_runtime.vehicles.hunter import open_bus, parse_bus
    from hil_tests.faults.rig import free_bus

    name = parse_bus(free_bus())
    with open_bus(name) as sender, open_bus(name) as receiver:
        sender.send(can.Message(arbitration_id=0x111, data=b"doctor", is_extended_id=False))
        heard = receiver.recv(ARRIVAL_S)
    if heard is None or bytes(heard.data) != b"doctor":
        raise UserError("a frame did not arrive on loopback")
    return "a frame went through UDP multicast on loopback"


def _realtime_priority() -> str:
    # The thread keeps the priority to itself, and ends with it.
    with ThreadPoolExecutor(1) as thread:
        thread.submit(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(1)).result()
    return "SCHED_FIFO was given to a thread"


def python_says(script: str) -> str:
    """The first line of a script in its own process; ModuleNotFoundError, UserError if it fails."""
    command = [sys.executable, "-c", script]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(str(error)) from None
    if done.returncode != 0:
        said = (done.stderr or done.stdout).strip() or f"exit status {done.returncode}"
        if (last := said.splitlines()[-1]).startswith("ModuleNotFoundError"):
            raise ModuleNotFoundError(name=last.split("'")[1])
        raise UserError(last)
    return done.stdout.partition("\n")[0]


CHECKS = (
    Check(BASICS, "Python", _python, "nothing runs", "Python 3.11 or newer; make PYTHON=..."),
    Check(BASICS, "packages", _packages, "nothing runs", INSTALL),
    Check(BASICS, "loopback", _loopback, "no drive over Zenoh, no `make demo`, no `make test`",
          "TCP on 127.0.0.1: `ip link set lo up`, or a rule in the firewall"),
    Check(BASICS, "disk", _disk, "no training, no recordings (--out)",
          "free some space, or work in another directory"),
    Check(BASICS, "memory", _memory, "no training", "end other programs"),
    Check("training", "locked versions", _versions,
          "results differ from results/ in the last bits", INSTALL),
    Check("training", "C++ kernel", partial(python_says, _KERNEL),
          "`trainer train` takes several times as long",
          "a C++ compiler: apt install g++"),
    Check("training", "GPU", partial(python_says, _GPU),
          "no `--device cuda`",
          "an NVIDIA GPU with its driver, and torch with CUDA"),
    Check("person", "window", _window,
          "no cockpit that opens by itself, no rerun window (--spawn)",
          "a desktop session; without one: open the printed address, and --serve or --save"),
    Check("vehicle", "ssh-keygen", _ssh_keygen, "no bundle for a board, no `make test`",
          "apt install openssh-client"),
    Check("vehicle", "CAN over UDP", _can_over_udp, "no `hil_tests mock_hunter` without options",
          "a route for multicast on loopback: `ip route add 239.0.0.0/8 dev lo`"),
    Check("vehicle", "real-time priority", _realtime_priority,
          "a busy machine may make the edge runtime's commands late",
          "CAP_SYS_NICE, or `ulimit -r 99` (LimitRTPRIO=99 in a service)"),
)  # fmt: skip
"""In the order of the output. Nothing much works without the basics."""
GROUPS = tuple(dict.fromkeys(check.group for check in CHECKS))
