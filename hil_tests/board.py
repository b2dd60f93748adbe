"""``python -m hil_tests board``: a bundle onto boards that are not there, and what that took.

- `aarch64` is a whole computer, emulated by qemu: Debian 11 with its own kernel, systemd, OpenSSH,
  Python 3.9 and glibc 2.31, and no network but our ssh to it. `deploy push` installs there; then a
  simulator drives it, it is upgraded, rolled back, given changed and faulty bundles, hung, and
  loses its power: qemu is killed, and with it whatever the board's kernel had not yet written.
- `python38` is this computer with Python 3.8 and no systemd, as in a container: the versions of
  the jetpack5 bundle, installed without a network, and run as `deploy/README.md` says.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import subprocess
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

from deploy.__main__ import main as deploy
from deploy.bundle import (
    DEFAULT_FOLDER,
    NAME,
    ROOT,
    TARGETS,
    Inputs,
    build_edge_wheel,
    build_installer,
    make_bundle,
)
from deploy.installer.systemd import MAIN_UNIT
from edge_runtime.cli import examples, positive, sigterm_as_interrupt
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.transport import free_endpoint
from edge_runtime.util import UserError
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, wait_until

Keep = Callable[[dict[str, Any]], None]  # Given a report, for JSON, each time when it has grown

BOARDS = ("aarch64", "python38")
CACHE, WHEELS = ROOT / "build/board", ROOT / DEFAULT_FOLDER
"""Of the emulated board's disk, and of the bundles' wheels."""
IMAGE = Path(__file__).with_name("board_image.sh")
VEHICLE, _PORT = "hunter01", 7447
ENDPOINT = f"tls/127.0.0.1:{_PORT}"
_EPISODE_LIMIT_S, _BACK_LIMIT_S = 600.0, 600.0
_CHANGED_BYTES = 20
_FACTS = ("Uid", "CapBnd", "CapEff", "NoNewPrivs", "Seccomp", "Cpus_allowed_list")
INSTALL = f"python3 -I {NAME}"
_FORBIDDEN = ("/etc/passwd", "/opt/phil/current/policy.onnx", "/usr/bin/new", "/var/lib/new")
_LIBRARIES = "/opt/libraries"
_WHAT_IT_IS = "uname -rm; systemctl --version | head -1; python3 --version; ssh -V 2>&1"
_FINGERPRINT = "find /opt/phil /etc/systemd/system -printf '%p %s %T@\\n' | sha256sum"
FAULTS = {
    "it never says that it is ready": "import os; os.environ.pop('NOTIFY_SOCKET', None)",
    "it is ready and then silent": "import os; os.environ.pop('WATCHDOG_USEC', None)",
    "it ends as a service only": "import os, sys; a = sys.argv;"
    " 'run' in a and '--vehicle' not in a and os._exit(5)",
}
"""Releases that must go back by themselves: what Python runs at the start of each."""
EXAMPLE = examples("python -m hil_tests board --boards python38 --out runs/board.json")
_PROGRAMS = {
    "qemu-system-aarch64": "qemu-system-arm",
    "qemu-img": "qemu-utils",
    "qemu-aarch64-static": "qemu-user-static",
    "debootstrap": "debootstrap",
    "ssh": "openssh-client",
}
_BOOT_LIMIT_S = 300.0

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    boards = "an emulated aarch64 computer with systemd; Python 3.8 without systemd"
    parser.add_argument("--boards", nargs="+", choices=BOARDS, default=list(BOARDS), help=boards)
    cuts = "power cuts of the emulated one"
    parser.add_argument("--cuts", metavar="N", type=positive, default=8, help=cuts)
    parser.add_argument("--out", metavar="R.json", help="write the reports to this file")


def run(arguments: argparse.Namespace) -> int:
    """Prove each board; UserError where this machine cannot, or a step failed."""
    if arguments.out is not None:
        check_writable(arguments.out)
    for board in arguments.boards:
        if reason := why_not(board):
            raise UserError(f"no {board} here: {reason}")
    report: dict[str, Any] = {"cores": os.cpu_count()}
    with sigterm_as_interrupt():
        for board in arguments.boards:

            def keep(found: dict[str, Any], board: str = board) -> None:
                report[board] = found
                write_json_out(arguments.out, report)

            prove(board, arguments.cuts, keep)
            print(f"{board}: {json.dumps(report[board], indent=1)}", flush=True)
    return 0


def prove(board: str, cuts: int, keep: Keep) -> None:
    """Prove one of BOARDS."""
    if board == "aarch64":
        prove_aarch64(cuts, keep)
    else:
        keep(prove_python38())


def why_not(board: str) -> str:
    """What is missing for one of BOARDS here; empty if nothing is."""
    if os.geteuid() != 0:
        return "it needs root"
    if board == "python38":
        return "" if find_python38() else "no Python 3.8 on PATH or under ~/.pyenv"
    for program, package in _PROGRAMS.items():
        if shutil.which(program) is None:
            return f"{program} is not there (Debian's package {package})"
    return ""


def find_python38() -> str | None:
    """A Python 3.8 of this machine; None without one."""
    candidates = [shutil.which("python3.8")]
    candidates += [str(p) for p in sorted(Path.home().glob(".pyenv/versions/3.8*/bin/python"))]
    for candidate in filter(None, candidates):
        version = subprocess.run([candidate, "--version"], capture_output=True, check=False).stdout
        if version.startswith(b"Python 3.8."):
            return candidate
    return None


class Parcels:
    """Makes bundles: whole ones as a person would, and light ones whose libraries lie there."""

    def __init__(self, folder: Path, endpoint: str) -> None:
        self._folder = folder
        self.trust, self.certificates = folder / "keys/policy.pub", folder / "certs"
        self._key, self._tls = folder / "keys/policy.key", self.certificates / f"edge-{VEHICLE}"
        self._config = folder / "edge.toml"
        self._config.write_text(f'connect = "{endpoint}"\nvehicle_id = "{VEHICLE}"\n')
        with _silent():
            deploy(["keys", "--out", str(folder / "keys")])
            deploy(["certs", "--out", str(self.certificates), "--vehicle-id", VEHICLE])
        self._edge = build_edge_wheel(folder / "edge")
        (folder / NAME).write_bytes(build_installer())

    def whole(self, target: str) -> Path:
        """A bundle with every wheel."""
        with _silent():
            deploy(
                ["bundle", "--policy", str(POLICY), "--public-key", str(PUBLIC_KEY),
                 "--target", target, "--config", str(self._config), "--key", str(self._key),
                 "--tls", str(self._tls), "--wheels", str(WHEELS),
                 "--out", str(self._folder / target)]
            )  # fmt: skip
        return next((self._folder / target).glob("*.tar"))

    def light(self, line: str) -> Path:
        """A bundle for the emulated board of which a path file takes the place of most wheels.

        `line` is a further one of that file; Python runs it at its start.
        """
        host = self._folder / "host-1.0-py3-none-any.whl"
        with zipfile.ZipFile(host, "w") as wheel:
            wheel.writestr("host.pth", f"{_LIBRARIES}\n{line}\n")
        wheels = [self._edge, host]
        inputs = Inputs(POLICY, PUBLIC_KEY, self._key, self._config, self._tls, wheels)
        return make_bundle(inputs, TARGETS["linux-aarch64"], self._folder / "light").path


class Board:
    """An emulated board with a disk of its own, on or without power, and the installer on it."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._disk, self._port = folder, folder / "disk.qcow2", _free_port()
        self._config = folder / "ssh_config"
        self._config.write_text(
            f"Host board\n HostName 127.0.0.1\n Port {self._port}\n User root\n"
            f" IdentityFile {CACHE}/key\n StrictHostKeyChecking no\n"
            " UserKnownHostsFile /dev/null\n LogLevel ERROR\n"
        )
        base = ["-b", str(CACHE / "disk"), "-F", "raw"]
        subprocess.run(["qemu-img", "create", "-q", "-f", "qcow2", *base, self._disk], check=True)
        self._machine: subprocess.Popen[bytes] | None = None

    def boot(self) -> float:
        """Switch it on; how long it took until all of its services were up, s."""
        words = ["sh", "-c", _EMULATE, "sh", str(CACHE), str(self._disk), str(self._port)]
        begun_s = time.monotonic()
        self._machine = subprocess.Popen(words, stdin=subprocess.DEVNULL)
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

    def install(self, bundle: Path) -> subprocess.CompletedProcess[str]:
        """Copy a bundle and its signature there, and install it."""
        self.copy(bundle, Path(f"{bundle}.sig"))
        return self.run(f"{INSTALL} install {bundle.name}")

    def must(self, command: str) -> None:
        """An installer's command that must succeed. UserError with its line."""
        if (done := self.run(f"{INSTALL} {command}")).returncode != 0:
            raise UserError(f"on the board: {done.stderr.strip()}")

    def status(self) -> dict[str, Any]:
        """What the installed release says of itself. UserError where it is not whole."""
        done = self.run(f"python3 /opt/phil/current/{NAME} status --json")
        if done.returncode != 0:
            raise UserError(f"the board is broken: {(done.stdout + done.stderr).strip()}")
        return dict(json.loads(done.stdout))

    def current(self) -> str:
        """The version that is current, and whole."""
        return str(self.status()["current"])

    def wait_until_active(self) -> None:
        """Until the service is up; TimeoutError."""
        wait_until(
            lambda: self.show(MAIN_UNIT, "ActiveState") == "active", MAIN_UNIT, _BACK_LIMIT_S
        )

    def show(self, unit: str, name: str) -> str:
        """A property of a unit, as `systemctl show` prints it."""
        return self.run(f"systemctl show --value --property={name} {unit}").stdout.strip()

    def _is_up(self) -> bool:
        assert self._machine is not None
        if self._machine.poll() is not None:
            raise UserError(f"qemu ended with status {self._machine.returncode}")
        return self.run("systemctl is-system-running").stdout.strip() in ("running", "degraded")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cut_power()


def make_image() -> None:
    """A disk with Debian, its kernel and a key; minutes, once. UserError without a network."""
    CACHE.mkdir(parents=True, exist_ok=True)
    # In a mount namespace of its own: what it mounts is gone with it, whatever happens.
    apart = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-e", "-c"]
    words = [*apart, IMAGE.read_text(), "sh", str(CACHE)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    shutil.rmtree(CACHE / "root", ignore_errors=True)
    if done.returncode != 0:
        lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        raise UserError(f"no image of the board: {(lines or ['failed'])[-1]}")


def prove_aarch64(cuts: int, keep: Keep) -> None:
    """Install, drive, upgrade, spoil, hang and cut off an emulated board; UserError if it fails."""
    if not (CACHE / "disk").exists():
        make_image()
    with tempfile.TemporaryDirectory(prefix="phil-board-") as place:
        folder = Path(place)
        parcels = Parcels(folder, ENDPOINT)
        with Board(folder) as board:
            report: dict[str, Any] = {"boot_s": board.boot(), "is": board.run(_WHAT_IT_IS).stdout}
            report |= _push(board, parcels)
            report["status"] = board.status()
            report["episode"] = _drive_through_ssh(board, parcels)
            report["service"] = _look_at_service(board)
            report["hung_to_active_s"] = _hang(board)
            keep(report)
            lights = [parcels.light(f"# {number}") for number in range(3)]
            board.run(f"cp -al /opt/phil/current/site-packages {_LIBRARIES}")
            board.run(f"rm -r {_LIBRARIES}/edge_runtime")
            board.copy(folder / NAME)
            for light in lights:
                board.copy(light, Path(f"{light}.sig"))
            before = board.current()
            board.must(f"install {lights[0].name}")
            upgraded = board.current()
            board.must("rollback")
            report["rolled_back"] = upgraded != before and board.current() == before
            report["changed_bytes"] = _change_bytes(board, lights[1])
            report["faulty"] = {
                why: _install_faulty(board, parcels.light(line)) for why, line in FAULTS.items()
            }
            keep(report)
            for cut in _cut(board, lights, cuts):
                keep(report | {"power_cuts": cut})
            report["power_cuts"] = cut
            board.run(f"{INSTALL} uninstall")
            left = board.run("ls -d /opt/phil /etc/systemd/system/phil-*.service").stdout.split()
            keep(report | {"left_after_uninstall": left})


def _push(board: Board, parcels: Parcels) -> dict[str, Any]:
    """`deploy push` of a whole bundle, over the system's ssh, to a healthy service."""
    bundle = parcels.whole("linux-aarch64")
    push = ["push", "board", str(bundle), "--trust", str(parcels.trust), "--no-sudo"]
    begun_s = time.monotonic()
    with board.known_to_ssh(), _silent():
        if deploy(push) != 0:
            raise UserError("deploy push does not install; its own line above says why")
    took_s = round(time.monotonic() - begun_s, 1)
    return {"bundle_mb": bundle.stat().st_size / 1e6, "pushed_and_installed_s": took_s}


def _drive_through_ssh(board: Board, parcels: Parcels) -> dict[str, Any]:
    """One left turn by the board, which reaches the simulator here through our ssh only."""
    port = _free_port()
    tunnel = board.ssh("-N", options=("-R", f"{_PORT}:127.0.0.1:{port}"))
    with subprocess.Popen(tunnel, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as link:
        try:
            return _drive(parcels.certificates, port)
        finally:
            link.terminate()


def _drive(certificates: Path, port: int) -> dict[str, Any]:
    """One left turn in real time; parts of the simulator's report."""
    out = certificates / "episode.json"
    words = [
        "bridge", "simulate", "--env", "left_turn", "--clock", "realtime", "--episodes", "1",
        "--listen", f"tls/127.0.0.1:{port}", "--vehicle-id", VEHICLE, "--wait-edge-s", "120",
        "--tls", str(certificates / f"simulator-{VEHICLE}"), "--out", str(out),
    ]  # fmt: skip
    with Process(*words) as simulator:
        simulator.succeed(_EPISODE_LIMIT_S)
    report = json.loads(out.read_text())
    kept = ("success_rate", "answered_states", "latency_ms", "safe_stops", "rejected", "policy_id")
    return {name: report[name] for name in kept} | {"outcome": report["per_episode"][0]["outcome"]}


def _look_at_service(board: Board) -> dict[str, Any]:
    """What the kernel and systemd say of the service's process, and what it could write."""
    pid = board.show(MAIN_UNIT, "MainPID")
    lines = board.run(f"cat /proc/{pid}/status").stdout.splitlines()
    rows = dict(line.split(":", 1) for line in lines)
    enter = f"nsenter --target {pid} --mount --root=/proc/{pid}/root --wd=/ touch"
    said = board.run(f"systemd-analyze security --no-pager {MAIN_UNIT}").stdout
    return {
        **{name: " ".join(rows[name].split()) for name in _FACTS},
        "written": [path for path in _FORBIDDEN if board.run(f"{enter} {path}").returncode == 0],
        "can_unit": board.show("phil-can", "Result"),
        "exposure": float(said.split("exposure level for")[1].split(":")[1].split()[0]),
    }


def _hang(board: Board) -> float:
    """Stop the process as a hang would; seconds until systemd has another one ready."""
    pid, begun_s = board.show(MAIN_UNIT, "MainPID"), time.monotonic()
    board.run(f"kill -STOP {pid}")
    wait_until(
        lambda: board.show(MAIN_UNIT, "MainPID") not in ("0", pid), "another process", _BACK_LIMIT_S
    )
    board.wait_until_active()
    return round(time.monotonic() - begun_s, 1)


def _change_bytes(board: Board, bundle: Path) -> dict[str, Any]:
    """Change one byte of a bundle, many times: each is refused, with nothing written."""
    choice, data = random.Random(1), bundle.read_bytes()
    changed, refused = bundle.with_name("changed.tar"), 0
    shutil.copyfile(f"{bundle}.sig", f"{changed}.sig")
    before = board.run(_FINGERPRINT).stdout
    for place in choice.sample(range(len(data)), _CHANGED_BYTES):
        changed.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        done = board.install(changed)
        untouched = board.run(_FINGERPRINT).stdout == before
        refused += done.returncode == 2 and "is refused" in done.stderr and untouched
    return {"tried": _CHANGED_BYTES, "refused_and_nothing_written": refused}


def _install_faulty(board: Board, bundle: Path) -> dict[str, Any]:
    """Install a release that must go back by itself; what the installer says of it."""
    before = board.current()
    done = board.install(bundle)
    active = board.show(MAIN_UNIT, "ActiveState") == "active"
    went_back = board.current() == before and active
    return {"status": done.returncode, "said": done.stderr.strip(), "went_back": went_back}


def _cut(board: Board, lights: list[Path], cuts: int) -> Iterator[dict[str, Any]]:
    """Cut the power at random moments of upgrades; complete each. Yields what came of them."""
    choice = random.Random(1)
    begun_s = time.monotonic()
    board.must(f"install {lights[0].name}")
    whole_s = time.monotonic() - begun_s
    said_last, current = Counter[str](), Counter[str]()
    broken: list[str] = []
    boots_s: list[float] = []
    for number in range(cuts):
        before, bundle = board.current(), lights[(number + 1) % len(lights)]
        install = board.ssh(f"{INSTALL} install {bundle.name}")
        run = subprocess.Popen(
            install, text=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        time.sleep(choice.uniform(0.0, 1.1 * whole_s))
        board.cut_power()
        said = (run.communicate()[0].strip().splitlines() or ["nothing"])[-1].split()[0]
        said_last[said] += 1
        boots_s.append(board.boot())
        try:
            then = board.current()
            current["the old one" if then == before else "the new one"] += 1
            board.wait_until_active()
            board.must(f"install {bundle.name}")
            if board.current() == before:
                raise UserError("the same command does not complete it")
        except (UserError, TimeoutError) as error:
            broken.append(f"cut {number}: {error}")
        yield {
            "cuts": number + 1, "broken": broken, "killed_after_it_said": dict(said_last),
            "current_then": dict(current), "a_whole_upgrade_s": round(whole_s, 1),
            "boots_s": boots_s,
        }  # fmt: skip


def prove_python38() -> dict[str, Any]:
    """Install offline under Python 3.8, run the release as a container would, drive; a report."""
    python, port = str(find_python38()), _free_port()
    with tempfile.TemporaryDirectory(prefix="phil-python38-") as place:
        folder = Path(place)
        parcels = Parcels(folder, f"tls/127.0.0.1:{port}")
        bundle, opt = parcels.whole("linux-x86_64"), folder / "opt"

        def run(*words: str) -> str:
            done = subprocess.run(
                ["unshare", "--net", python, "-I", folder / NAME, *words, "--root", opt],
                capture_output=True, text=True, check=False, env={"PATH": os.defpath},
            )  # fmt: skip
            if done.returncode != 0:
                raise UserError(f"install.pyz {words[0]}: {done.stderr.strip()}")
            return done.stdout

        begun_s = time.monotonic()
        run("install", str(bundle), "--trust", str(parcels.trust), "--service", "none")
        report = {
            "bundle_mb": bundle.stat().st_size / 1e6,
            "installed_s": round(time.monotonic() - begun_s, 2),
            "status": json.loads(run("status", "--json")),
        }
        words = [str(opt / "current/bin/phil-edge"), "run", "--config", "config.toml"]
        with subprocess.Popen(words, cwd=opt / "current", stderr=subprocess.DEVNULL) as runtime:
            try:
                report["episode"] = _drive(parcels.certificates, port)
            finally:
                runtime.terminate()
        run("uninstall")
        return {**report, "left_after_uninstall": opt.exists()}


def _free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        yield
