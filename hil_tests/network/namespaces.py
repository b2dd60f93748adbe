"""Two network namespaces with nothing in them but loopback, and whether this machine can."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

TUN_DEVICE = Path("/dev/net/tun")


class Pair(NamedTuple):
    """The names of the simulator's and of the edge runtime's namespace."""

    simulator: str
    edge: str


@functools.cache
def why_not() -> str:
    """What is missing for a kernel network here; empty if nothing is."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "the command ip (package iproute2) is not there"
    if not TUN_DEVICE.exists():
        return f"{TUN_DEVICE} is not there"
    try:
        with namespaces("probe"):
            return ""
    except subprocess.CalledProcessError as error:
        return f"network namespaces do not work here: {error.stderr.strip()}"


@contextlib.contextmanager
def namespaces(tag: str) -> Iterator[Pair]:
    """Make two namespaces and remove them at the end, whatever happens in between.

    The processes in them must have ended by then: they would keep a nameless namespace alive.
    """
    pair = Pair(*(f"phil-{os.getpid()}-{tag}-{side}" for side in ("sim", "edge")))
    with contextlib.ExitStack() as stack:
        for name in pair:
            ip("netns", "add", name)
            stack.callback(ip, "netns", "delete", name)
            ip("-netns", name, "link", "set", "lo", "up")
        yield pair


def inside(name: str) -> tuple[str, ...]:
    """The words to put before a command that is to run in a namespace.

    It gets a shared memory of its own: two Zenoh sessions that see the same /dev/shm leave
    messages over 3 kB there, and the network between them would carry only where they lie.
    """
    own_memory = 'mount -t tmpfs tmpfs /dev/shm && exec "$@"'
    return ("ip", "netns", "exec", name, "unshare", "--mount", "sh", "-c", own_memory, "sh")


def ip(*arguments: str) -> str:
    """Run ``ip``; CalledProcessError with its own words if it refuses."""
    return subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True).stdout
