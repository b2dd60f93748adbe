"""The repository's own commands as processes, and the operator beside a drive.

`run_command` is what a person types; `Process` runs beside us, says why it failed, and stamps every
line that it prints.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Self, TypeVar

from edge_runtime.link import ask
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError
from trainer.util import kept

Item = TypeVar("Item")
Result = TypeVar("Result")
POLICY = Path(kept("results/policies/left_turn.onnx"))
PUBLIC_KEY = POLICY.with_name("policy.pub")  # The policy that ships, and what it is verified with
PATIENCE_S = 30.0
STOP_TIMEOUT_S = 20.0
POLL_S = 0.005
OPERATOR_LOOKS_EVERY_S = 0.5
_LAST_WORDS_S = 1.0
_CRASH_MARKS = ("Traceback (most recent call last)", "panicked at", "Fatal Python error")


class CommandTimeoutError(UserError, TimeoutError):
    """A command or an event did not come in time."""


class Process:
    """``python -m ARGUMENTS`` beside us. It ends with the ``with`` block.

    ``lines`` are its output of both streams with their monotonic times; ``output`` and ``errors``
    are the text of each stream. ``ready`` is a text that says it has started (None: no wait).
    ``shown`` prints the command; ``environment`` are variables beside ours; with ``told``, `tell`
    writes to its standard input. ``on_line`` is called with the time and text of each line, in a
    thread. ``options`` are further ones of Popen. Raises UserError where it ended, or said nothing
    for too long, before it was ready.
    """

    def __init__(
        self,
        *arguments: str,
        ready: str | None = None,
        shown: bool = False,
        environment: Mapping[str, str] | None = None,
        told: bool = False,
        on_line: Callable[[float, str], None] = lambda seen_s, line: None,
        python: str = sys.executable,
        **options: Any,
    ) -> None:
        if shown:
            print(f"\n$ python -m {shlex.join(arguments)} &", flush=True)
        self.name = " ".join(arguments[:2])
        self.lines: list[tuple[float, str]] = []
        self._ended_by_us = False
        self._on_line = on_line
        pipes = {
            "stdin": subprocess.PIPE if told else subprocess.DEVNULL,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
        }
        self._process: subprocess.Popen[str] = subprocess.Popen(
            [python, "-m", *arguments],
            text=True,
            errors="surrogateescape",  # what is no text goes through as it is
            env={**os.environ, **(environment or {})},
            **{**pipes, **options},
        )
        self.pid = self._process.pid
        self._output: list[str] = []
        self._errors: list[str] = []
        streams = (self._process.stdout, self._output), (self._process.stderr, self._errors)
        self._readers = [
            threading.Thread(target=self._read, args=each, daemon=True) for each in streams
        ]
        for reader in self._readers:
            reader.start()
        if ready is not None:
            try:
                wait_until(lambda: self.has_ended or self._when(ready), self.name)
            except TimeoutError:
                self.end()
            if self.has_ended:
                self._gone(None)
                raise self._failure()

    @property
    def output(self) -> str:
        return "".join(self._output)

    @property
    def errors(self) -> str:
        return "".join(self._errors)

    @property
    def has_ended(self) -> bool:
        return self._process.poll() is not None

    def wait_for_line(self, text: str, timeout_s: float = PATIENCE_S) -> float:
        """Wait for the first line with ``text``; return when it came, monotonic s."""
        what = f"{text!r} from pid {self.pid}"
        return float(wait_until(lambda: self._when(text), what, timeout_s))

    def tell(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def kill(self) -> None:
        """End it at once, and wait until it is gone."""
        self._process.kill()
        self._gone(None)

    def end(self, timeout_s: float = STOP_TIMEOUT_S) -> int:
        """Send SIGTERM where it still runs; return its exit status."""
        if not self.has_ended:
            self._process.send_signal(signal.SIGCONT)
            self._process.terminate()
        try:
            return self._gone(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()
            return -signal.SIGKILL

    def wait(self, timeout_s: float = 2 * PATIENCE_S) -> int:
        """Wait until it ends by itself; return its exit status. CommandTimeoutError."""
        try:
            return self._gone(timeout_s)
        except subprocess.TimeoutExpired:
            said = f"python -m {self.name} did not end within {timeout_s:g} s"
            raise CommandTimeoutError(said) from None

    def succeed(self, timeout_s: float = 2 * PATIENCE_S) -> None:
        """Wait until it has ended by itself; UserError with its last line where it failed."""
        if self.wait(timeout_s):
            raise self._failure()

    def crashed(self) -> bool:
        """Return whether it ended on its own, or printed what a crash prints."""
        gone = self.has_ended and not self._ended_by_us
        return gone or any(mark in line for _, line in self.lines for mark in _CRASH_MARKS)

    def resident_mb(self) -> float:
        """Return its resident memory, MB (10^6 bytes), by the kernel's own count."""
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        kib = [int(line.split()[1]) for line in lines if line.startswith("VmRSS:")]
        if not kib:
            raise UserError(f"{self.name} has ended")
        return kib[0] * 1024 / 1e6

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def _gone(self, timeout_s: float | None) -> int:
        self._ended_by_us = True
        status = self._process.wait(timeout_s)
        for reader in self._readers:
            reader.join(_LAST_WORDS_S)
        return status

    def _when(self, text: str) -> float | None:
        return next((seen_s for seen_s, line in self.lines if text in line), None)

    def _failure(self) -> UserError:
        said = [*self.output.split("\n"), *self.errors.split("\n")]
        last = next((line.strip() for line in reversed(said) if line.strip()), "it said nothing")
        return UserError(f"python -m {self.name}: {last}")

    def _read(self, stream: Iterable[str] | None, kept: list[str]) -> None:
        for line in stream or ():
            seen_s = time.monotonic()
            kept.append(line)
            self.lines.append((seen_s, line.rstrip()))
            self._on_line(seen_s, line)


@contextlib.contextmanager
def operator(endpoint: str, vehicle_id: str) -> Iterator[None]:
    """Watch a vehicle for the length of a ``with`` block, and re-arm it after a safe stop.

    A runtime with a vehicle never drives again by itself: this stands in for the person who is
    missing in an unattended drive, and says each time what it does.
    """
    end = threading.Event()

    def watch() -> None:
        while not end.wait(OPERATOR_LOOKS_EVERY_S):
            # Simulator or runtime not up yet, or already gone: nothing to re-arm.
            with contextlib.suppress(UserError):
                status = ask(endpoint, vehicle_id, "status")
                stopped = status["needs_rearm"] and status["mode"] == "safe_stop"
                if stopped and ask(endpoint, vehicle_id, "rearm")["accepted"]:
                    print(f"operator: re-armed {vehicle_id} after {status['reason']}", flush=True)

    with ThreadPoolExecutor(1, "operator") as pool:
        watching = pool.submit(watch)
        try:
            yield
        finally:
            end.set()
        watching.result()  # Where it failed, nobody would have re-armed any more.


def run_command(*arguments: str) -> None:
    """Print ``python -m ...`` and run it to its end; UserError where it failed and has said why."""
    print(f"\n$ python -m {shlex.join(arguments)}", flush=True)
    process = subprocess.Popen([sys.executable, "-m", *arguments])
    try:
        status = process.wait()
    except KeyboardInterrupt:
        # It has had the same ^C, and may have something to keep. A second one is for good.
        try:
            process.wait()
        finally:
            process.kill()
        raise
    if status:
        raise UserError(f"python -m {arguments[0]} {arguments[1]} ended with status {status}")


def drive_shown(
    vehicle_id: str, trust: Sequence[str], simulate: Sequence[str], listener: Sequence[str] = ()
) -> None:
    """Drive the left turn with a mock vehicle and an operator, by commands as a person types them.

    ``trust`` are the edge runtime's options for its policy, ``simulate`` further ones of ``bridge
    simulate``. ``listener`` is a further command of the bridge, which listens and ends after the
    drive. Raises UserError where one of them failed.
    """
    endpoint = free_endpoint()
    common = ("--connect", endpoint, "--vehicle-id", vehicle_id)
    with contextlib.ExitStack() as stack:
        edge = ("edge_runtime", "run", *trust, *common, "--vehicle", "mock")
        stack.enter_context(Process(*edge, ready="ready", shown=True))
        beside = Process("bridge", *listener, *common, shown=True) if listener else None
        stack.enter_context(beside or contextlib.nullcontext())
        stack.enter_context(operator(endpoint, vehicle_id))
        where = ("--listen", endpoint, "--vehicle-id", vehicle_id)
        run_command("bridge", "simulate", "--env", "left_turn", *simulate, *where)
        if beside is not None:
            beside.succeed()


def in_parallel(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    jobs: int,
    on_done: Callable[[Item, Result], None],
    ended: threading.Event | None = None,
) -> None:
    """Do the work of each item, ``jobs`` at a time; ``on_done`` is called here, as they end.

    In threads, which suits work that waits for processes. After a failure, and on ^C, what has not
    begun is not begun any more, ``ended`` is set, and every process that this one has started is
    asked to end.
    """
    with ThreadPoolExecutor(min(jobs, len(items)) or 1) as pool:
        futures = {pool.submit(work, item): item for item in items}
        try:
            for future in as_completed(futures):
                on_done(futures[future], future.result())
        except BaseException:
            if ended is not None:
                ended.set()
            pool.shutdown(wait=False, cancel_futures=True)
            for children in Path("/proc/self/task").glob("*/children"):  # whichever thread waits
                with contextlib.suppress(OSError):  # A thread or child that has just ended
                    for child in children.read_text().split():
                        os.kill(int(child), signal.SIGTERM)
            raise


def wait_until(
    condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S, poll_s: float = POLL_S
) -> Any:
    """Poll until the condition is true and return its value; CommandTimeoutError otherwise."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if value := condition():
            return value
        time.sleep(poll_s)
    raise CommandTimeoutError(f"not within {timeout_s:g} s: {what}")


def trusting(policy: object, public_key: str | None) -> tuple[str, ...]:
    """Return an edge runtime's options for a policy that may be unsigned."""
    named = () if public_key is None else ("--public-key", public_key)
    return ("--policy", str(policy), "--allow-unsigned", *named)
