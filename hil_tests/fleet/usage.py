"""What a process has used so far: processor time and memory; and what its TCP links carried."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from typing import NamedTuple

from hil_tests.faults.processes import resident_mb

_PID = re.compile(r"pid=(\d+)")


class Usage(NamedTuple):
    """Totals since the process began."""

    cpu_s: float
    resident_mb: float
    """Now; 10^6 bytes."""


class Carried(NamedTuple):
    """Bytes of TCP payload (TLS records) at one end of a link, since it stands."""

    sent: int
    received: int


def usage(pid: int) -> Usage:
    """Of one process, with all of its threads."""
    with open(f"/proc/{pid}/stat") as stat:
        # After the name, which may hold spaces: utime and stime are fields 14 and 15 of all.
        fields = stat.read().rpartition(")")[2].split()
    cpu_s = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return Usage(cpu_s, resident_mb(pid))


def why_not_counted() -> str:
    """Why the bytes of links cannot be counted here; empty if they can."""
    return "" if shutil.which("ss") else "the command ss (package iproute2) is not there"


def carried(pids: Sequence[int], port: int) -> dict[int, Carried]:
    """By process: what its links to a port of loopback carried, from the kernel's TCP_INFO."""
    listing = subprocess.run(
        ["ss", "-tinpHO", "state", "established", f"( dport = :{port} )"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    return parse(listing, pids)


def parse(listing: str, pids: Sequence[int]) -> dict[int, Carried]:
    """The sums over all links of each process in a listing of `ss -tinpHO`."""
    found = dict.fromkeys(pids, Carried(0, 0))
    for line in listing.splitlines():
        match = _PID.search(line)
        if match is None or int(match[1]) not in found:
            continue
        pid = int(match[1])
        sent, received = found[pid]
        found[pid] = Carried(
            sent + _count(line, "bytes_sent"), received + _count(line, "bytes_received")
        )
    return found


def _count(line: str, name: str) -> int:
    match = re.search(rf"\b{name}:(\d+)", line)
    return int(match[1]) if match else 0
