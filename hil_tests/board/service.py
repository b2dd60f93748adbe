"""The units under a real systemd: without rights, watched, and there again after a power cut."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from deploy.installer.systemd import MAIN_UNIT
from edge_runtime.errors import UserError
from hil_tests.board.booted import BootedPlace, control_group
from hil_tests.board.proof import Site, pack, prove, remove
from hil_tests.board.rootfs import BOOTABLE, fresh_root
from hil_tests.faults.processes import wait_until

CAN_UNIT = "phil-can.service"
_OPT, _PREFIX = "/opt/phil", "usr/local/python38"
_FACTS = ("Uid", "CapBnd", "CapEff", "NoNewPrivs", "Seccomp", "Cpus_allowed_list")
_BACK_LIMIT_S = 60.0
_EXPOSURE = re.compile(r"exposure level for \S+: ([0-9.]+)")
_FORBIDDEN = ("/etc/passwd", f"{_OPT}/current/policy.onnx", "/usr/bin/new", "/var/lib/new")


def prove_booted(python: str, cache: Path, wheels: Path) -> dict[str, Any]:
    """Install under systemd, drive, hang the service, pull the plug; a report for JSON.

    Args:
        python: a Python 3.8 with a prefix of its own, which is copied in.
        cache: keeps debootstrap's work.
        wheels: keeps the bundle's wheels.

    Raises:
        UserError: debootstrap, the installer or `systemd-analyze` failed.
        TimeoutError: the service did not come back.
    """
    with tempfile.TemporaryDirectory(prefix="phil-systemd-") as folder:
        root = Path(folder) / "root"
        bootstrap_s = fresh_root(BOOTABLE, root, cache)
        _copy_python(python, root)
        parcel = pack("linux-x86_64", Path(folder), wheels)
        with BootedPlace(root) as place:
            site = _site(place)
            version = place.run("systemctl", "--version").stdout.split("\n")[0]
            report = {"systemd": version, "debootstrap_s": bootstrap_s, **prove(site, parcel)}
            report["process"] = _facts(place)
            report["written"] = _written(place)
            report["can_unit"] = place.show(CAN_UNIT, "Result")
            report["exposure"] = {name: _exposure(place, name) for name in (MAIN_UNIT, CAN_UNIT)}
            report["hung_to_active_s"] = _hang(place)
        begun_s = time.monotonic()
        with BootedPlace(root) as place:
            _wait_until_active(place)
            report["boot_to_active_s"] = round(time.monotonic() - begun_s, 2)
            report["left_after_uninstall"] = remove(_site(place))
        return {"target": "linux-x86_64", **report}


def why_not_booted(python: str) -> str:
    """What is missing here; empty if nothing is."""
    if platform.machine() != "x86_64":
        return f"its bundle is for x86_64, not for {platform.machine()}"
    if shutil.which("debootstrap") is None:
        return "debootstrap is not there (Debian's package debootstrap)"
    if Path(python).resolve().parents[1] == Path("/usr"):
        return f"{python} has no prefix of its own that could be copied"
    return "" if control_group() else "no control groups of version 2 are mounted"


def _site(place: BootedPlace) -> Site:
    return Site(place, f"/{_PREFIX}/bin/python3.8", _OPT, "systemd")


def _copy_python(python: str, root: Path) -> None:
    """Beside the system's own; its library is found through the loader's list."""
    shutil.copytree(Path(python).resolve().parents[1], root / _PREFIX, symlinks=True)
    (root / "etc/ld.so.conf.d/python38.conf").write_text(f"/{_PREFIX}/lib\n")
    subprocess.run(["chroot", str(root), "/sbin/ldconfig"], check=True)


def _main_pid(place: BootedPlace) -> int:
    return int(place.show(MAIN_UNIT, "MainPID") or 0)


def _facts(place: BootedPlace) -> dict[str, str]:
    """What the kernel says of the service's process."""
    status = place.run("cat", f"/proc/{_main_pid(place)}/status").stdout
    rows = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
    return {name: " ".join(rows[name].split()) for name in _FACTS}


def _written(place: BootedPlace) -> list[str]:
    """Files that even root could write where the service lives: there should be none."""
    pid = _main_pid(place)
    return [path for path in _FORBIDDEN if place.of_service(pid, "touch", path).returncode == 0]


def _exposure(place: BootedPlace, unit: str) -> float:
    """`systemd-analyze security`: 10 is no protection at all."""
    said = place.run("systemd-analyze", "security", "--no-pager", unit).stdout
    found = _EXPOSURE.search(said)
    if found is None:
        raise UserError(f"systemd-analyze says no exposure level of {unit}")
    return float(found.group(1))


def _hang(place: BootedPlace) -> float:
    """Stop the process as a hang would; seconds until systemd has another one ready."""
    pid, begun_s = _main_pid(place), time.monotonic()
    place.run("sh", "-c", f"kill -STOP {pid}")
    wait_until(lambda: _main_pid(place) not in (0, pid), "another process", _BACK_LIMIT_S)
    _wait_until_active(place)
    return round(time.monotonic() - begun_s, 2)


def _wait_until_active(place: BootedPlace) -> None:
    wait_until(lambda: place.show(MAIN_UNIT, "ActiveState") == "active", MAIN_UNIT, _BACK_LIMIT_S)
