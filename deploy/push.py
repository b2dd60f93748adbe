"""``python -m deploy push HOST``: a bundle onto a board, over the system's ssh and scp.

The installer that runs there is this workstation's own, not the bundle's: what verifies the bundle
must not come out of it.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import tempfile
from pathlib import Path

from deploy.bundle import NAME, build_installer
from deploy.installer.layout import DEFAULT_ROOT
from deploy.installer.systemd import SERVICES
from deploy.installer.verify import read_bundle, read_public_key
from edge_runtime.cli import examples
from edge_runtime.util import DEFAULT_PUBLIC_KEY, UserError

_UNATTENDED = ("-o", "BatchMode=yes", "-o", "ConnectTimeout=10")
"""A password asked for in the middle would hang a script, and so would a board without power."""
SSH, SCP = ("ssh", *_UNATTENDED), ("scp", "-q", "-p", *_UNATTENDED)
_HOST = re.compile(r"([A-Za-z0-9_][A-Za-z0-9_.-]*@)?[A-Za-z0-9\[][A-Za-z0-9_.:\]-]*")
_TRUST, _BUNDLE = "trust.pub", "bundle.tar"
"""Names over there, whatever the files are called here: a bundle may be called `install.pyz`."""

EXAMPLE = examples(
    "python -m deploy push user@board phil-jetpack5-1.tar --trust keys/policy.pub --dry-run",
    "python -m deploy push root@10.0.0.7 phil-jetpack5-1.tar --no-sudo --service systemd",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    trust = "public half of the key that signed the bundle; a new board will trust it"
    key, add = str(DEFAULT_PUBLIC_KEY), parser.add_argument
    add("host", metavar="HOST", help="[user@]name, as ssh knows it")
    add("bundle", metavar="BUNDLE.tar", help="bundle of `python -m deploy bundle`")
    add("--trust", metavar="KEY.pub", default=key, help=trust)
    add("--root", metavar="DIR", default=DEFAULT_ROOT, help="folder of the installation there")
    add("--service", choices=SERVICES, help="who runs the release there")
    add("--no-sudo", action="store_true", help="the user there needs no sudo")
    add("--dry-run", action="store_true", help="print each command and do nothing")


def run(arguments: argparse.Namespace) -> int:
    """Copy, install, and clean up; return the installer's exit status."""
    if not _HOST.fullmatch(arguments.host):
        raise UserError(f"host {arguments.host!r} is not valid: write name or user@name")
    # What the board would refuse is not sent.
    key = read_public_key(arguments.trust)
    manifest, _ = read_bundle(arguments.bundle, key)
    python, folder = f"python{manifest.target.python}", f"phil-push-{manifest.version}"
    install = [
        *([] if arguments.no_sudo else ["sudo", "-n"]),
        python, f"{folder}/{NAME}", "install", f"{folder}/{_BUNDLE}",
        "--trust", f"{folder}/{_TRUST}", "--root", arguments.root,
        *(["--service", arguments.service] if arguments.service else []),
    ]  # fmt: skip
    ssh = [*SSH, re.sub(r"[\[\]]", "", arguments.host)]  # Only scp wants an address in brackets.
    with tempfile.TemporaryDirectory() as place:
        # Absolute: scp would take "a:b" for a file of the host a.
        bundle = Path(arguments.bundle).absolute()
        files = {name: Path(place) / name for name in (NAME, _TRUST)}
        files |= {_BUNDLE: bundle, f"{_BUNDLE}.sig": Path(f"{bundle}.sig")}
        files[NAME].write_bytes(build_installer())
        files[_TRUST].write_bytes(key)
        make_folder = [*ssh, f"{python} --version && umask 077 && mkdir -p {folder}"]
        copies = [
            [*SCP, str(path), f"{arguments.host}:{folder}/{name}"] for name, path in files.items()
        ]
        installs, cleans_up = [*ssh, shlex.join(install)], [*ssh, f"rm -rf {folder}"]
        if arguments.dry_run:
            for command in (make_folder, *copies, installs, cleans_up):
                print(shlex.join(command))
            return 0
        _expect(make_folder)
        try:
            for command in copies:
                _expect(command)
            return _call(installs)
        finally:
            # Whatever came of it: half a bundle may hold the vehicle's private key, too.
            _call(cleans_up)


def _expect(command: list[str]) -> None:
    status = _call(command)
    if status != 0:
        raise UserError(f"{command[0]} ended with status {status}; its own line above says why")


def _call(command: list[str]) -> int:
    print(f"# {shlex.join(command)}", flush=True)
    return subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode
