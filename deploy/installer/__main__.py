"""`python3 install.pyz install | status | rollback | uninstall` (deploy/README.md).

Install, upgrade, roll back, uninstall: the order of things, so that no step can break a board.

A release becomes `current` only when its files are whole, its policy may drive and it has passed
its trial; `current` changes by one rename. Cut off at any moment, the board has the old release or
the new one, and the same command again completes the work.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Callable, NamedTuple, NoReturn

from deploy.installer.layout import (
    DEFAULT_ROOT,
    LAUNCHER,
    POLICY,
    PUBLIC_KEY,
    Layout,
    make_release,
    why_not_whole,
    write_whole,
)
from deploy.installer.systemd import WAYS, Limits, NoService, choose, remember
from deploy.installer.verify import (
    MANIFEST,
    Bundle,
    UnhealthyError,
    UserError,
    check_fits,
    key_name,
    parse_manifest,
    read_bundle,
    read_public_key,
    same_key,
)

LIMITS = Limits()
EXAMPLES = {
    "install": "install phil-jetpack5-*.tar --trust bundle.pub",
    "status": "status --json",
    "rollback": "rollback --health-limit 20",
    "uninstall": "uninstall",
}
UNHEALTHY, BAD_INPUT, INTERRUPTED = 1, 2, 130


class _Parser(argparse.ArgumentParser):
    """argparse with an error of one line, and no empty value: as a root, it is where one stands."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        for value in sys.argv[1:] if args is None else args:
            if not value or (value.startswith("--") and value.find("=") == len(value) - 1):
                self.error("an empty value")
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {' '.join(message.split())} (see {self.prog} --help)\n")


def main(argv: list[str]) -> int:
    """Run one command; the exit status."""
    os.umask(0o022)  # The service's user must read the release, whatever the caller's umask.
    try:
        try:
            return _dispatch(_parser().parse_args(argv))
        finally:
            sys.stdout.flush()  # at the exit nobody could say what is wrong
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    except UnhealthyError as error:
        print(f"error: {error}", file=sys.stderr)
        return UNHEALTHY
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # it may be stdout that takes no more
        print(f"error: {error.filename or 'the disk'}: {error.strerror}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted: the same command again completes it", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="install.pyz",
        description="Installs, upgrades and undoes a release of the edge runtime on this board.",
        epilog=_example("install"),
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    commands.required = True
    texts = (
        ("install", "verify a bundle, install it beside what runs, and switch when it is healthy"),
        ("status", "what is installed here, and whether it is whole"),
        ("rollback", "go back to the release before"),
        ("uninstall", "stop the service and remove everything"),
    )
    for name, text in texts:
        command = commands.add_parser(name, help=text, description=text, epilog=_example(name))
        command.add_argument(
            "--root", metavar="DIR", default=DEFAULT_ROOT, help=f"default: {DEFAULT_ROOT}"
        )
        command.add_argument(
            "--service",
            metavar="|".join(WAYS),
            choices=WAYS,
            help="who runs it (default: systemd where it runs this computer, else none)",
        )
        if name in ("install", "rollback"):
            for option, kind, default, text in (
                ("--health-limit", _seconds(True), LIMITS.within_s, "healthy by then, or back"),
                ("--settle", _seconds(False), LIMITS.settle_s, "and for so long after that"),
            ):
                text = f"{text}, s (default: {default:g})"
                command.add_argument(option, metavar="S", type=kind, default=default, help=text)
        if name == "install":
            command.add_argument("bundle", metavar="BUNDLE.tar")
            command.add_argument(
                "--trust", metavar="KEY.pub", help="first install: the public key to trust from now"
            )
        if name == "status":
            command.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _seconds(above_0: bool) -> Callable[[str], float]:
    """A type: a finite number of seconds, above 0 or at least 0."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or value < 0 or (above_0 and not value):
            limit = "above 0" if above_0 else "at least 0"
            raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds, {limit}")
        return value

    return read


def _example(name: str) -> str:
    return f"example: sudo python3 install.pyz {EXAMPLES[name]}"


def _dispatch(arguments: argparse.Namespace) -> int:
    layout = Layout(arguments.root)
    if arguments.command == "status":
        service = choose(arguments.service, layout.root, only_look=True)
        return _status(layout, service, arguments.json)
    service = choose(arguments.service, layout.root)
    if arguments.command == "uninstall":
        uninstall(layout, Way(service, LIMITS))
        print(f"removed from {layout.root}")
        return 0
    # A link that breaks must not end it between two releases; whoever ends it makes it go back.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    _interrupt_on(signal.SIGTERM, signal.SIGINT)
    limits = Limits(arguments.health_limit, arguments.settle)
    way = Way(service, limits)
    if arguments.command == "install":
        version = install(arguments.bundle, arguments.trust, layout, way)
    else:
        version = rollback(layout, way)
    print(f"current: {version}")
    return 0


def _interrupt_on(*numbers: int) -> None:
    """Let these signals be a KeyboardInterrupt here, and the end of the processes that compile.

    Those have nothing to go back to, nor to say, from the moment of their fork on.
    """
    installer = os.getpid()

    def handle(number: int, _frame: object) -> None:
        if os.getpid() != installer:
            os._exit(128 + number)
        raise KeyboardInterrupt

    for number in numbers:
        signal.signal(number, handle)


def _status(layout: Layout, service: NoService, as_json: bool) -> int:
    """Print what is here; status 1 where the current release is damaged."""
    current = layout.linked("current")
    if current is None:
        raise UserError(f"nothing is installed in {layout.root}")
    manifest = parse_manifest((layout.release(current) / MANIFEST).read_bytes())
    fault, whole = "", "yes"
    try:
        fault = why_not_whole(layout.release(current))
    except PermissionError:  # the vehicle's private key is in it
        whole = "not known: this user may not read all of it"
    rows: dict[str, Any] = {
        "current": current,
        "whole": fault or whole,
        "previous": layout.linked("previous") or "none",
        "vehicle_id": manifest.vehicle_id,
        "policy_id": manifest.policy_id,
        "service": service.describe(),
        "trusts": key_name(layout.trusted.read_bytes()),
    }
    print(json.dumps(rows) if as_json else "\n".join(f"{k:<11} {v}" for k, v in rows.items()))
    return UNHEALTHY if fault else 0


_CHECK_LIMIT_S = 120.0
_ENDS_A_SWITCH = (UnhealthyError, UserError, OSError, KeyboardInterrupt)
"""The old service is stopped then, so whatever goes wrong, somebody must start it again."""


class Way(NamedTuple):
    """How the service runs, and what is healthy."""

    service: NoService
    limits: Limits


def install(bundle_path: str, trust: str | None, layout: Layout, way: Way) -> str:
    """Install or upgrade; return the version. Nothing is written before the bundle is verified.

    Raises UserError where it may not be installed here, UnhealthyError where it was and went back.
    """
    key = trusted_key(layout, trust)
    bundle = read_bundle(bundle_path, key)
    version = bundle.manifest.version
    _say(f"verified {version} for {bundle.manifest.vehicle_id}")
    check_fits(bundle.manifest.target)
    with layout.locked():
        layout.tidy()
        if not layout.trusted.exists():
            write_whole(layout.trusted, key)
        remember(way.service.name, layout.root)
        _unpack(bundle, layout, way)
        activate(version, layout, way, is_new=True)
    return version


def rollback(layout: Layout, way: Way) -> str:
    """Go back to the release before; return its version."""
    with layout.locked():
        layout.tidy()
        version = layout.linked("previous")
        if version is None or version == layout.linked("current"):
            raise UserError(f"{layout.root} holds no earlier release to go back to")
        fault = why_not_whole(layout.release(version))
        if fault:
            raise UserError(f"release {version} is damaged: {fault}")
        activate(version, layout, way, is_new=False)
    return version


def activate(version: str, layout: Layout, way: Way, is_new: bool) -> None:
    """Prove a release, let the service run it, and go back by itself where it is not healthy."""
    folder, before = layout.release(version), layout.linked("current")
    try:
        _prove(folder, way)
    except UnhealthyError as error:
        if is_new and version not in (before, layout.linked("previous")):
            layout.remove_release(version)
        stays = f"{before} goes on" if before else "nothing is installed"
        raise UnhealthyError(f"release {version} may not run here, {stays}: {error}") from None
    _switch(version, before, layout, way)
    for other in layout.versions():
        if other not in (layout.linked("current"), layout.linked("previous")):
            layout.remove_release(other)


def uninstall(layout: Layout, way: Way) -> None:
    """Stop the service and remove all that was installed, the trusted key last."""
    if not layout.releases.is_dir() and not layout.trusted.exists():
        raise UserError(f"nothing is installed in {layout.root}")
    with layout.locked():
        way.service.remove()
        for name in ("current", "previous"):
            layout.unlink(name)
        layout.tidy()
        for path in (layout.releases, layout.state):
            shutil.rmtree(str(path), ignore_errors=True)
        if layout.trusted.exists():
            layout.trusted.unlink()
        (layout.root / ".lock").unlink()
    try:
        layout.root.rmdir()
    except OSError:
        _say(f"{layout.root} stays: it holds what is not ours")


def trusted_key(layout: Layout, trust: str | None) -> bytes:
    """The key that bundles must be signed with, in PEM: the board's own, or the first one named."""
    given = read_public_key(trust) if trust is not None else None
    if not layout.trusted.exists():
        if given is None:
            raise UserError("this board trusts no key yet: name your public key with --trust")
        return given
    kept = read_public_key(str(layout.trusted))
    if given is not None and not same_key(given, kept):
        raise UserError(
            f"this board trusts another key than {trust}; whoever owns the board may replace"
            f" {layout.trusted}"
        )
    return kept


def _unpack(bundle: Bundle, layout: Layout, way: Way) -> None:
    version = bundle.manifest.version
    if layout.release(version).is_dir():
        fault = why_not_whole(layout.release(version))
        if not fault:
            _say(f"{version} lies here already, whole")
            return
        _say(f"{version} lies here damaged ({fault}): made again")
        if layout.linked("current") == version:
            way.service.stop()
        layout.remove_release(version)
    folder = make_release(bundle, layout, way.service.group())
    _say(f"unpacked {folder}")


def _prove(folder: Path, way: Way) -> None:
    _check_policy(folder)
    _say("edge_runtime check: the policy may drive")
    if way.service.name != "none":
        policy_id = parse_manifest((folder / MANIFEST).read_bytes()).policy_id
        way.service.try_release(folder, policy_id, way.limits)
        _say("trial: healthy, in a network of its own")


def _check_policy(folder: Path) -> None:
    """`edge_runtime check` by the release's own runtime. UnhealthyError with its last line."""
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


def _switch(version: str, before: str | None, layout: Layout, way: Way) -> None:
    earlier = layout.linked("previous")
    try:
        way.service.stop()
        if before is not None and before != version:
            layout.link("previous", before)
        layout.link("current", version)
        _start(version, layout, way)
    except _ENDS_A_SWITCH as error:
        why = str(error) or "interrupted"
        _say(f"{version} is not healthy: {why}")
        # Cut off between the rename and here, `current` is this very release already.
        good = before if before != version else earlier
        _go_back(version, good, earlier, layout, way)
        raise UnhealthyError(
            f"release {version} was not healthy as a service,"
            f" {f'went back to {good}' if good else 'nothing is installed'}: {why}"
        ) from None


def _start(version: str, layout: Layout, way: Way) -> None:
    """Let the service run; the vehicle hears nothing of it until it is healthy."""
    if way.service.name == "none":
        return  # Whoever runs it could not be watched, and might not be allowed to read the hold.
    with layout.holding(way.service.group()):
        try:
            way.service.start(layout.release(version))
            way.service.watch(way.limits)
        except BaseException:  # while the hold lasts, so that nothing unproven is ever heard
            way.service.stop()
            raise


def _go_back(version: str, good: str | None, earlier: str | None, layout: Layout, way: Way) -> None:
    if good is None:
        way.service.remove()
        layout.unlink("current")
        layout.remove_release(version)
        return
    way.service.stop()
    layout.link("current", good)
    if earlier is not None and earlier != good:
        layout.link("previous", earlier)
    else:
        layout.unlink("previous")
    if (
        version != earlier
    ):  # A release that has served before stays, for a roll-back at another time.
        layout.remove_release(version)
    try:
        _start(good, layout, way)
    except UnhealthyError as error:
        raise UnhealthyError(f"{version} was not healthy, nor is {good} again: {error}") from None


def _say(text: str) -> None:
    try:
        print(text, flush=True)
    except OSError:
        # A reader that is gone, as an ssh link that broke, must not keep us from going back. What
        # is left of the line would fail again at the next flush.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
