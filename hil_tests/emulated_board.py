"""An aarch64 computer that qemu emulates: Debian 11 on a disk of its own, and ssh to it."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from edge_runtime.util import UserError
from hil_tests.processes import wait_until

_PROGRAMS = {
    "qemu-system-aarch64": "qemu-system-arm",
    "qemu-img": "qemu-utils",
    "qemu-aarch64-static": "qemu-user-static",
    "debootstrap": "debootstrap",
    "ssh": "openssh-client",
}
_BOOT_LIMIT_S = 300.0

# The kernel's handler of aarch64 programs has a name of its own, and goes when this ends.
_MAKE_IMAGE = """\
cache=$1 key=$2 root=$1/root
kernel=/proc/sys/fs/binfmt_misc
[ -e $kernel/register ] || mount -t binfmt_misc binfmt_misc $kernel
if [ ! -e $kernel/qemu-aarch64 ]; then
    line=$(sed s/qemu-aarch64:/phil-aarch64:/ /usr/lib/binfmt.d/qemu-aarch64.conf)
    printf %s "${line%F}F" > $kernel/register
    trap 'echo -1 > $kernel/phil-aarch64' EXIT
fi
debootstrap --arch=arm64 --variant=minbase --include=python3,systemd-sysv,dbus,udev,iproute2,\
openssh-server,openssh-client,linux-image-cloud-arm64 bullseye "$root" >&2
cd "$root"
mkdir -p root/.ssh
cp "$key" root/.ssh/authorized_keys
chmod 0700 root/.ssh
printf '[Match]\\nName=e*\\n[Network]\\nAddress=10.0.2.15/24\\n' > etc/systemd/network/10.network
ln -s /lib/systemd/system/systemd-networkd.service etc/systemd/system/multi-user.target.wants/
echo board > etc/hostname
echo '127.0.0.1 localhost board' > etc/hosts
echo '/dev/vda / ext4 defaults 0 1' > etc/fstab
rm -rf debootstrap var/cache/apt/archives/*.deb usr/share/doc usr/share/locale
cp boot/vmlinuz-* "$cache/kernel"
cp boot/initrd.img-* "$cache/initrd"
truncate -s 3G "$cache/draft"
mkfs.ext4 -q -F -d . "$cache/draft"
mv "$cache/draft" "$cache/disk"
"""
# Its clock counts instructions, 1 ns each, and goes with ours only while it has nothing to do. So
# it has as much time as a board, however slow the emulation is.
_EMULATE = """\
exec setpriv --pdeathsig KILL qemu-system-aarch64 -machine virt -cpu cortex-a72 -smp 2 -m 1024 \
    -icount shift=0,sleep=on -accel tcg,thread=single -display none -serial none -monitor none \
    -kernel "$1/kernel" -initrd "$1/initrd" -append "root=/dev/vda rw quiet net.ifnames=0" \
    -drive "if=virtio,format=qcow2,file=$2" -device virtio-rng-pci \
    -netdev "user,id=n,restrict=on,hostfwd=tcp:127.0.0.1:$3-:22" \
    -device virtio-net-pci,netdev=n,romfile=
"""


class Computer:
    """An emulated board with a disk of its own: on, or without power."""

    def __init__(self, cache: Path, folder: Path) -> None:
        self._cache, self._folder = cache.absolute(), folder
        self._disk = folder / "disk.qcow2"
        self._port = free_port()
        self._config = folder / "ssh_config"
        self._config.write_text(
            f"Host board\n HostName 127.0.0.1\n Port {self._port}\n User root\n"
            f" IdentityFile {self._cache}/key\n StrictHostKeyChecking no\n"
            " UserKnownHostsFile /dev/null\n LogLevel ERROR\n"
        )
        base = ["-b", str(self._cache / "disk"), "-F", "raw"]
        subprocess.run(["qemu-img", "create", "-q", "-f", "qcow2", *base, self._disk], check=True)
        self._machine: subprocess.Popen[bytes] | None = None

    def boot(self) -> float:
        """Switch it on; how long it took until all of its services were up, s."""
        words = ["sh", "-c", _EMULATE, "sh", self._cache, self._disk, self._port]
        begun_s = time.monotonic()
        self._machine = subprocess.Popen([str(word) for word in words], stdin=subprocess.DEVNULL)
        wait_until(self._is_up, "the emulated computer is up", _BOOT_LIMIT_S)
        return round(time.monotonic() - begun_s, 1)

    def cut_power(self) -> None:
        """Everything in it ends at once, and what was not written to its disk is lost."""
        if self._machine is not None:
            self._machine.kill()
            self._machine.wait()
            self._machine = None

    def run(self, command: str) -> subprocess.CompletedProcess[str]:
        """A shell's command, by ssh, to its end."""
        return subprocess.run(self.ssh(command), capture_output=True, text=True, check=False)

    def ssh(self, *words: str, options: tuple[str, ...] = ()) -> list[str]:
        """The words that run a command there, or only keep up what `options` ask for."""
        return ["ssh", "-F", str(self._config), "-o", "ConnectTimeout=5", *options, "board", *words]

    def copy(self, *paths: Path) -> None:
        """Files into its root's home."""
        subprocess.run(["scp", "-q", "-F", self._config, *paths, "board:"], check=True)

    @contextlib.contextmanager
    def known_to_ssh(self) -> Iterator[None]:
        """Let `ssh board` of any program that we start mean this computer."""
        programs = self._folder / "programs"
        programs.mkdir(exist_ok=True)
        for name in ("ssh", "scp"):
            there = shutil.which(name)
            (programs / name).write_text(f'#!/bin/sh\nexec {there} -F {self._config} "$@"\n')
            (programs / name).chmod(0o755)
        before = os.environ["PATH"]
        os.environ["PATH"] = f"{programs}{os.pathsep}{before}"
        try:
            yield
        finally:
            os.environ["PATH"] = before

    def show(self, unit: str, name: str) -> str:
        """A property of a unit, as `systemctl show` prints it."""
        return self.run(f"systemctl show --value --property={name} {unit}").stdout.strip()

    def _is_up(self) -> bool:
        assert self._machine is not None
        if self._machine.poll() is not None:
            raise UserError(f"qemu ended with status {self._machine.returncode}")
        return self.run("systemctl is-system-running").stdout.strip() in ("running", "degraded")

    def __enter__(self) -> Computer:
        return self

    def __exit__(self, *_: object) -> None:
        self.cut_power()


def make_image(cache: Path) -> None:
    """A disk with Debian on it, its kernel, and the key that opens it; minutes, once.

    Raises:
        UserError: debootstrap failed, for instance without a network.
    """
    cache.mkdir(parents=True, exist_ok=True)
    for name in ("key", "key.pub"):
        (cache / name).unlink(missing_ok=True)
    shutil.rmtree(cache / "root", ignore_errors=True)
    key = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(cache / "key")]
    subprocess.run(key, check=True)
    # In a mount namespace of its own: what it mounts is gone with it, whatever happens.
    apart = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-e", "-c"]
    done = subprocess.run(
        [*apart, _MAKE_IMAGE, "sh", str(cache.absolute()), str((cache / "key.pub").absolute())],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    shutil.rmtree(cache / "root", ignore_errors=True)
    if done.returncode != 0:
        lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        raise UserError(f"no image of the board: {(lines or ['failed'])[-1]}")


def why_not_emulated() -> str:
    """The first program that is missing for it here, with its package; empty if none is."""
    for program, package in _PROGRAMS.items():
        if shutil.which(program) is None:
            return f"{program} is not there (Debian's package {package})"
    return ""


def free_port() -> int:
    """A TCP port of loopback that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
