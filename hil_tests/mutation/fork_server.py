"""Runs pytest in a child of a process that has the libraries loaded: a mutant in half a second.

`python -m hil_tests.mutation.fork_server SOCKET` serves; `fork_client.py` is the test command.
Nothing of the code under test is imported here, so that each child reads its mutant.
"""

from __future__ import annotations

import importlib
import json
import os
import select
import signal
import socket
import sys

_LIBRARIES = (
    "cryptography.hazmat.primitives.asymmetric.ed25519",
    "hypothesis.stateful",
    "msgspec",
    "numpy",
    "onnx.helper",
    "onnx.numpy_helper",
    "pytest",
    "zenoh",
)


def main() -> None:
    """Serve one request after the other until killed."""
    for library in _LIBRARIES:
        importlib.import_module(library)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(sys.argv[1])
        server.listen(1)
        while True:
            connection, _ = server.accept()
            with connection:
                _serve(connection)


def _serve(connection: socket.socket) -> None:
    arguments = json.loads(connection.recv(65536))
    pid = os.fork()
    if pid == 0:
        os.setsid()
        _run(arguments)
    status = _wait(pid, connection)
    if status is not None:
        connection.sendall(bytes([status]))


def _run(arguments: list[str]) -> None:
    """The child: pytest, then out, whatever the mutant left behind."""
    silence = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(silence, descriptor)
    code = 1
    try:
        import pytest
        from hypothesis import HealthCheck, Phase, settings

        # The first counter-example is enough: nobody reads the smallest one. And a busy machine
        # must not look like a mutant that was found.
        settings.register_profile(
            "mutate",
            phases=(Phase.explicit, Phase.generate),
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )
        settings.load_profile("mutate")
        code = int(pytest.main(arguments))
    finally:
        os._exit(code)


def _wait(pid: int, connection: socket.socket) -> int | None:
    """The child's status; None where the client left (out of time), and the child with it."""
    child = os.pidfd_open(pid)
    try:
        ready, _, _ = select.select([child, connection.fileno()], [], [])
        if child not in ready:
            os.killpg(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
    finally:
        os.close(child)
    return None if child not in ready else min(255, os.waitstatus_to_exitcode(status) % 256)


if __name__ == "__main__":
    main()
