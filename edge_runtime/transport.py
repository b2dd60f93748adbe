"""Zenoh sessions with explicit endpoints: no scouting, no gossip, quick to notice a lost peer.

The simulator is a `router` that listens, the edge runtime a `peer` that connects and goes on
trying, and viewers and operators' commands are `client`s that fail at once if nobody listens.
Behind a router of its own the simulator is a `client`, too: two peers would not hear each other.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
import shlex
import time
from functools import partial
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence, Type, TypeVar, Union

import zenoh

from edge_runtime.reach import why_no_link
from edge_runtime.tls import EDGE, OPERATOR, TlsFiles, common_name, load_tls, rules_for_simulator
from edge_runtime.util import PathLike, UserError
from edge_runtime.wire import key

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

# At Zenoh's default lease a peer that was stopped, or whose cable was cut, lives on for 10 s.
LEASE_MS = 1000
# To drive 1 s after a link's return leaves 0.5 s to reconnect: five fresh states take the rest.
RETRY = {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1.5}
RETRY_S = 0.1

_ENDPOINT = re.compile(r"(tcp|udp|tls)/(\[[0-9A-Fa-f:.]+\]|[^\s\[\]/:]+):(\d{1,5})")


def check_endpoint(endpoint: str) -> str:
    """Return the endpoint; UserError if it is not PROTOCOL/HOST:PORT."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 1 <= int(match.group(3)) <= 65535:
        raise UserError(f"endpoint {endpoint!r} is not valid: write it as {DEFAULT_ENDPOINT}")
    return endpoint


def is_tls(endpoint: str) -> bool:
    return endpoint.startswith("tls/")


def check_fits(endpoint: str, with_tls: bool) -> None:
    """Raise UserError for a TLS endpoint without files, and for files with a plain endpoint."""
    if with_tls and not is_tls(endpoint):
        right = f"write tls/{endpoint.split('/', 1)[1]}"
        raise UserError(f"endpoint {endpoint} would send plain text despite --tls: {right}")
    if not with_tls and is_tls(endpoint):
        raise UserError(f"endpoint {endpoint} needs certificates: name their directory with --tls")


def tls_for(directory: Optional[PathLike], *endpoints: Optional[str]) -> Optional[TlsFiles]:
    """Load `--tls DIR`; None without it. UserError where an endpoint does not go with that."""
    for endpoint in endpoints:
        if endpoint is not None:
            check_fits(endpoint, directory is not None)
    return None if directory is None else load_tls(directory)


def open_session(
    listen: Union[str, Sequence[str], None] = None,
    connect: Optional[str] = None,
    mode: str = "peer",
    tls: Optional[TlsFiles] = None,
    access: Optional[Dict[str, Any]] = None,
) -> zenoh.Session:
    """Open a session that listens, connects, or both. Close it before the process ends.

    `mode` is "router", "peer" or "client"; `access` is Zenoh's `access_control`, of tls.py. Raises
    UserError for a malformed endpoint, one that does not go with `tls`, a busy port, and, in client
    mode, if no link comes about.
    """
    listens = [listen] if isinstance(listen, str) else list(listen or [])
    if listens and tls is not None and access is None:
        raise ValueError("a TLS listener needs access control: else any certificate has all rights")
    for endpoint in [*listens, *([] if connect is None else [connect])]:
        check_fits(check_endpoint(endpoint), tls is not None)
    config = zenoh.Config()
    for name, value in _settings(listens, connect, mode, tls, access).items():
        config.insert_json5(name, json.dumps(value))
    link = f"link to {connect}" if tls is None else f"TLS link to {connect} as {tls.name}"
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        if connect is None or listens:
            why = str(error).partition(" at /")[0]  # where in Zenoh's source it was raised
            words = f"cannot listen at {', '.join(listens)}: {why}; choose another with --listen"
            raise UserError(words) from None
        why = why_no_link(connect, tls)[1]
        first = "start the simulator or router there first, or name another address with --connect"
        raise UserError(f"no {link}{why and f' ({why})'}; {first}") from None
    if connect is not None and tls is not None and not session.info.routers_zid():
        # A peer retries for ever, even if its certificate is refused: report that now.
        answers, why = why_no_link(connect, tls)
        if answers and why and not session.info.routers_zid():
            session.close()
            raise UserError(f"no {link}: {why}")
    return session


def _settings(
    listens: List[str], connect: Optional[str], mode: str, tls: Optional[TlsFiles], access: Any
) -> Dict[str, Any]:
    """Return Zenoh's settings by their paths, as in `scouting/gossip/enabled`."""
    rows: Dict[str, Any] = {
        "mode": mode,
        # Explicitly none: a peer would otherwise listen on every interface.
        "listen/endpoints": listens,
        "connect/endpoints": [] if connect is None else [connect],
        "connect/retry": RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Without scouting there is nothing to wait for; the default costs 0.5 s at every start.
        "scouting/delay": 0,
        "transport/link/tx/lease": LEASE_MS,
        # It would map 17 MB for messages of 7 KB, and share them with any local process.
        "transport/shared_memory/enabled": False,
    }
    if mode == "router":
        # Zenoh's maximum. At its default, 2, a recorder that loses the CPU briefly loses commands.
        rows["transport/link/tx/queue/size/real_time"] = 16
    if tls is not None:
        rows["transport/link/tls"] = tls.zenoh_rows()
        # The port speaks TLS only, whatever an endpoint's metadata asks for.
        rows["transport/link/protocols"] = ["tls"]
    if access is not None:
        rows["access_control"] = access
    return rows


def connect_client(endpoint: str, wait_s: float, tls: Optional[TlsFiles] = None) -> zenoh.Session:
    """Open a client, trying again for `wait_s`: both ends are often started together."""
    give_up_s = time.monotonic() + wait_s
    while True:
        try:
            return open_session(connect=endpoint, mode="client", tls=tls)
        except UserError:
            if time.monotonic() >= give_up_s:
                raise
            time.sleep(RETRY_S)


def only_own(own: str, hear: Callable[[zenoh.Sample], None]) -> Callable[[zenoh.Sample], None]:
    """Make a callback that drops samples put to a wildcard key, such as `phil/*/state`."""

    def take(sample: zenoh.Sample) -> None:
        if str(sample.key_expr) == own:
            hear(sample)

    return take


class SimulatorEnd:
    """The simulator's end of the wire: of `bridge simulate`, and of `sense` in its place."""

    def __init__(
        self, session: zenoh.Session, vehicle_id: str, tls: Optional[TlsFiles] = None
    ) -> None:
        self.vehicle_id, self.session = vehicle_id, secrets.token_hex(8)
        self._zenoh, self._tls = session, tls
        # DROP: a slow listener must never hold up the simulation.
        drop = zenoh.CongestionControl.DROP
        self._states, self.scenes = (
            session.declare_publisher(f"phil/{vehicle_id}/{topic}", congestion_control=drop)
            for topic in ("state", "scene")
        )
        token = session.liveliness().declare_token(f"phil/{vehicle_id}/simulator")
        self._declared: List[Any] = [self._states, self.scenes, token]

    def hear(self, topic: str, handler: Callable[[bytes], None]) -> None:
        """Call `handler(payload)`, which must be quick, for every message of the topic."""
        own = key(self.vehicle_id, topic)
        take = only_own(own, lambda sample: handler(sample.payload.to_bytes()))
        self._declared.append(self._zenoh.declare_subscriber(own, take))

    def publish_state(self, payload: bytes) -> None:
        """Send an encoded state to edge and viewers; UserError once our certificate has expired."""
        if self._tls is not None:
            self._tls.require_valid(time.time())
        self._states.put(payload)

    def close(self) -> None:
        """Undeclare everything: a callback left open hangs the process at its end."""
        for declared in reversed(self._declared):
            declared.undeclare()


_End = TypeVar("_End", bound=SimulatorEnd)


@contextlib.contextmanager
def open_simulator(
    kind: Type[_End],
    listen: Optional[str],
    vehicle_id: str,
    tls: Optional[TlsFiles] = None,
    connect: Optional[str] = None,
    wait_s: float = 0.0,
) -> Iterator[_End]:
    """Listen at `listen` for the edge runtime, or share the router at `connect` with others.

    With `tls`, the listener or router limits every party to the rights of its certificate's name.
    UserError if the port is busy, or if no router answers within `wait_s`.
    """
    rules = None if tls is None else rules_for_simulator(tls, vehicle_id, connect is None)
    # Behind a router a client: two peers there would not hear one another.
    if connect is not None:
        session = connect_client(connect, wait_s, tls)
    else:
        session = open_session(listen=listen, mode="router", tls=tls, access=rules)
    with session, contextlib.closing(kind(session, vehicle_id, tls)) as end:
        yield end


def pasted(
    words: str, role: str, endpoint: str, vehicle_id: str, tls: Optional[TlsFiles] = None
) -> str:
    """Return the command line for `role` in another shell of this machine.

    Loopback replaces an address that means every interface; over TLS Zenoh cannot connect to
    `[::1]`. The certificate is taken from beside our own (`tls`), else from `deploy certs`' folder.
    """
    place = endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/localhost:")
    options = ["--connect", place, "--vehicle-id", vehicle_id]
    if tls is not None:
        name = common_name(role, vehicle_id)
        beside = Path(tls.certificate).parent.with_name(name)
        options += ["--tls", str(beside) if beside.is_dir() else f"certs/{name}"]
    return f"python -m edge_runtime {words} {' '.join(map(shlex.quote, options))}"


rearm_command = partial(pasted, "rearm", OPERATOR)
run_command = partial(pasted, "run --policy POLICY.onnx", EDGE)  # the reader names the policy
