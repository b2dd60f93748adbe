"""``python -m hil_tests doctor``: what this machine can and cannot do, and how to get the rest.

Each probe does the thing instead of looking for it. Above it stands what is not there
without it, and how to get it. It runs in a fresh clone, before anything is installed, so
only the standard library is imported up here; heavy libraries are tried in a process of their own.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import platform
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from edge_runtime.cli import ArgumentParser, examples
from edge_runtime.util import UserError

BASICS = "basics"
INSTALL = "make install"
NOT_READY = 1
"""Exit status where a basic is missing."""
TIMEOUT_S = 60.0
"""For a program that a probe starts."""
ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements" / "workstation.txt"
OLDEST = (3, 11)
DISK_BYTES = 2 * 10**9
"""A training run with its checkpoint takes some 0.5 GB, recordings and pictures come on top."""
MEMORY_BYTES = 2 * 10**9
"""A full replay buffer and torch take 1.2 GB."""
ARRIVAL_S = 5.0
LOOPBACK = "127.0.0.1"
_CAN_DEVICE = "280"
"""ARPHRD_CAN of linux/if_arp.h."""
_EVENTS = Path("/dev/input")
_TORCH = """
import json, logging, os, sys
import torch
import trainer.learner.kernel as kernel
why = []
kernel._LOGGER.addHandler(logging.Handler())
logging.Handler.emit = lambda self, record: why.append(record.getMessage())
built = kernel.load("trunk") is not None
gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else ""
print(json.dumps({"torch": torch.__version__, "kernel": built, "why": why, "gpu": gpu}))
"""
_SDL = """
import json, os
os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"
os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
import pygame
facts = {"driver": "", "why": "", "controllers": []}
try:
    pygame.display.init()
    facts["driver"] = pygame.display.get_driver()
except pygame.error as error:
    facts["why"] = str(error)
pygame.joystick.init()
for number in range(pygame.joystick.get_count()):
    stick = pygame.joystick.Joystick(number)
    facts["controllers"].append(f"{stick.get_name()} ({stick.get_numaxes()} axes)")
print(json.dumps(facts))
"""
EXAMPLE = examples(
    "python -m hil_tests doctor",
    "python -m hil_tests doctor --only basics vehicle",
    "python -m hil_tests doctor --json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--only", metavar="GROUP", nargs="+", default=list(CHECKS), help=f"of {', '.join(CHECKS)}"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of lines")


def run(arguments: argparse.Namespace) -> int:
    """Make the checks and print them; 0 where the basics work.

    Raises:
        UserError: a group that is not there.
    """
    for group in arguments.only:
        if group not in CHECKS:
            raise UserError(f"no group {group!r}: choose from {', '.join(CHECKS)}")
    found: list[Finding] = []
    for finding in examine_all(arguments.only):
        if not arguments.json:
            if not found or found[-1].group != finding.group:
                print(f"\n{finding.group}")
            print("\n".join(lines(finding)), flush=True)
        found.append(finding)
    if arguments.json:
        print(json.dumps({"basics": basics_work(found), "checks": [f._asdict() for f in found]}))
    else:
        print("\n" + summary(found))
    return 0 if basics_work(found) else NOT_READY


def examine_all(groups: list[str]) -> Iterator[Finding]:
    """Each check of these groups, as soon as it is made."""
    for group in groups:
        for check in CHECKS[group]:
            yield examine(group, check)


def basics_work(found: list[Finding]) -> bool:
    """Whether nothing basic is missing."""
    return all(finding.ok for finding in found if finding.basic)


def lines(finding: Finding) -> list[str]:
    """A line where it is there; what it is for and how to get it where it is not."""
    said = f"{finding.name}: {finding.detail}"
    if finding.ok:
        return [f"  ok       {said}"]
    return [
        f"  missing  {said}",
        f"           without it: {finding.without}",
        f"           get it: {finding.remedy}",
    ]


def summary(found: list[Finding]) -> str:
    """The last line."""
    missing = [finding.name for finding in found if not finding.ok]
    if not basics_work(found):
        basics = ", ".join(finding.name for finding in found if finding.basic and not finding.ok)
        return f"The basics do not work here: {basics}."
    basics = "The basics work. " if any(finding.basic for finding in found) else ""
    if missing:
        return f"{basics}Missing{' besides' if basics else ''}: {', '.join(missing)}."
    return f"{basics}Nothing is missing."


class MissingError(Exception):
    """The machine has it not; the text says what was tried and what came of it."""


Probe = Callable[[], str]
"""Does it, and says in a few words what it found; any exception says that it is missing."""


class Check(NamedTuple):
    """One thing that a machine may have."""

    name: str
    probe: Probe
    without: str
    """What there is where it is missing, or is not."""
    remedy: str
    """How to get it."""


CHECKS: dict[str, list[Check]] = {
    group: [] for group in (BASICS, "training", "person", "seeing", "ports", "vehicle", "board")
}
"""Group -> its checks; `check` puts them there. Nothing much works without the basics."""


def check(group: str, name: str, without: str, remedy: str) -> Callable[[Probe], Probe]:
    """Put a probe into CHECKS."""

    def add(probe: Probe) -> Probe:
        CHECKS[group].append(Check(name, probe, without, remedy))
        return probe

    return add


class Finding(NamedTuple):
    """A check that was made."""

    group: str
    name: str
    ok: bool
    detail: str
    basic: bool
    without: str
    remedy: str


def examine(group: str, check: Check) -> Finding:
    """Make a check; whatever goes wrong in it is its finding."""
    remedy = check.remedy
    try:
        ok, detail = True, check.probe()
    # Whatever it is that was to be tried: it was not come to.
    except ModuleNotFoundError as error:
        ok, detail, remedy = False, f"Python finds no module {error.name}", INSTALL
    except (MissingError, UserError) as error:
        ok, detail = False, str(error)
    # A broken library may raise anything at all, and the checks after it are still wanted.
    except Exception as error:
        ok, detail = False, f"{type(error).__name__}: {error}"
    text = " ".join(detail.split())
    return Finding(group, check.name, ok, text, group == BASICS, check.without, remedy)


@check(BASICS, "Python", "nothing", "Python 3.11 or newer; make PYTHON=...")
def python() -> str:
    """The interpreter that runs this."""
    number = tuple(map(int, platform.python_version_tuple()[:2]))
    if number < OLDEST:
        raise MissingError(f"this is Python {platform.python_version()}")
    return f"{platform.python_version()}, {sys.executable}"


@check(BASICS, "packages", "nothing that imports them", INSTALL)
def packages() -> str:
    """Every library that pyproject.toml asks for is there."""
    import tomllib  # An older Python has none, and is to say so in the check before.

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [re.split(r"[^\w.-]", line)[0] for line in project["dependencies"]]
    absent = [name for name in wanted if _installed(name) is None]
    if absent:
        raise MissingError(f"not installed: {', '.join(absent)}")
    return f"all {len(wanted)} that pyproject.toml asks for"


@check(
    BASICS, "loopback", "no drive over Zenoh, no `make demo`, no `make test`",
    "TCP on 127.0.0.1: `ip link set lo up`, or a rule in the firewall",
)  # fmt: skip
def zenoh_loopback() -> str:
    """A message from one Zenoh session to another, over TCP on loopback."""
    from edge_runtime.link_probe import free_endpoint
    from edge_runtime.transport import open_session

    came = threading.Event()
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        router = open_session(listen=endpoint, mode="router")
        stack.callback(router.close)
        client = open_session(connect=endpoint, mode="client")
        stack.callback(client.close)
        subscriber = router.declare_subscriber("phil/doctor", lambda _: came.set())
        stack.callback(subscriber.undeclare)
        client.put("phil/doctor", b"doctor")
        if not came.wait(ARRIVAL_S):
            raise MissingError(f"no message within {ARRIVAL_S:.0f} s over {endpoint}")
    return f"a message went over {endpoint}"


@check(
    BASICS, "disk", "no training, no recordings (--out)",
    "free some space, or work in another directory",
)  # fmt: skip
def disk() -> str:
    """Room where runs are written by default, and the right to write there."""
    with tempfile.NamedTemporaryFile(dir=Path.cwd(), prefix=".doctor-") as file:
        file.write(b"doctor")
    free = shutil.disk_usage(Path.cwd()).free
    if free < DISK_BYTES:
        raise MissingError(f"{free / 1e9:.1f} GB are free here, {DISK_BYTES / 1e9:.0f} are wanted")
    return f"{free / 1e9:.0f} GB free in {Path.cwd()}"


@check(BASICS, "memory", "no training", "end other programs")
def memory() -> str:
    """Memory that could be had now."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    available = next(int(line.split()[1]) * 1024 for line in lines if "MemAvailable" in line)
    if available < MEMORY_BYTES:
        raise MissingError(f"{available / 1e9:.1f} GB available, {MEMORY_BYTES / 1e9:.0f} wanted")
    return f"{available / 1e9:.0f} GB available, {os.cpu_count()} cores"


@check("training", "locked versions", "everything, but not to the last bits of results/", INSTALL)
def versions() -> str:
    """What is installed is what the lock names."""
    locked = dict(line.split("==") for line in LOCK.read_text().splitlines() if "==" in line)
    found = {name: version for name in locked if (version := _installed(name)) is not None}
    other = [
        f"{name} {version} (locked: {locked[name]})"
        for name, version in found.items()
        # torch says +cpu or +cu130 behind its version.
        if version.split("+")[0] != locked[name]
    ]
    if other:
        raise MissingError(f"other versions: {', '.join(other)}")
    return f"{len(found)} packages as in {LOCK.name}"


@check(
    "training", "C++ kernel", "everything, but `trainer train` takes several times as long",
    "a C++ compiler: apt install g++",
)  # fmt: skip
def kernel() -> str:
    """The learner's C++ kernel builds and loads."""
    facts = _torch_facts()
    if not facts["kernel"]:
        raise MissingError("; ".join(facts["why"]) or "turned off by PHIL_KERNEL=0")
    return "the learner's kernel is built and loaded"


@check(
    "training", "GPU", "no `trainer train --device cuda`; the processor trains, too",
    "an NVIDIA GPU with its driver, and torch with CUDA",
)  # fmt: skip
def gpu() -> str:
    """Torch sees a CUDA device."""
    facts = _torch_facts()
    if not facts["gpu"]:
        raise MissingError(f"torch {facts['torch']} sees no CUDA device")
    return str(facts["gpu"])


@check(
    "person", "window", "no `--human keyboard`, `gamepad` or `wheel`, no rerun window (--spawn)",
    "a desktop session; without one: --human web, and --serve or --save",
)  # fmt: skip
def window() -> str:
    """SDL opens the display that pygame's window would be on."""
    facts = _sdl()
    if facts["driver"] in ("", "dummy", "offscreen"):
        shown = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        where = f"display {shown}" if shown else "neither DISPLAY nor WAYLAND_DISPLAY is set"
        raise MissingError(f"SDL opens no window ({where})")
    return f"SDL's driver {facts['driver']}"


@check(
    "person", "gamepad or wheel", "no `--human gamepad`, no `--human wheel`",
    "plug one in; if it is: the right to read /dev/input/* (group input)",
)  # fmt: skip
def controller() -> str:
    """SDL sees a gamepad or a steering wheel."""
    found = _sdl()["controllers"]
    if found:
        return ", ".join(found)
    unreadable = [
        str(path)
        for path in [*_EVENTS.glob("event*"), *_EVENTS.glob("js*")]
        if not os.access(path, os.R_OK)
    ]
    if unreadable:
        raise MissingError(f"none that may be read: no right to {', '.join(sorted(unreadable))}")
    raise MissingError("SDL sees no game controller")


@check("person", "Xvfb", "tests and pictures of the window skip", "apt install xvfb")
def xvfb() -> str:
    """An X server without a screen starts, and ends."""
    reader, writer = os.pipe()
    command = [_program("Xvfb"), "-displayfd", str(writer), "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[writer], stderr=subprocess.DEVNULL)
    os.close(writer)
    try:
        with os.fdopen(reader) as pipe:
            display = pipe.readline().strip()
    finally:
        server.terminate()
        server.wait()
    if not display:
        raise MissingError("Xvfb ends at once")
    return f"display :{display} came up and went"


def program(name: str, *arguments: str) -> Callable[[], str]:
    """A probe: the program runs, and says what it is."""

    def probe() -> str:
        path = _program(name)
        return (output_of(path, *arguments).splitlines() or [path])[0]

    return probe


check("person", "xdotool", "tests that press real keys skip", "apt install xdotool")(
    program("xdotool", "--version")
)


@check(
    "person", "Chromium", "tests of the browser cockpit skip, no picture of it",
    "apt install chromium; any browser shows the cockpit",
)  # fmt: skip
def chromium() -> str:
    """A browser that runs without a screen."""
    from trainer.util import CHROMIUM, find_chromium

    if (path := find_chromium()) is None:
        raise MissingError(f"none of {', '.join(CHROMIUM)} is installed")
    return output_of(path, "--version")


@check(
    "seeing", "rerun's viewer",
    "no rerun window (--spawn), no pictures of rerun; --serve and --save do",
    "a graphics card with Vulkan, or apt install mesa-vulkan-drivers",
)  # fmt: skip
def rerun_viewer() -> str:
    """Rerun's viewer comes up without a screen, and goes."""
    from hil_tests.processes import headless_viewer

    with headless_viewer() as client:
        picture = client.take_screenshot()
    return f"came up and drew a picture of {len(picture) / 1000:.0f} kB"


def port(number: int) -> Callable[[], str]:
    """A probe: the port is free on loopback."""

    def probe() -> str:
        with socket.socket() as listener:
            # As a server does: links of one that has just ended are no bar.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind((LOOPBACK, number))
                listener.listen()
            except OSError as error:
                raise MissingError(f"{LOOPBACK}:{number}: {error.strerror}") from None
        return f"{LOOPBACK}:{number} is free"

    return probe


check(
    "ports", "7447", "no `bridge simulate`, no `bridge router` without options",
    "end who listens there, or give --listen and --connect another port",
)(port(7447))  # fmt: skip
check(
    "ports", "7448", "no `bridge ros2` without options",
    "end who listens there, or give --ros2-listen another port",
)(port(7448))  # fmt: skip
check("ports", "9876", "no --serve, no --spawn", "end the other rerun")(port(9876))
check("ports", "9090", "no --serve", "end the other rerun")(port(9090))


@check(
    "vehicle", "CAN over UDP", "no `hil_tests mock_hunter` without options",
    "a route for multicast on loopback: `ip route add 239.0.0.0/8 dev lo`",
)  # fmt: skip
def multicast_can() -> str:
    """A CAN frame from one bus to another on a group and port of their own."""
    import can

    from edge_runtime.vehicles.hunter.bus import open_bus, parse_bus

    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        number = probe.getsockname()[1]
    name = parse_bus(f"udp_multicast:239.74.163.9:{number}")
    with open_bus(name) as sender, open_bus(name) as receiver:
        sender.send(can.Message(arbitration_id=0x111, data=b"doctor", is_extended_id=False))
        heard = receiver.recv(ARRIVAL_S)
    if heard is None or bytes(heard.data) != b"doctor":
        raise MissingError("a frame did not arrive on loopback")
    return "a frame went through UDP multicast on loopback"


@check(
    "vehicle", "CAN interface", "no `edge_runtime run --bus socketcan:can0`",
    "a CAN adapter: `ip link set can0 up type can bitrate 500000`",
)  # fmt: skip
def can_interface() -> str:
    """SocketCAN's sockets open, and there is an interface to bind them to."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        raise MissingError(f"this kernel opens no CAN socket: {error.strerror}") from None
    kinds = {path.parent.name: path.read_text() for path in Path("/sys/class/net").glob("*/type")}
    found = sorted(name for name, kind in kinds.items() if kind.strip() == _CAN_DEVICE)
    if not found:
        raise MissingError("there is no CAN interface")
    return ", ".join(found)


@check(
    "vehicle", "virtual CAN", "no `--bus socketcan:vcan0`; udp_multicast does it",
    "root, and `modprobe vcan`: `ip link add vcan0 type vcan`",
)  # fmt: skip
def virtual_can() -> str:
    """The kernel makes a vcan device, in a network namespace that goes with the command."""
    _program("unshare")
    mine = () if os.geteuid() == 0 else ("--user", "--map-root-user")
    words = ("ip", "link", "add", "dev", "doctor0", "type", "vcan")
    output_of("unshare", *mine, "--net", *words, name="ip link add type vcan")
    return "a vcan device could be made"


@check(
    "vehicle", "real-time priority",
    "`edge_runtime run`, but a busy machine may make its commands late",
    "CAP_SYS_NICE, or `ulimit -r 99` (LimitRTPRIO=99 in a service)",
)  # fmt: skip
def realtime_priority() -> str:
    """A thread gets the priority that `edge_runtime run` may ask for."""
    try:
        # The thread keeps the priority to itself, and ends with it.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(1)).result()
    except OSError as error:
        raise MissingError(f"SCHED_FIFO is refused: {error.strerror}") from None
    return "SCHED_FIFO was given to a thread"


@check("board", "ssh", "no `deploy push`", "apt install openssh-client")
def ssh() -> str:
    """OpenSSH says its version on stderr."""
    path = _program("ssh")
    output_of(path, "-V")
    return path


def board(name: str) -> Callable[[], str]:
    """A probe: this machine can be the board, as `hil_tests board` would find out."""

    def probe() -> str:
        from hil_tests.board import why_not

        if reason := why_not(name):
            raise MissingError(reason)
        return f"hil_tests board --boards {name} can run"

    return probe


check(
    "board", "aarch64", "no `hil_tests board --boards aarch64`",
    "root, apt install debootstrap qemu-user-static qemu-system-arm qemu-utils",
)(board("aarch64"))  # fmt: skip
check(
    "board", "Python 3.8", "no `hil_tests board --boards python38`",
    "root, and a python3.8 (pyenv install 3.8)",
)(board("python38"))  # fmt: skip


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


@functools.lru_cache(maxsize=None)  # noqa: UP033
def _torch_facts() -> dict[str, Any]:
    # A driver that does not fit may end the process that asks for it.
    facts: dict[str, Any] = json.loads(output_of_python(_TORCH).splitlines()[-1])
    return facts


# Not functools.cache: an older Python, too, is to hear that it is too old.
@functools.lru_cache(maxsize=None)  # noqa: UP033
def _sdl() -> dict[str, Any]:
    # In a process of its own: a display that is gone may end it.
    facts: dict[str, Any] = json.loads(output_of_python(_SDL).splitlines()[-1])
    return facts


def output_of_python(script: str) -> str:
    """What a script prints, in a process of its own.

    Raises:
        ModuleNotFoundError: it imports what is not installed.
        MissingError: it fails in another way.
    """
    try:
        return output_of(sys.executable, "-c", script)
    except MissingError as error:
        absent = re.search(r"ModuleNotFoundError: No module named '([\w.]+)'", str(error))
        if absent is None:
            raise
        raise ModuleNotFoundError(name=absent[1]) from None


def output_of(*command: str, name: str = "") -> str:
    """What a program prints; ``name`` is for the error, the program's own if not given.

    Raises:
        MissingError: it is not there, fails, or does not end.
    """
    name = name or command[0].rpartition("/")[2]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S
        )
    except FileNotFoundError:
        raise MissingError(f"{name} is not installed") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise MissingError(f"{name}: {error}") from None
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise MissingError(f"{name}: {(lines or [f'exit status {done.returncode}'])[-1]}")
    return done.stdout.strip()


def _program(name: str) -> str:
    """Where it is."""
    if (path := shutil.which(name)) is None:
        raise MissingError(f"{name} is not installed")
    return path
