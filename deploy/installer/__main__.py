"""`python3 install.pyz install | status | rollback | uninstall` (deploy/README.md).

`Installer` is the order of things, so that no step can break a board. A release becomes `current`
only when its files are whole, its policy may drive and it has passed its trial; `current` changes
by one rename. Cut off at any moment, the board has the old release or the new one, and the same
command again completes the work.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
from typing import Any

from deploy.installer.layout import (
    DEFAULT_ROOT,
    LAUNCHER,
    POLICY,
    PUBLIC_KEY,
    Layout,
    let_read_key,
    make_release,
    read_state,
    why_not_whole,
    write_whole,
)
from deploy.installer.systemd import WAYS, Limits, NoService, choose, remember
from deploy.installer.verify import (
    MANIFEST,
    VERSION,
    Bundle,
    Manifest,
    UnhealthyError,
    check_fits,
    key_name,
    parse_manifest,
    read_bundle,
    read_public_key,
    ssh_key,
)
from edge_runtime.cli import SIGNALS, ArgumentParser, number, run_cli
from edge_runtime.util import UserError, take_signals

COMMANDS = {
    "install": (
        "verify a bundle, install it beside what runs, and switch when it is healthy",
        "install phil-jetpack5-*.tar --trust bundle.pub",
    ),
    "status": ("what is installed here, and whether it is whole", "status --json"),
    "rollback": ("go back to the release before", "rollback --health-limit 20"),
    "uninstall": ("stop the service and remove everything", "uninstall"),
}
LIMITS = Limits()
UNHEALTHY = 1
_CHECK_LIMIT_S = 120.0


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    os.umask(0o022)  # The service's user must read the release, whatever the caller's umask.
    return run_cli(_run, argv)


def _run(argv: list[str]) -> int:
    try:
        return _dispatch(_parser().parse_args(argv))
    except UnhealthyError as error:
        print(f"error: {error}", file=sys.stderr)
        return UNHEALTHY


def _parser() -> argparse.ArgumentParser:
    example = "example: sudo python3 install.pyz "
    seconds = number("a number of seconds, above 0", lambda value: value > 0)  # systemd: 0 is none
    parser = ArgumentParser(
        prog="install.pyz",
        description="Installs, upgrades and undoes a release of the edge runtime on this board.",
        epilog=example + COMMANDS["install"][1],
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    commands.required = True
    for name, (text, words) in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text, epilog=example + words)
        add, who = command.add_argument, "systemd where it runs this computer, else none"
        add("--root", metavar="DIR", default=DEFAULT_ROOT, help="where all of it is")
        ways = "|".join(WAYS)
        add("--service", metavar=ways, choices=WAYS, help=f"who runs it (default: {who})")
        if name in ("install", "rollback"):
            for option, default, text in (
                ("--health-limit", LIMITS.within_s, "go back unless it is healthy within"),
                ("--settle", LIMITS.settle_s, "how long it must then stay healthy"),
            ):
                add(option, metavar="S", type=seconds, default=default, help=f"{text} (s)")
        if name == "install":
            add("bundle", metavar="BUNDLE.tar")
            trust = "first install: the public key to trust from now"
            add("--trust", metavar="KEY.pub", help=trust)
        if name == "status":
            add("--json", action="store_true", help="print JSON")
    return parser


def _dispatch(arguments: argparse.Namespace) -> int:
    layout, command = Layout(arguments.root), arguments.command
    service = choose(arguments.service, layout.root, only_look=command == "status")
    if command == "status":
        return _status(layout, service, arguments.json)
    if command == "uninstall":
        Installer(layout, service).uninstall()
        print(f"removed from {layout.root}")
        return 0
    # A link that breaks must not end it between two releases; whoever ends it makes it go back.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for one in SIGNALS:
        signal.signal(one, signal.default_int_handler)
    installer = Installer(layout, service, Limits(arguments.health_limit, arguments.settle))
    if command == "install":
        version = installer.install(arguments.bundle, arguments.trust)
    else:
        version = installer.rollback()
    print(f"current: {version}")
    return 0


def _status(layout: Layout, service: NoService, as_json: bool) -> int:
    """Print what is here; status 1 where the current release is damaged."""
    current = layout.linked("current")
    if current is None:
        raise UserError(f"nothing is installed in {layout.root}")
    fault, whole, manifest = "", "yes", None
    try:
        fault = why_not_whole(layout.release(current))
        manifest = None if fault else _manifest(layout, current)
    except PermissionError:  # the vehicle's private key is in it
        whole = "not known: this user may not read all of it"
    rows: dict[str, Any] = {
        "current": current,
        "whole": fault or whole,
        "previous": layout.linked("previous") or "none",
        "vehicle_id": manifest.vehicle_id if manifest else "not known",
        "policy_id": manifest.policy_id if manifest else "not known",
        "service": service.describe(),
        "trusts": key_name(read_public_key(str(layout.trusted))),
    }
    print(json.dumps(rows) if as_json else "\n".join(f"{k:<11} {v}" for k, v in rows.items()))
    return UNHEALTHY if fault else 0


def _manifest(layout: Layout, version: str) -> Manifest:
    return parse_manifest((layout.release(version) / MANIFEST).read_bytes())


class Installer:
    """The steps on one board: where releases lie, how the service runs, and what is healthy."""

    def __init__(self, layout: Layout, service: NoService, limits: Limits = LIMITS) -> None:
        self._layout = layout
        self._service = service
        self._limits = limits

    def install(self, bundle_path: str, trust: str | None) -> str:
        """Install or upgrade; return the version. Nothing is written before the bundle is verified.

        `trust` is the path of a public key. Raises UserError where the bundle may not be installed
        here, UnhealthyError where it was and went back.
        """
        layout = self._layout
        key = trusted_key(layout, trust)
        bundle = read_bundle(bundle_path, key)
        version = bundle.manifest.version
        _say(f"verified {version} for {bundle.manifest.vehicle_id}")
        check_fits(bundle.manifest.target)
        with layout.locked():
            layout.make_ready()
            if not layout.trusted.exists():
                write_whole(layout.trusted, key)
            self._unpack(bundle)
            self.activate(version)
        return version

    def rollback(self) -> str:
        """Go back to the release before; return its version."""
        layout = self._layout
        if not layout.releases.is_dir():  # Before the lock, which would make the folder.
            raise UserError(f"nothing is installed in {layout.root}")
        with layout.locked():
            layout.make_ready()
            version = layout.linked("previous")
            if version is None or version == layout.linked("current"):
                raise UserError(f"{layout.root} holds no earlier release to go back to")
            fault = why_not_whole(layout.release(version))
            if fault:
                raise UserError(f"release {version} is damaged: {fault}")
            self.activate(version)
        return version

    def uninstall(self) -> None:
        """Stop the service and remove all that was installed, the trusted key last."""
        layout = self._layout
        if not layout.trusted.is_file() and not layout.versions():
            raise UserError(f"nothing is installed in {layout.root}")
        with layout.locked():
            self._service.remove()
            layout.remove_all()
        if layout.root.exists():
            _say(f"{layout.root} stays: it holds what is not ours")

    def activate(self, version: str) -> None:
        """Prove a release, let the service run it, and go back where it is not healthy."""
        layout, before = self._layout, self._layout.linked("current")
        try:
            self._prove(version)
        except UnhealthyError as error:
            layout.remove_unused(version)
            stays = f"{before} goes on" if before else "nothing is installed"
            raise UnhealthyError(f"release {version} may not run here, {stays}: {error}") from None
        remember(self._service.name, layout.root)
        self._switch(version, before)
        layout.remove_unused(*layout.versions())

    def _unpack(self, bundle: Bundle) -> None:
        layout, version = self._layout, bundle.manifest.version
        folder = layout.release(version)
        if os.path.lexists(str(folder)):
            if version not in layout.versions():
                raise UserError(f"{folder} is no release: move it away")
            fault = why_not_whole(folder)
            if not fault:
                _say(f"{version} lies here already, whole")
                return
            _say(f"{version} lies here damaged ({fault}): made again")
        _say(f"unpacked {make_release(bundle, layout, self._service.group())}")

    def _prove(self, version: str) -> None:
        """`edge_runtime check` by the release's own runtime, then its trial; or UnhealthyError."""
        folder = self._layout.release(version)
        command = [str(folder / LAUNCHER), "check", POLICY, "--public-key", PUBLIC_KEY]
        try:
            done = subprocess.run(
                command, cwd=str(folder), timeout=_CHECK_LIMIT_S, check=False,
                capture_output=True, text=True,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise UnhealthyError(f"edge_runtime check took over {_CHECK_LIMIT_S:.0f} s") from None
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            raise UnhealthyError(f"edge_runtime check: {lines[-1]}")
        _say("edge_runtime check: the policy may drive")
        if self._service.name != "none":
            # It may have been unpacked for its owner alone, under --service none.
            let_read_key(folder, self._service.group())
            policy_id = _manifest(self._layout, version).policy_id
            self._service.try_release(folder, policy_id, self._limits)
            _say("trial: healthy, in a network of its own")

    def _switch(self, version: str, before: str | None) -> None:
        """Stop, switch and start; whatever goes wrong after the stop, start what was good.

        Raises UserError or OSError where it cannot begin: the service was not stopped then.
        """
        layout, service, earlier = self._layout, self._service, self._layout.linked("previous")
        # Cut off after the switch, `current` is this very release already, and has not served yet.
        served = read_state(layout.served)
        if served and not VERSION.fullmatch(served):
            raise UserError(f"{layout.served} names no release: remove it")
        good = before if before and (before != version or served == version) else earlier
        write_whole(layout.served, served.encode())  # What is written later can be written.
        with contextlib.ExitStack() as until_judged:
            # The vehicle hears nothing of a release that is not proven. Whoever runs the service
            # "none" could not be watched, nor perhaps be allowed to read the hold.
            if service.name != "none":
                until_judged.enter_context(layout.holding(service.group()))
            try:
                service.stop()
                if before not in (None, version):
                    layout.link("previous", before)
                layout.link("current", version)
                service.prepare(layout.release(version))
                service.start(layout.release(version))
                service.watch(self._limits)
                write_whole(layout.served, version.encode())
            except BaseException as error:
                # A second signal would leave the board without a service.
                take_signals(SIGNALS, signal.SIG_IGN, until_judged)
                why = str(error) or "interrupted"
                _say(f"{version} is not healthy: {why}")
                self._go_back(version, good, earlier)
                raise UnhealthyError(
                    f"release {version} was not healthy as a service,"
                    f" {f'went back to {good}' if good else 'nothing is installed'}: {why}"
                ) from None

    def _go_back(self, version: str, good: str | None, earlier: str | None) -> None:
        layout, service = self._layout, self._service
        try:
            # Each step whatever becomes of the others, in the reverse order: the start is the last.
            with contextlib.ExitStack() as steps:
                if good is None:
                    steps.callback(layout.remove_unused, version)
                    steps.callback(layout.link, "current", None)
                    steps.callback(service.remove)
                    return
                steps.callback(service.start, layout.release(good))
                steps.callback(service.prepare, layout.release(good))
                if version not in (good, earlier):  # One that has served can be gone back to again.
                    steps.callback(layout.remove_unused, version)
                steps.callback(layout.link, "current", good)
                steps.callback(layout.link, "previous", earlier if earlier != good else None)
                if layout.linked("current") != good:
                    # `previous` is that link by now, which needs no room on a full disk, else made.
                    steps.callback(os.replace, layout.root / "previous", layout.root / "current")
                steps.callback(service.stop)
            service.watch(self._limits)
        except Exception as error:
            raise UnhealthyError(
                f"{version} was not healthy, nor is {good or 'the board'} as before: {error}"
            ) from None


def trusted_key(layout: Layout, trust: str | None) -> bytes:
    """The key that bundles must be signed with, in PEM: the board's own, or the first one named."""
    given = read_public_key(trust) if trust is not None else None
    if not layout.trusted.exists():
        if given is None:
            raise UserError("this board trusts no key yet: name your public key with --trust")
        return given
    kept = read_public_key(str(layout.trusted))
    if given is not None and ssh_key(given) != ssh_key(kept):
        raise UserError(
            f"this board trusts another key than {trust}; whoever owns the board may replace"
            f" {layout.trusted}"
        )
    return kept


def _say(text: str) -> None:
    try:
        with contextlib.suppress(ValueError):  # a name that has no letters here
            print(text, flush=True)
    except OSError:
        # A reader that is gone, as an ssh link that broke, must not keep us from going back. What
        # is left of the line would fail again at the next flush.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
