"""Shared by every command: a parser with one-line errors and a help with defaults and examples,
option types with limits, exit statuses, and signal handling.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import math
import os
import signal
import sys
import textwrap
import threading
import time
from functools import partial
from importlib import import_module
from itertools import takewhile
from typing import Any, Callable, Iterable, Iterator, NamedTuple, NoReturn, Optional

from edge_runtime import __version__
from edge_runtime.util import UserError, printable

BAD_INPUT = 2
INTERRUPTED = 130
BROKEN_PIPE = 141
SIGNALS = (signal.SIGINT, signal.SIGTERM)
ENDING_SIGNALS = (*SIGNALS, signal.SIGHUP)
AGAIN_S = 0.3  # A signal repeated sooner is the same one: `timeout` signals process and group
_LARGEST = 2**63 - 1  # as the seeds of numpy and torch must be


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Shows the default of every option that has one, and keeps the lines of examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        # Examples are copied into a shell.
        return text if text.startswith("example") else super()._fill_text(text, width, indent)

    def _split_lines(self, text: str, width: int) -> list[str]:
        # A name that is broken at its hyphen cannot be copied.
        return textwrap.wrap(text, width, break_on_hyphens=False)

    def _get_help_string(self, action: argparse.Action) -> Optional[str]:
        # By identity: 0 is a default worth showing, though it equals False.
        hidden = any(action.default is nothing for nothing in (None, False))
        if hidden or action.default in ([], "") or "(default: " in (action.help or ""):
            return action.help
        return super()._get_help_string(action)


class ArgumentParser(argparse.ArgumentParser):
    """argparse with an error of one line and exit status 2. Use it for subparsers, too.

    The type "path" makes a path absolute at once: a simulator may change the working directory.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("formatter_class", HelpFormatter)
        # A guessed abbreviation would change its meaning when an option is added.
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)
        self.register("type", "path", os.path.abspath)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse an unknown option, with a guess, before argparse asks for one that is missing."""
        known, argv = self._option_string_actions, sys.argv[1:] if args is None else list(args)
        for word in takewhile("--".__ne__, () if self._subparsers else argv):
            name = word.partition("=")[0]
            if name.startswith("--") and name not in known:
                guesses = difflib.get_close_matches(name, known, 1)
                self.error(f"there is no option {'; did you mean '.join([name, *guesses])}")
        return super().parse_known_args(argv, namespace)

    def error(self, message: str) -> NoReturn:
        """Print "prog: what is wrong (see prog --help)" and exit with status 2."""
        line = printable(" ".join(message.split()))
        self.exit(BAD_INPUT, f"{self.prog}: {line} (see {self.prog} --help)\n")


def examples(*commands: str) -> str:
    """Format a parser's epilog: commands as a person types them, continued after a backslash."""
    return "\n".join(["examples:", *("  " + text.replace("\n", "\n  ") for text in commands)])


def add_public_key(parser: Any, more: str = "") -> None:
    """Add ``--public-key``, of every command that reads a policy, to a parser or group."""
    text = f"Ed25519 public key (PEM) that verifies the signature (default: keys/policy.pub{more})"
    parser.add_argument("--public-key", metavar="FILE", type="path", help=text)


class Subcommand(NamedTuple):
    """A command of `program`; its module may hold several."""

    EXAMPLE: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def command(run: Any, *shown: str) -> Callable[[Callable[[Any], None]], Subcommand]:
    """Decorate a function that adds options; `run`, or its lazy `module:function`, is called."""
    load = partial(_load, run) if isinstance(run, str) else lambda: run
    return lambda add: Subcommand(examples(*shown), add, lambda arguments: int(load()(arguments)))


def program(
    name: str, description: str, commands: dict[str, tuple[Any, str]], *shown: str
) -> Callable[[list[str]], int]:
    """Make the `main(argv)` that runs one of many commands. `shown` are examples for its help.

    `commands` maps each name to a `Subcommand` and one line of help. A string in its place is
    imported when the command is chosen: "module:name", or a module with the same attributes.
    """

    def main(argv: list[str]) -> int:
        parser = ArgumentParser(prog=name, description=description, epilog=examples(*shown))
        parser.add_argument("--version", action="version", version=__version__)
        parsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
        chosen: Any = None
        for command, (place, summary) in commands.items():
            text = f"{summary[0].upper()}{summary[1:]}."
            subparser = parsers.add_parser(command, help=summary, description=text)
            if argv[:1] == [command]:
                chosen = _load(place) if isinstance(place, str) else place
                subparser.epilog = chosen.EXAMPLE
                chosen.add_arguments(subparser)
        arguments = parser.parse_args(argv or ["--help"])
        return int(chosen.run(arguments))

    return main


def _load(place: str) -> Any:
    module, _, name = place.partition(":")
    loaded = import_module(module)
    return getattr(loaded, name) if name else loaded


def run_cli(main: Callable[[list[str]], int], argv: Optional[list[str]] = None) -> int:
    """Run `main(argv)` and return its exit status; `argv` defaults to the command line.

    UserError and OSError, such as that of a full disk, become one line on stderr and status 2. ^C
    is status 130; a reader that closed the pipe (`| head`) is 141.
    """
    try:
        try:
            return main(sys.argv[1:] if argv is None else argv)
        finally:
            sys.stdout.flush()  # here, where a failure is still reported
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr, flush=True)
        return INTERRUPTED
    except BrokenPipeError:
        _drop_stdout()
        return BROKEN_PIPE
    except (UserError, OSError) as error:
        if isinstance(error, OSError):
            _drop_stdout()  # stdout itself may have failed
        print(f"error: {UserError(error)}", file=sys.stderr, flush=True)
        return BAD_INPUT


def _drop_stdout() -> None:
    """Point stdout at /dev/null: Python flushes it once more at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def whole_number(least: int, most: int = _LARGEST) -> Callable[[str], int]:
    """Make an option type: a whole number between two limits, both included."""
    limits = f"a whole number from {least} to {most}"
    return within(int, limits, lambda value: least <= value <= most)


def number(limits: str, fits: Callable[[float], bool]) -> Callable[[str], float]:
    """Make an option type: a finite number that ``fits``; ``limits`` says in words which do."""
    return within(float, limits, lambda value: math.isfinite(value) and fits(value))


def within(kind: Any, limits: str, fits: Callable[[Any], bool]) -> Callable[[str], Any]:
    """Make an option type: a ``kind(text)`` that ``fits``; ``limits`` says in words which do."""

    def read(text: str) -> Any:
        with contextlib.suppress(ValueError):
            if fits(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"{text!r} is not {limits}")

    return read


positive = whole_number(1)
not_negative = whole_number(0)
positive_number = number("a finite number above 0", lambda value: value > 0.0)
not_negative_number = number("a finite number, at least 0", lambda value: value >= 0.0)
seconds = number("a number of seconds from 0 to 1e9", lambda value: 0.0 <= value <= 1e9)


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt in the block for SIGTERM and SIGHUP, too, unless they are handled."""
    ends = (signal.SIG_DFL, signal.default_int_handler)

    def interrupt(number: int, frame: Any) -> NoReturn:
        raise KeyboardInterrupt

    with handled([each for each in ENDING_SIGNALS if signal.getsignal(each) in ends], interrupt):
        yield


@contextlib.contextmanager
def quit_on_signals(ask: Callable[[], Optional[bool]]) -> Iterator[None]:
    """Call `ask` at the first signal; end the process at a second one, or if `ask` is False."""
    received: list[int] = []

    def stop(number: int, frame: Any) -> None:
        received.append(number)
        if len(received) > 1 or ask() is False:
            undo.close()
            os.kill(os.getpid(), number)

    with contextlib.ExitStack() as undo:
        undo.enter_context(handled(ENDING_SIGNALS, stop))
        yield


@contextlib.contextmanager
def handled(numbers: Iterable[int], handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Handle signals in the block; a signal within ``AGAIN_S`` of the last one is the same one.

    A SIGHUP that is ignored stays so (nohup). Does nothing outside of the main thread.
    """
    last_s = -math.inf

    def once(number: int, frame: Any) -> None:
        nonlocal last_s
        if (now_s := time.monotonic()) - last_s > AGAIN_S:
            last_s = now_s
            handler(number, frame)

    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in numbers if is_main}
    if before.get(signal.SIGHUP) is signal.SIG_IGN:
        del before[signal.SIGHUP]
    try:
        for number in before:
            signal.signal(number, once)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, before)  # A worker's may be blocked and wait.
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
