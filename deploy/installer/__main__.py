"""`python3 install.pyz install | status | rollback | uninstall` (deploy/README.md).

`Installer` holds the order of things, so that no step can break a board. A release becomes
`current` only when its files are whole, its policy may drive and it has passed its trial. Cut off
at any moment, the board has the old release or the new one, and the same command again completes
the work.
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
from typing import Any, Iterator

from deploy.installer.layout import (
    BEFORE,
    CURRENT,
    DEFAULT_ROOT,
    LAUNCHER,
    POLICY,
    PREVIOUS,
    PUBLIC_KEY,
    TLS,
    Releases,
)
from deploy.installer.systemd import SERVICES, HealthLimits, Systemd, UnhealthyError, choose
from deploy.installer.verify import (
    MANIFEST,
    BundleManifest,
    check_fits,
    key_name,
    parse_manifest,
    read_bundle,
    read_public_key,
    ssh_key,
)
from edge_runtime.cli import SIGNALS, ArgumentParser, number, run_cli
from edge_runtime.files import write_atomic
from edge_runtime.util import UserError, read_bytes

COMMANDS = {
    "install": (
        "verify a bundle, install it beside what runs, and switch when it is healthy",
        "install phil-jetpack5-*.tar --trust policy.pub",
    ),
    "status": ("print what is installed, and whether it is whole", "status --json"),
    "rollback": ("go back to the release before", "rollback --health-limit 20"),
    "uninstall": ("stop the service and remove everything", "uninstall"),
}
UNHEALTHY = 1
_CHECK_LIMIT_S = 120.0


def main(argv: list[str]) -> int:
    """Run one command and return its exit status."""
    os.umask(0o022)  # The service's user must read the release, whatever the caller's umask.
    return run_cli(_run, argv)


def _run(argv: list[str]) -> int:
    arguments = _parser().parse_args(argv)
    releases = Releases(arguments.root)
    service = choose(arguments.service, releases.root)
    if arguments.command == "status":
        return _status(releases, service, arguments.json)
    # A link that breaks must not end it between two releases; whoever ends it makes it go back.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for one in SIGNALS:
        signal.signal(one, signal.default_int_handler)
    installer = Installer(releases, service)
    if arguments.command == "uninstall":
        installer.uninstall()
        print(f"removed from {releases.root}")
        return 0
    limits = HealthLimits(arguments.health_limit, arguments.settle)
    try:
        if arguments.command == "install":
            version = installer.install(arguments.bundle, arguments.trust, limits)
        else:
            version = installer.rollback(limits)
    except UnhealthyError as error:
        print(f"error: {error}", file=sys.stderr)
        return UNHEALTHY
    print(f"current: {version}")
    return 0


def _parser() -> argparse.ArgumentParser:
    example = "example: sudo python3 install.pyz "
    seconds = number("a number of seconds, above 0", lambda value: value > 0)  # systemd: 0 is none
    parser = ArgumentParser(
        prog="install.pyz",
        description="Installs, upgrades and undoes a release of the edge runtime on this board.",
        epilog=example + COMMANDS["install"][1],
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (text, words) in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text, epilog=example + words)
        add = command.add_argument
        add("--root", metavar="DIR", default=DEFAULT_ROOT, help="folder of the installation")
        who = "who runs the release, none for somebody else (default: as before, or systemd)"
        add("--service", choices=SERVICES, help=who)
        if name in ("install", "rollback"):
            limits = HealthLimits()
            text = "refuse a release whose trial is not ready within this time, s"
            add("--health-limit", metavar="S", type=seconds, default=limits.within_s, help=text)
            text = "time for which trial and service must then stay healthy, s"
            add("--settle", metavar="S", type=seconds, default=limits.settle_s, help=text)
        if name == "install":
            add("bundle", metavar="BUNDLE.tar")
            trust = "first install: the public key to trust from now on"
            add("--trust", metavar="KEY.pub", help=trust)
        if name == "status":
            add("--json", action="store_true", help="print JSON")
    return parser


def _status(releases: Releases, service: Systemd | None, as_json: bool) -> int:
    """Print what is installed; status 1 where the current release is damaged."""
    current = releases.linked(CURRENT)
    if current is None:
        raise UserError(f"nothing is installed in {releases.root}")
    damage = releases.damage(current)
    manifest = None if damage else read_manifest(releases.folder(current))
    rows: dict[str, Any] = {
        "current": current,
        "whole": f"no: {', '.join(damage[:3])} missing or changed" if damage else "yes",
        "previous": releases.linked(PREVIOUS) or "none",
        "vehicle_id": manifest.vehicle_id if manifest else "not known",
        "policy_id": manifest.policy_id if manifest else "not known",
        "service": service.describe() if service else "not run by the installer",
        "trusts": key_name(read_public_key(str(releases.trusted))),
    }
    print(json.dumps(rows) if as_json else "\n".join(f"{k:<11} {v}" for k, v in rows.items()))
    return UNHEALTHY if damage else 0


def read_manifest(folder: Path) -> BundleManifest:
    """The manifest of a release. Raises UserError where there is none."""
    return parse_manifest(read_bytes(folder / MANIFEST, "manifest"))


def share_key(folder: Path, group: int) -> None:
    """Let a group read the TLS key of a release."""
    for path in (folder / TLS).glob("*"):
        os.chown(path, -1, group)
        os.chmod(path, 0o640)


class Installer:
    """The steps on one board, with the service that runs its releases."""

    def __init__(self, releases: Releases, service: Systemd | None) -> None:
        self._releases = releases
        self._service = service

    def install(self, bundle_path: str, trust: str | None, limits: HealthLimits) -> str:
        """Install or upgrade; return the version. Nothing is written before the bundle is verified.

        `trust` is the path of a public key. Raises UserError where the bundle may not be installed
        here, UnhealthyError where it may not run and the board is as before.
        """
        releases = self._releases
        key = trusted_key(releases, trust)
        manifest, files = read_bundle(bundle_path, key)
        version = manifest.version
        _say(f"verified {version} for {manifest.vehicle_id}")
        check_fits(manifest.target)
        with releases.locked():
            if not releases.trusted.exists():
                write_atomic(releases.trusted, key)
            if releases.damage(version):
                releases.unpack(version, files)
                _say(f"unpacked {releases.folder(version)}")
            self.activate(version, limits)
        return version

    def rollback(self, limits: HealthLimits) -> str:
        """Go back to the release before; return its version."""
        releases = self._releases
        self._require_any()
        with releases.locked():
            version, before = releases.linked(PREVIOUS), releases.linked(BEFORE)
            if before and version != releases.linked(CURRENT):
                version = before  # An upgrade was cut off. (A rollback that was is completed.)
            if version is None:
                raise UserError(f"{releases.root} holds no earlier release to go back to")
            if releases.damage(version):
                raise UserError(f"release {version} is damaged; install its bundle again")
            self.activate(version, limits)
        return version

    def uninstall(self) -> None:
        """Stop the service and remove all that was installed, the trusted key last."""
        self._require_any()
        with self._releases.locked():
            if self._service is not None:
                self._service.remove()
            self._releases.remove_all()

    def _require_any(self) -> None:
        # Before the lock, which makes the folders.
        if not self._releases.trusted.exists():
            raise UserError(f"nothing is installed in {self._releases.root}")

    def activate(self, version: str, limits: HealthLimits) -> None:
        """Prove a release and switch to it. UnhealthyError where the board stays or is as before.

        With a service the vehicle hears nothing of a release that is being judged.
        """
        releases, service, good = self._releases, self._service, self._releases.good()
        try:
            self._prove(version, limits)
        except UnhealthyError as error:
            stays = f"{good} goes on" if good else "nothing is installed"
            raise UnhealthyError(f"release {version} may not run here, {stays}: {error}") from None
        releases.prepare(version)
        if service is None:
            releases.switch()
        else:
            with releases.holding(service.group()):
                self._switch(service, version, limits)
        releases.accept()

    def _prove(self, version: str, limits: HealthLimits) -> None:
        """`edge_runtime check` by the release's own runtime, then its trial; or UnhealthyError."""
        folder = self._releases.folder(version)
        command = [str(folder / LAUNCHER), "check", POLICY, "--public-key", PUBLIC_KEY]
        try:
            done = subprocess.run(
                command, cwd=folder, timeout=_CHECK_LIMIT_S, check=False,
                capture_output=True, text=True,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise UnhealthyError(f"edge_runtime check took over {_CHECK_LIMIT_S:.0f} s") from None
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            raise UnhealthyError(f"edge_runtime check: {lines[-1]}")
        _say("edge_runtime check: the policy may drive")
        if self._service is not None:
            share_key(folder, self._service.group())
            policy_id = read_manifest(folder).policy_id
            self._service.try_release(folder, policy_id, limits)
            _say("trial: healthy, in a network of its own")

    def _switch(self, service: Systemd, version: str, limits: HealthLimits) -> None:
        """Stop, switch and start; whatever goes wrong, start what was good."""
        releases, good = self._releases, self._releases.good()
        try:
            service.stop()
            # Units first: `choose` knows by them who runs an installation that was cut off.
            service.prepare(releases.folder(version))
            releases.switch()
            service.start(limits)
        except BaseException as error:
            for one in SIGNALS:  # A second signal would leave the board without a service.
                signal.signal(one, signal.SIG_IGN)
            why = str(error) or "interrupted"
            _say(f"{version} is not healthy: {why}")
            wrong: list[str] = []
            with _noted(wrong):
                service.stop()
            with _noted(wrong):
                if good:
                    service.prepare(releases.folder(good))
                else:
                    service.remove()
            with _noted(wrong):
                releases.go_back()
                if good:
                    service.start(limits)
            now = f"went back to {good}" if good else "nothing is installed"
            now += f", not as before ({'; '.join(wrong)})" if wrong else ""
            raise UnhealthyError(f"release {version} was not healthy, {now}: {why}") from None


@contextlib.contextmanager
def _noted(errors: list[str]) -> Iterator[None]:
    """Go on after an error in this block, and keep its text."""
    try:
        yield
    except Exception as error:
        errors.append(str(error))


def trusted_key(releases: Releases, trust: str | None) -> bytes:
    """The key that bundles must be signed with, in PEM: the board's own, or the first one named."""
    given = read_public_key(trust) if trust is not None else None
    if not releases.trusted.exists():
        if given is None:
            raise UserError("this board trusts no key yet: name your public key with --trust")
        return given
    kept = read_public_key(str(releases.trusted))
    if given is not None and ssh_key(given) != ssh_key(kept):
        raise UserError(
            f"this board trusts another key than {trust}; whoever owns the board may replace"
            f" {releases.trusted}"
        )
    return kept


def _say(text: str) -> None:
    """Print a line. A reader that is gone, as an ssh link that broke, must not end the work."""
    try:
        print(text, flush=True)
    except OSError:
        # What is left of the line would fail again at the next flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
