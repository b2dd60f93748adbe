"""What every command of the repository shares: a parser whose errors are one line and whose help
has defaults and examples, types of options with limits, exit statuses, and signals as ^C.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import errno
import math
import os
import signal
import sys
import textwrap
import time
from importlib import import_module
from itertools import takewhile
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, NoReturn, Optional, Tuple

from edge_runtime import __version__
from edge_runtime.util import UserError, ending_signals, printable, take_signals

BAD_INPUT = 2
INTERRUPTED = 130
SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN_S = 0.3  # A second signal so soon is the same one: `timeout` signals process and group
_LARGEST = 2**63 - 1  # as the seeds of numpy and torch must be
_DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


class HelpFormatter(argparse.HelpFormatter):
    """Shows the default of every option that has one, and keeps paragraphs, examples and words."""

    def _split_lines(self, text: str, width: int) -> List[str]:
        # An option's name broken at its hyphen could not be copied.
        return textwrap.wrap(text, width, break_on_hyphens=False, break_long_words=False)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        # Examples are copied into a shell: their lines stay as they are.
        return "\n\n".join(
            paragraph
            if paragraph.startswith("example")
            else "\n".join(indent + line for line in self._split_lines(paragraph, width))
            for paragraph in text.strip().split("\n\n")
        )

    def _get_help_string(self, action: argparse.Action) -> Optional[str]:
        text = action.help or ""
        # By identity: 0 is a default worth showing, though it equals False.
        hidden = any(action.default is nothing for nothing in (None, False, argparse.SUPPRESS))
        if hidden or action.default == [] or "(default: " in text or "%(default)" in text:
            return text
        return f"{text} (default: %(default)s)".strip()


class ArgumentParser(argparse.ArgumentParser):
    """argparse with an error of one line and exit status 2. Use it for subparsers, too."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("formatter_class", HelpFormatter)
        # A guessed abbreviation would change its meaning when an option is added.
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)
        # Absolute, as soon as it is read: a simulator may change the working directory.
        self.register("type", "path", os.path.abspath)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse, but an empty value is an error: no option here means anything by it.

        An unset shell variable expands to an empty string, which as a path is the current
        directory. An unknown option is told before one that is missing.
        """
        given = sys.argv[1:] if args is None else list(args)
        before = ""
        # A command's own parser says it for its arguments.
        for value in given if self._subparsers is None else ():
            if not value:
                self.error(f"an empty value after {before}" if before else "an empty value")
            if value.startswith("--") and value.find("=") == len(value) - 1:
                self.error(f"an empty value after {value[:-1]}")
            before = value
        for value in takewhile("--".__ne__, given if self._subparsers is None else ()):
            name, known = value.partition("=")[0], self._option_string_actions
            if name.startswith("--") and " " not in value and name not in known:
                near = difflib.get_close_matches(name, known, 1)
                guess = f"; did you mean {near[0]}?" if near else ""
                self.error(f"there is no option {name}{guess}")
        return super().parse_known_args(given, namespace)

    def error(self, message: str) -> NoReturn:
        """Print "prog: what is wrong (see prog --help)" and exit with status 2."""
        line = printable(" ".join(message.split()))
        self.exit(BAD_INPUT, f"{self.prog}: {line} (see {self.prog} --help)\n")


def examples(*commands: str) -> str:
    """A parser's epilog: commands as a person would type them, continued after a backslash."""
    return "\n".join(["examples:", *("  " + text.replace("\n", "\n  ") for text in commands)])


def add_public_key(parser: argparse.ArgumentParser) -> None:
    """``--public-key``, of every command that reads a policy."""
    parser.add_argument(
        "--public-key",
        metavar="FILE",
        # One that is missing is named as it was typed.
        type=lambda text: os.path.abspath(text) if os.path.exists(text) else text,
        help="Ed25519 public key of the policy's signer, PEM (default: keys/policy.pub where it"
        " exists; where an unsigned policy may drive, first policy.pub beside the policy)",
    )


class Command(NamedTuple):
    """A command, in a module that has several."""

    EXAMPLE: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def command(place: str, *shown: str) -> Callable[[Callable[[Any], None]], Command]:
    """Decorate what declares a command's options; `module:function` at `place` is loaded to run."""
    text = examples(*shown)
    return lambda add: Command(text, add, lambda arguments: int(_load(place)(arguments)))


def program(
    name: str, description: str, commands: Dict[str, Tuple[str, str]], *shown: str
) -> Callable[[List[str]], int]:
    """The `main(argv)` of many commands: runs one of them. `shown` are examples of the help.

    `commands` has for each name a place and one line on what it does. The place is a module with
    EXAMPLE, `add_arguments(parser)` and `run(arguments)`, or `module:name` of a `Command` in it.
    Only the command that is asked for is loaded: a mock of a chassis need not wait for torch.
    """

    def main(argv: List[str]) -> int:
        parser = ArgumentParser(prog=name, description=description, epilog=examples(*shown))
        parser.add_argument("--version", action="version", version=__version__)
        word = argv[0] if argv else "--help"
        near = difflib.get_close_matches(word, (*commands, "--help", "--version"), 1)
        if near and near[0] != word:
            parser.error(f"there is no command {word!r}; did you mean {near[0]}?")
        parsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
        chosen: Any = None
        for command, (place, summary) in commands.items():
            text = f"{summary[0].upper()}{summary[1:]}."
            one = parsers.add_parser(command, help=summary, description=text)
            if command == word:
                chosen = _load(place)
                one.epilog = chosen.EXAMPLE
                chosen.add_arguments(one)
        arguments = parser.parse_args(argv or ["--help"])
        return int(chosen.run(arguments))

    return main


def _load(place: str) -> Any:
    """A module, or `module:name` in it."""
    module, _, name = place.partition(":")
    found = import_module(module)
    return getattr(found, name) if name else found


def run_cli(main: Callable[[List[str]], int], argv: Optional[List[str]] = None) -> int:
    """Run `main(argv)` and return its exit status; `argv` defaults to the command line.

    UserError becomes one line on stderr and status 2, and so does a file that the system does not
    let us use, or a full disk, also behind stdout; ^C status 130, and a reader that closed the
    pipe (`| head`) status 141 as the shell would show it. Use: `sys.exit(run_cli(main))`.
    """
    try:
        try:
            return main(sys.argv[1:] if argv is None else argv)
        finally:
            if sys.stdout is not None:  # now: at the exit nobody could say what is wrong
                sys.stdout.flush()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        _drop_stdout()
        return 141
    except OSError as error:
        if error.filename is not None:
            what = printable(str(error.filename))
        elif error.errno in _DISK_IS_FULL:
            what = "cannot write"
            _drop_stdout()  # it may be that which takes no more
        else:
            raise  # nothing that a person named
        print(f"error: {what}: {error.strerror}", file=sys.stderr)
        return BAD_INPUT


def _drop_stdout() -> None:
    """Python flushes stdout once more at exit; give it somewhere to go."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def whole_number(least: int, most: int = _LARGEST) -> Callable[[str], int]:
    """A type: a whole number between two limits, both included."""
    limits = f", at least {least}" if most == _LARGEST else f" from {least} to {most}"

    def read(text: str) -> int:
        value = least - 1
        with contextlib.suppress(ValueError):
            value = int(text)
        if value > _LARGEST:
            raise argparse.ArgumentTypeError(f"{text!r} is larger than 2**63 - 1")
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number{limits}")
        return value

    return read


def number(limits: str, fits: Callable[[float], bool]) -> Callable[[str], float]:
    """A type: a finite number that ``fits``; ``limits`` says in words which do."""

    def read(text: str) -> float:
        value = math.nan
        with contextlib.suppress(ValueError):
            value = float(text)
        if not (math.isfinite(value) and fits(value)):
            raise argparse.ArgumentTypeError(f"{text!r} is not {limits}")
        return value

    return read


positive = whole_number(1)
not_negative = whole_number(0)
positive_number = number("a finite number above 0", lambda value: value > 0.0)
not_negative_number = number("a finite number, at least 0", lambda value: value >= 0.0)
seconds = number("a number of seconds from 0 to 1e9", lambda value: 0.0 <= value <= 1e9)
share = number("a share above 0 and at most 1", lambda value: 0.0 < value <= 1.0)


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Let SIGTERM, and all else that would end this process, raise KeyboardInterrupt in the block.

    So sessions are closed and files are finished. Outside of the main thread it does nothing.
    """

    def interrupt(number: int, frame: Any) -> NoReturn:
        raise KeyboardInterrupt

    with contextlib.ExitStack() as undo:
        take_signals(ending_signals(), _once(interrupt), undo)
        yield


@contextlib.contextmanager
def quit_on_signals(ask: Callable[[], bool]) -> Iterator[None]:
    """Let the first signal ask for the end.

    A second one ends the process, and so does the first where ``ask`` returns False: then nothing
    is left that could end in order. Outside of the main thread it does nothing.
    """
    asked: List[int] = []

    def stop(number: int, frame: Any) -> None:
        asked.append(number)
        if len(asked) > 1 or not ask():
            undo.close()
            os.kill(os.getpid(), number)

    with contextlib.ExitStack() as undo:
        take_signals(SIGNALS, _once(stop), undo)
        yield


def _once(handler: Callable[[int, Any], None]) -> Callable[[int, Any], None]:
    """The handler, but not for what comes within ``AGAIN_S`` of the signal that it had."""
    had_s = -math.inf

    def handle(number: int, frame: Any) -> None:
        nonlocal had_s
        if (now_s := time.monotonic()) - had_s > AGAIN_S:
            had_s = now_s
            handler(number, frame)

    return handle
