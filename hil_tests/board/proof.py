"""A bundle onto a board without a network, and an episode driven from there, over TLS."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from deploy.__main__ import main as deploy
from deploy.bundle import NAME, build_installer
from edge_runtime.errors import UserError
from hil_tests.board.emulation import emulated
from hil_tests.board.place import Place
from hil_tests.board.rootfs import AARCH64, fresh_root
from hil_tests.commands import BackgroundCommand
from hil_tests.faults.campaign import POLICY, PUBLIC_KEY

VEHICLE = "hunter01"
ENDPOINT = "tls/127.0.0.1:7447"
"""In a network of its own, so the port is free."""
_HEALTH_LIMIT_S = 90
"""An emulated start takes many times a board's own; the board's limit of 10 s is tested apart."""
_EPISODE_LIMIT_S = 180.0
_TMP = Path("tmp")


class Parcel(NamedTuple):
    """What is carried to the board, and what stays: the certificates of the others."""

    bundle: Path
    installer: Path
    trust: Path
    certificates: Path


class Site(NamedTuple):
    """Where on the board it is installed, with which Python, and who runs it."""

    place: Place
    python: str
    opt: str
    service: str = "process"


def prove_emulated(cache: Path, wheels: Path) -> dict[str, Any]:
    """Install linux-aarch64 into a fresh aarch64 root file system and drive; a report for JSON."""
    with emulated(), tempfile.TemporaryDirectory(prefix="phil-board-") as folder:
        root = Path(folder) / "root"
        bootstrap_s = fresh_root(AARCH64, root, cache)
        parcel = pack("linux-aarch64", Path(folder), wheels)
        with Place(root) as place:
            site = Site(place, "/usr/bin/python3", "/opt/phil")
            report = prove(site, parcel)
            report["left_after_uninstall"] = remove(site)
        return {"target": "linux-aarch64", "debootstrap_s": bootstrap_s, **report}


def prove_twin(python: str, wheels: Path) -> dict[str, Any]:
    """Install linux-x86_64, the versions of jetpack5, under this machine's Python 3.8 and drive."""
    with tempfile.TemporaryDirectory(prefix="phil-twin-") as folder:
        parcel = pack("linux-x86_64", Path(folder), wheels)
        with Place() as place:
            site = Site(place, python, f"{folder}/opt")
            report = prove(site, parcel)
            report["left_after_uninstall"] = remove(site)
        return {"target": "linux-x86_64", **report}


def pack(target: str, folder: Path, wheels: Path) -> Parcel:
    """Keys, certificates and a bundle, made by the commands that a person would type."""
    keys, certificates, out = (folder / name for name in ("keys", "certs", "bundles"))
    config = folder / "config.toml"
    config.write_text(f'connect = "{ENDPOINT}"\nvehicle_id = "{VEHICLE}"\n')
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        deploy(["keys", "--out", str(keys)])
        deploy(["certs", "--out", str(certificates), "--vehicle-id", VEHICLE])
        deploy(
            ["bundle", "--policy", str(POLICY), "--public-key", str(PUBLIC_KEY),
             "--target", target, "--config", str(config), "--key", str(keys / "policy.key"),
             "--tls", str(certificates / f"edge-{VEHICLE}"),
             "--wheels", str(wheels), "--out", str(out)]
        )  # fmt: skip
    installer = folder / NAME
    installer.write_bytes(build_installer())
    return Parcel(next(out.glob("*.tar")), installer, keys / "policy.pub", certificates)


def prove(site: Site, parcel: Parcel) -> dict[str, Any]:
    """From files carried to the board to an episode driven by it.

    Raises:
        UserError: a step failed; its last line says why.
    """
    begun_s = time.time()
    bundle, installer, trust = _carry(parcel, site.place.root)
    say = _installer(
        site, installer, "install", bundle, "--trust", trust, "--service", site.service,
        "--health-limit", str(_HEALTH_LIMIT_S),
    )  # fmt: skip
    installed_s = time.time() - begun_s
    shown = json.loads(_installer(site, installer, "status", "--json"))
    episode, first_s = _drive(site.place, parcel.certificates)
    return {
        "bundle_mb": parcel.bundle.stat().st_size / 1e6,
        "python": _version(site),
        "machine": site.place.run(site.python, "-c", "import os; print(os.uname().machine)")
        .stdout.strip(),
        "installed_s": round(installed_s, 2),
        "root_to_first_command_s": round(first_s - begun_s, 2),
        "installer_said": say.strip().splitlines(),
        "status": shown,
        "episode": episode,
    }  # fmt: skip


def remove(site: Site) -> bool:
    """Uninstall with the installer that lies there; whether anything is left."""
    _installer(site, f"{site.opt}/current/{NAME}", "uninstall")
    return (site.place.root / site.opt.lstrip("/")).exists()


def _carry(parcel: Parcel, root: Path) -> list[str]:
    """Copies in the board's /tmp (where the board is this machine, they lie there already)."""
    if root == Path("/"):
        return [str(each) for each in parcel[:3]]
    for each in parcel[:3]:
        shutil.copy(each, root / _TMP)
    return [f"/{_TMP}/{each.name}" for each in parcel[:3]]


def _installer(site: Site, installer: str, *words: str) -> str:
    done = site.place.run(site.python, "-I", installer, *words, "--root", site.opt)
    if done.returncode != 0:
        lines = (done.stdout + done.stderr).strip().splitlines()
        raise UserError(f"install.pyz {words[0]}: {(lines or ['failed'])[-1]}")
    return done.stdout


def _drive(place: Place, certificates: Path) -> tuple[dict[str, Any], float]:
    """One left turn in real time: parts of the report, and when the first command came, epoch s."""
    out = certificates / "episode.json"
    beside = place.beside()
    simulate = [
        "bridge", "simulate", "--env", "left_turn", "--clock", "realtime", "--episodes", "1",
        "--listen", ENDPOINT, "--vehicle-id", VEHICLE, "--wait-edge-s", "60", "--out", str(out),
        "--tls", str(certificates / f"simulator-{VEHICLE}"),
    ]  # fmt: skip
    witness = ["hil_tests.board.witness", ENDPOINT, str(certificates / "viewer"), VEHICLE]
    with (
        BackgroundCommand(*simulate, prefix=beside, quiet=True) as simulator,
        BackgroundCommand(*witness, prefix=beside, quiet=True) as seen,
    ):
        simulator.wait(_EPISODE_LIMIT_S)
        seen.wait(_EPISODE_LIMIT_S)
        first_s = float(seen.said().split()[-1])
    report = json.loads(out.read_text())
    kept = ("success_rate", "answered_states", "latency_ms", "safe_stops", "rejected", "policy_id")
    (row,) = report["per_episode"]
    of_row = {name: row[name] for name in ("outcome", "steps", "distance_m", "time_s")}
    return {**{name: report[name] for name in kept}, **of_row}, first_s


def _version(site: Site) -> str:
    return site.place.run(site.python, "-c", "import platform; print(platform.python_version())"
                          ).stdout.strip()  # fmt: skip
