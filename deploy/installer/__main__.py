"""`python3 install.pyz install | status | rollback | uninstall` (deploy/README.md).

No step can break a board. A release becomes `current` only when its files are whole, its policy may
drive and it has passed its trial. Interrupted at any moment, the board has the old release or the
new one, and the same command completes the work.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

from deploy.installer import release
from deploy.installer.release import BEFORE, CURRENT, DEFAULT_ROOT, PREVIOUS, Releases
from deploy.installer.systemd import Systemd, UnhealthyError, choose
from edge_runtime.cli import SIGNALS, ArgumentParser, run_cli
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError

UNHEALTHY = 1  # the exit status
COMMANDS = {
    "install": "verify and try a bundle, and switch to it when it is healthy",
    "status": "print what is installed, and whether it is whole",
    "rollback": "go back to the release before",
    "uninstall": "stop the service and remove everything",
}


def main(argv: list[str]) -> int:
    os.umask(0o022)  # The service's user must read the release, whatever the caller's umask.
    return run_cli(_run, argv)


def _run(argv: list[str]) -> int:
    arguments = _parser().parse_args(argv)
    command, releases = arguments.command, Releases(arguments.root)
    if command != "install" and not releases.trusted.exists():
        raise UserError(f"nothing is installed in {releases.root}")
    service = choose(arguments.service, releases.root)
    if command == "status":
        return status(releases, service)
    # A lost ssh link must not end it between two releases; SIGINT and SIGTERM make it go back.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        if command == "install":
            install(releases, service, arguments.bundle, arguments.trust)
        elif command == "rollback":
            rollback(releases, service)
        else:
            with releases.locked():
                if service is not None:
                    service.remove()
                releases.remove_all()
    except UnhealthyError as error:
        print(f"error: {error}", file=sys.stderr)
        return UNHEALTHY
    print(f"current: {releases.linked(CURRENT) or 'none'}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = ArgumentParser(
        prog="install.pyz",
        description="Install, upgrade or undo a release of the edge runtime on this board.",
        epilog="example: sudo python3 install.pyz install phil-jetpack5-*.tar --trust policy.pub",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, text in COMMANDS.items():
        add = commands.add_parser(name, help=text, description=text).add_argument
        add("--root", metavar="DIR", default=DEFAULT_ROOT, help="folder of the installation")
        none = "at the first install: somebody else runs the release (default: systemd does)"
        add("--service", choices=["none"], help=none)
        if name == "install":
            add("bundle", metavar="BUNDLE.tar")
            trust = "first install: the public key to trust from now on"
            add("--trust", metavar="KEY.pub", help=trust)
    return parser


def status(releases: Releases, service: Systemd | None) -> int:
    """Print what is installed, as JSON; return 1 where the current release is damaged."""
    current = releases.linked(CURRENT)
    if current is None:
        raise UserError(f"nothing is installed in {releases.root}")
    is_whole = releases.is_whole(current)
    about = {}
    with contextlib.suppress(OSError, ValueError):
        about = json.loads((releases.folder(current) / release.MANIFEST).read_bytes())
    about.update(current=current, is_whole=is_whole, previous=releases.linked(PREVIOUS))
    about["service"] = service.describe() if service else "not run by the installer"
    about["trusts"] = releases.trusted.read_text()
    print(json.dumps(about, indent=2))
    return 0 if is_whole else UNHEALTHY


def install(releases: Releases, service: Systemd | None, path: str, trust: str | None) -> None:
    """Verify a bundle with the public key `trust`, and install or upgrade it."""
    kept = releases.trusted.read_text(errors="replace") if releases.trusted.exists() else None
    key = release.read_public_key(trust) if trust is not None else kept
    if key is None:
        raise UserError("this board trusts no key yet: name your public key with --trust")
    if kept not in (None, key):
        raise UserError(f"this board trusts another key than {trust}: see {releases.trusted}")
    manifest, files = release.read_bundle(path, key)
    release.check_fits(manifest)
    print(f"verified {manifest.version} for {manifest.vehicle_id}", flush=True)
    with releases.locked():
        write_atomic(releases.trusted, key.encode())
        if not releases.is_whole(manifest.version):
            releases.unpack(manifest.version, files)
        _activate(releases, service, manifest.version)


def rollback(releases: Releases, service: Systemd | None) -> None:
    with releases.locked():
        version, before = releases.linked(PREVIOUS), releases.linked(BEFORE)
        if before and version != releases.linked(CURRENT):
            version = before  # An upgrade was interrupted (an interrupted rollback is completed)
        if version is None or not releases.is_whole(version):
            raise UserError(f"{releases.root} holds no whole release to go back to")
        _activate(releases, service, version)


def _activate(releases: Releases, service: Systemd | None, version: str) -> None:
    """Prove a release and switch to it. UnhealthyError: the board has its old release."""
    _prove(releases.folder(version), service)
    releases.prepare()
    if service is None:
        releases.link(CURRENT, version)
    else:
        _switch(releases, service, version)
    if releases.linked(BEFORE) != version:  # `rollback` goes there from now on.
        releases.move(BEFORE, PREVIOUS)


def _prove(folder: Path, service: Systemd | None) -> None:
    """Run the release's own `edge_runtime check`, then its trial. Raises UnhealthyError."""
    command = ["check", release.POLICY, "--public-key", release.PUBLIC_KEY]
    launcher = str(folder / release.LAUNCHER)
    done = subprocess.run([launcher, *command], cwd=folder, capture_output=True, text=True)
    if done.returncode != 0:
        raise UnhealthyError(f"release {folder.name} may not run here: {done.stderr}")
    if service is not None:
        service.try_release(folder)


def _switch(releases: Releases, service: Systemd, version: str) -> None:
    """Stop, switch and start; on any failure, start the last good release again."""
    good = releases.linked(BEFORE)
    try:
        service.stop()
        # Units first: by them `choose` sees that systemd runs an interrupted installation.
        service.prepare(releases.folder(version))
        releases.link(CURRENT, version)
        service.start()
    except BaseException as error:
        for number in SIGNALS:  # A second signal would leave the board without a service.
            signal.signal(number, signal.SIG_IGN)
        with contextlib.suppress(Exception):  # A service that does not stop is still replaced.
            service.stop()
        if releases.linked(CURRENT) != good:
            releases.move(BEFORE, CURRENT)
        if good:
            with contextlib.suppress(Exception):  # On a full disk the new units stay.
                service.prepare(releases.folder(good))
            service.start()
        else:
            service.remove()
        now = f"went back to {good}" if good else "nothing is installed"
        why = str(error) or "interrupted"
        raise UnhealthyError(f"release {version} was not healthy, {now}: {why}") from None
