"""A place apart: processes, mounts and a network of its own, all gone with one process."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from deploy.installer.apart import before_exec
from hil_tests.processes import wait_until

# Before onnxruntime is imported, /proc, /sys and /dev must be there.
_ENTER = """\
ip link set lo up
if [ "$1" = / ]; then
    mount -t proc proc /proc
else
    mount -t proc proc "$1/proc"
    mount --rbind /sys "$1/sys"
    mount --rbind /dev "$1/dev"
    printf '127.0.0.1 localhost\\n' > "$1/etc/hosts"
fi
exec chroot "$1" /bin/sh -c 'echo ready; while :; do sleep 3600 & wait; done'
"""


class Place:
    """Namespaces for mounts, processes and a network in which nothing is up but loopback.

    The holder is killed with this process, and with the holder every process in the place; the
    kernel then takes its mounts and its network away. Needs root.

    Args:
        root: the root directory of what runs inside; `/` for this machine's own.
        enter: the shell's words that make it and become its first process; they say `ready`.
        namespaces: further ones, as `unshare` calls them.
        control_group: a folder whose control group everything inside belongs to; None for ours.
    """

    def __init__(
        self,
        root: Path = Path("/"),
        enter: str = _ENTER,
        namespaces: Sequence[str] = (),
        control_group: Path | None = None,
    ) -> None:
        self.root = root
        self._unshare = subprocess.Popen(
            ["unshare", "--mount", "--net", "--pid", *namespaces, "--fork", "--kill-child",
             "sh", "-e", "-c", enter, "sh", str(root)],
            stdout=subprocess.PIPE, text=True, preexec_fn=_prepare(control_group),
        )  # fmt: skip
        assert self._unshare.stdout is not None
        if self._unshare.stdout.readline() != "ready\n":
            self._unshare.wait()
            raise OSError(self._unshare.returncode, "no namespaces, or no mounts in them")
        children = Path(f"/proc/{self._unshare.pid}/task/{self._unshare.pid}/children")
        self._holder = children.read_text().split()[0]

    def inside(self) -> list[str]:
        """The words before a command that runs inside."""
        return ["nsenter", "--target", self._holder, "--mount", "--net", "--pid",
                f"--root=/proc/{self._holder}/root", "--wd=/"]  # fmt: skip

    def beside(self) -> list[str]:
        """The words before a command that has its network only: this machine's own programs."""
        return ["nsenter", "--target", self._holder, "--net"]

    def run(self, *command: str, timeout_s: float = 600.0) -> subprocess.CompletedProcess[str]:
        """Run a command inside to its end, with an environment as bare as a service's."""
        return subprocess.run(
            [*self.inside(), "env", "-i", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", *command],
            capture_output=True, text=True, check=False, timeout=timeout_s,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip

    def close(self) -> None:
        """End all that runs inside, and wait until it has ended."""
        self._unshare.kill()
        self._unshare.communicate()
        wait_until(self._is_empty, "the end of what ran inside")

    def _is_empty(self) -> bool:
        """The kernel lets the first process of a place end (state Z) after all others."""
        try:
            return (
                Path(f"/proc/{self._holder}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
            )
        except FileNotFoundError:
            return True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _prepare(control_group: Path | None) -> Callable[[], None]:
    """What the child does before it becomes `unshare`: it ends with us, and joins the group."""
    end_with_us = before_exec(isolated=False, account=None)

    def prepare() -> None:
        if control_group is not None:
            (control_group / "cgroup.procs").write_text("0")
        end_with_us()

    return prepare
