"""A place whose first process is systemd: the service as a board starts it, and starts it again."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from hil_tests.board.place import Place
from hil_tests.processes import wait_until

_BOOT_LIMIT_S = 90.0
_DEVICES = "null zero full random urandom tty"
# What systemd wants to find in a container (CONTAINER_INTERFACE.md of its documentation).
_ENTER = f"""\
ip link set lo up
mount --bind "$1" "$1"
mount -t proc proc "$1/proc"
mount -t sysfs -o ro sysfs "$1/sys"
mount -t cgroup2 cgroup2 "$1/sys/fs/cgroup"
mount -t tmpfs -o mode=755 tmpfs "$1/run"
mount -t tmpfs -o mode=755 tmpfs "$1/dev"
for name in {_DEVICES}; do touch "$1/dev/$name"; mount --bind "/dev/$name" "$1/dev/$name"; done
mkdir "$1/dev/pts" "$1/dev/shm"
mount -t devpts -o newinstance,ptmxmode=0666 devpts "$1/dev/pts"
mount -t tmpfs tmpfs "$1/dev/shm"
ln -s pts/ptmx "$1/dev/ptmx"
ln -s /proc/self/fd "$1/dev/fd"
echo ready
exec env -i container=phil PATH=/usr/sbin:/usr/bin:/sbin:/bin chroot "$1" \\
    /lib/systemd/systemd --log-target=null > /dev/null 2>&1
"""


def control_group() -> Path | None:
    """Where this machine shows its control groups of version 2; None if nowhere."""
    for line in Path("/proc/self/mountinfo").read_text().splitlines():
        fields, _, rest = line.partition(" - ")
        if rest.startswith("cgroup2 "):
            return Path(fields.split()[4])
    return None


class BootedPlace(Place):
    """A `Place` with systemd, in a control group of its own, which goes with it."""

    def __init__(self, root: Path) -> None:
        top = control_group()
        if top is None:
            raise OSError(0, "no control groups of version 2 are mounted")
        self._group = top / f"phil-{os.getpid()}"
        self._group.mkdir(exist_ok=True)
        super().__init__(root, _ENTER, ["--cgroup", "--ipc", "--uts"], self._group)
        wait_until(self._is_up, "systemd is up", _BOOT_LIMIT_S)

    def close(self) -> None:
        """Pull the plug: everything inside is killed, nothing is shut down."""
        super().close()
        wait_until(self._is_removed, "an empty control group")

    def show(self, unit: str, name: str) -> str:
        """A property of a unit, as `systemctl show` prints it."""
        return self.run("systemctl", "show", "--value", f"--property={name}", unit).stdout.strip()

    def of_service(self, pid: int, *command: str) -> subprocess.CompletedProcess[str]:
        """Run a command with the file system as a service's process sees it, but as root."""
        return self.run("nsenter", "--target", str(pid), "--mount", f"--root=/proc/{pid}/root",
                        "--wd=/", *command)  # fmt: skip

    def _is_removed(self) -> bool:
        try:
            for folder, _, _ in os.walk(self._group, topdown=False):
                os.rmdir(folder)
        except OSError:  # the last of its processes is still on its way out
            return False
        return True

    def _is_up(self) -> bool:
        return self.run("systemctl", "is-system-running").stdout.strip() in ("running", "degraded")
