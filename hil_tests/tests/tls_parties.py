"""Certificates, sessions under a party's name, and an intruder, for the tests of security."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zenoh

from deploy.__main__ import main
from edge_runtime import wire
from edge_runtime.tests.harness import make_state
from edge_runtime.tls import load_tls
from edge_runtime.transport import open_session

SETTLE_S = 0.4
"""Until both ends know of a declaration, and until what must not come would have come."""


def make_certificates(folder: Path) -> Path:
    """Certificates for hunter01 and hunter02, and in `foreign` those of another authority."""
    vehicles = ["--vehicle-id", "hunter01", "--vehicle-id", "hunter02"]
    assert main(["certs", "--out", str(folder), *vehicles]) == 0
    assert main(["certs", "--out", str(folder / "foreign")]) == 0
    return folder


@contextlib.contextmanager
def session(
    endpoint: str, folder: Path | None, mode: str = "client", rules: Any = None
) -> Iterator[zenoh.Session]:
    """A session that connects with the files of a folder, plain without one."""
    tls = None if folder is None else load_tls(folder)
    opened = open_session(connect=endpoint, mode=mode, tls=tls, access=rules)
    try:
        yield opened
    finally:
        opened.close()


@contextlib.contextmanager
def listener(endpoint: str, folder: Path, rules: Any) -> Iterator[zenoh.Session]:
    """A router inside this process."""
    opened = open_session(listen=endpoint, mode="router", tls=load_tls(folder), access=rules)
    try:
        yield opened
    finally:
        opened.close()


class Intruder:
    """Says all that it should not about hunter01, and listens for all that it should not hear."""

    def __init__(self, zenoh_session: zenoh.Session) -> None:
        self._session = zenoh_session
        self._own_zid = str(zenoh_session.info.zid())
        self.heard: set[str] = set()
        self._subscribers = [
            zenoh_session.declare_subscriber(keys, self._hear, allowed_origin=zenoh.Locality.REMOTE)
            for keys in ("**", "phil/**", "phil/hunter01/state", "phil/hunter01/command")
        ]
        self._tokens = zenoh_session.liveliness().declare_subscriber(
            "phil/hunter01/*", self._hear, history=True
        )

    def speak(self) -> None:
        """Publish a valid message, a broken one and a deletion on every key of hunter01."""
        state = make_state(10**6, session="intruder")
        for topic in ("state", "command", "feedback", "health", "scene"):
            where = f"phil/hunter01/{topic}"
            for payload in (wire.encode(state), b"broken"):
                self._session.put(where, payload)
            self._session.delete(where)

    def ask(self) -> list[str]:
        """The keys that answered a query for anything of hunter01, or for the router's insides."""
        found = []
        for selector in ("phil/hunter01/*", "phil/hunter01/status", "phil/hunter01/rearm"):
            found += [str(r.ok.key_expr) for r in self._session.get(selector, timeout=1.0) if r.ok]
        for reply in self._session.get("@/**", timeout=1.0):
            # A session answers for itself, from its own memory; nobody else may.
            if reply.ok and self._own_zid not in str(reply.ok.key_expr):
                found.append(str(reply.ok.key_expr))
        tokens = self._session.liveliness().get("phil/hunter01/alive", timeout=1.0)
        return found + [str(reply.ok.key_expr) for reply in tokens if reply.ok]

    def close(self) -> None:
        for subscriber in (*self._subscribers, self._tokens):
            subscriber.undeclare()

    def _hear(self, sample: Any) -> None:
        self.heard.add(str(sample.key_expr))
