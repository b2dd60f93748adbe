"""`python3 install.pyz install | status | rollback | uninstall` (deploy/README.md)."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
from typing import Any, Callable, NoReturn

from deploy.installer.layout import DEFAULT_ROOT, Layout, why_not_whole
from deploy.installer.steps import Way, install, rollback, uninstall
from deploy.installer.systemd import WAYS, Limits, NoService, choose
from deploy.installer.verify import MANIFEST, UnhealthyError, UserError, key_name, parse_manifest

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


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
