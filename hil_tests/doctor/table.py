"""Every check, by what it is for: name, probe, what is not there without it, how to get it."""

from __future__ import annotations

from hil_tests.doctor import boards, links, machine, person, software
from hil_tests.doctor.check import INSTALL, Check

CHECKS: dict[str, tuple[Check, ...]] = {
    "basics": (
        Check("Python", software.python, "nothing", "Python 3.11 or newer; make PYTHON=...", True),
        Check("packages", software.packages, "nothing that imports them", INSTALL, True),
        Check(
            "loopback", links.zenoh_loopback, "no drive over Zenoh, no `make demo`, no `make test`",
            "TCP on 127.0.0.1: `ip link set lo up`, or a rule in the firewall", True,
        ),
        Check(
            "disk", machine.disk, "no training, no recordings (--out)",
            "free some space, or work in another directory", True,
        ),
        Check("memory", machine.memory, "no training", "end other programs", True),
    ),
    "training": (
        Check(
            "locked versions", software.versions,
            "everything, but not to the last bits of results/", INSTALL,
        ),
        Check(
            "C++ kernel", software.kernel, "everything, but `trainer train` takes several times as "
            "long", "a C++ compiler: apt install g++",
        ),
        Check(
            "GPU", software.gpu, "no `trainer train --device cuda`; the processor trains, too",
            "an NVIDIA GPU with its driver, and torch with CUDA",
        ),
    ),
    "person": (
        Check(
            "window", person.window,
            "no `--human keyboard`, `gamepad` or `wheel`, no rerun window (--spawn)",
            "a desktop session; without one: --human web, and --serve or --save",
        ),
        Check(
            "gamepad or wheel", person.controller, "no `--human gamepad`, no `--human wheel`",
            "plug one in; if it is: the right to read /dev/input/* (group input)",
        ),
        Check(
            "Xvfb", machine.xvfb, "tests and pictures of the window skip", "apt install xvfb",
        ),
        Check(
            "xdotool", machine.program("xdotool", "--version"),
            "tests that press real keys skip", "apt install xdotool",
        ),
        Check(
            "Chromium", machine.chromium,
            "tests of the browser cockpit skip, no picture of it",
            "apt install chromium; any browser shows the cockpit",
        ),
    ),
    "seeing": (
        Check(
            "rerun's viewer", person.rerun_viewer,
            "no rerun window (--spawn), no pictures of rerun; --serve and --save do",
            "a graphics card with Vulkan, or apt install mesa-vulkan-drivers",
        ),
    ),
    "ports": (
        Check(
            "7447", links.port(7447), "no `bridge simulate`, no `bridge router` without options",
            "end who listens there, or give --listen and --connect another port",
        ),
        Check(
            "7448", links.port(7448), "no `bridge ros2` without options",
            "end who listens there, or give --ros2-listen another port",
        ),
        Check("9876", links.port(9876), "no --serve, no --spawn", "end the other rerun"),
        Check("9090", links.port(9090), "no --serve", "end the other rerun"),
    ),
    "vehicle": (
        Check(
            "CAN over UDP", links.multicast_can, "no `hil_tests mock_hunter` without options",
            "a route for multicast on loopback: `ip route add 239.0.0.0/8 dev lo`",
        ),
        Check(
            "CAN interface", links.can_interface, "no `edge_runtime run --bus socketcan:can0`",
            "a CAN adapter: `ip link set can0 up type can bitrate 500000`",
        ),
        Check(
            "virtual CAN", links.virtual_can, "no `--bus socketcan:vcan0`; udp_multicast does it",
            "root, and `modprobe vcan`: `ip link add vcan0 type vcan`",
        ),
        Check(
            "real-time priority", machine.realtime_priority,
            "`edge_runtime run`, but a busy machine may make its commands late",
            "CAP_SYS_NICE, or `ulimit -r 99` (LimitRTPRIO=99 in a service)",
        ),
    ),
    "board": (
        Check("ssh", machine.ssh, "no `deploy push`", "apt install openssh-client"),
        Check(
            "aarch64", boards.board("aarch64"), "no `hil_tests board --boards aarch64`",
            "root, apt install debootstrap qemu-user-static",
        ),
        Check(
            "Python 3.8", boards.board("python38"), "no `hil_tests board --boards python38`",
            "root, and a python3.8 (pyenv install 3.8)",
        ),
        Check(
            "systemd", boards.board("systemd"), "no `hil_tests board --boards systemd`",
            "root, Python 3.8, debootstrap, control groups of version 2",
        ),
    ),
}  # fmt: skip
"""Group -> its checks."""
