"""What stands between simulators and edge runtimes: ``python -m bridge relay`` and ``router``.

The router connects simulators, edge runtimes and viewers. The relay is a slow and lossy network
between two unmodified ends: to the edge runtime, at ``--listen``, it is the simulator's router, and
to the simulator at ``--connect`` a peer. States (up), commands, feedback and health (down) pass
through the model, in real time. Status and re-arm queries and the liveliness tokens pass at once:
they observe the loop, and are no part of it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from functools import partial
from typing import Any

import zenoh

from bridge.clocks import DelayLine, Publish
from bridge.network import LatencySpec, make_link
from bridge.ports import add_options, simulator_key, wait_to_be_told
from bridge.report import quantiles
from edge_runtime import tls as access
from edge_runtime.cli import Command, examples, sigterm_as_interrupt
from edge_runtime.files import write_json_out
from edge_runtime.transport import DEFAULT_ENDPOINT, is_tls, only_own, open_session
from edge_runtime.util import UserError, read_bytes
from edge_runtime.wire import DEFAULT_VEHICLE_ID, State, decode_state, key

DOWN = ("command", "feedback", "health")
"""The topics that pass the model towards the simulator; the other way goes the state."""
REARM = "rearm"
QUERIES = ("status", REARM)
QUERY_S = 2.0  # As long as the operator's commands wait for an answer
LAG_WINDOW = 100_000
COUNTS = ("received", "bytes", "lost", "duplicated", "delivered")


def _add_relay_arguments(parser: Any) -> None:
    add_options(parser, "--listen", required=True, help="where the edge runtime connects to")
    help_text = "where the simulator listens; it may come later"
    add_options(parser, "--connect", required=True, default=None, help=help_text)
    add_options(parser, "--latency", "--seed")
    add_options(parser, "--vehicle-id", help="the vehicle to relay")
    help_text = "write the counts to this file at the end (SIGTERM or ^C)"
    add_options(parser, "--out", help=help_text)


def _run_relay(arguments: Any) -> int:
    for endpoint in (arguments.listen, arguments.connect):
        if is_tls(endpoint):  # it would need two certificates: a simulator's and an edge's
            raise UserError(
                f"endpoint {endpoint} is not for the relay: it speaks plain text only, for the"
                " bench; use tcp/ or udp/"
            )
    if arguments.listen == arguments.connect:
        raise UserError(f"--listen and --connect are both {arguments.listen}: that is a circle")
    names = ("vehicle_id", "listen", "connect", "latency", "seed")
    asked = {name: getattr(arguments, name) for name in names}
    began_s = time.monotonic()
    relay: Relay | None = None
    with (
        contextlib.suppress(KeyboardInterrupt),  # the ordinary end
        sigterm_as_interrupt(),
        open_relay(**asked) as running,
    ):
        relay = running
        print("ready", *(f"{name}={asked[name]}" for name in names[:4]), flush=True)
        wait_to_be_told()
    if relay is None:
        return 0  # told to end before it had begun
    report = {
        "latency_spec": str(asked.pop("latency")),
        **asked,
        "duration_s": round(time.monotonic() - began_s, 3),
        **relay.traffic.report(),
        "queries": relay.queries,
    }
    write_json_out(arguments.out, report)
    topics = report["topics"].items()
    parts = ", ".join(f"{name} {row['delivered']} of {row['received']}" for name, row in topics)
    late_ms = report["timer_lag_ms"]["p99"]
    print(f"delivered: {parts}; timers late by p99 {late_ms:.2f} ms")
    return 0


@contextlib.contextmanager
def open_relay(
    listen: str, connect: str, vehicle_id: str, latency: LatencySpec, seed: int
) -> Iterator[Relay]:
    """Listen for the edge runtime and connect to the simulator; UserError for a busy port."""
    with (
        contextlib.closing(open_session(listen=listen, mode="router")) as to_edge,
        contextlib.closing(open_session(connect=connect, mode="peer")) as to_simulator,
        contextlib.closing(Relay(to_edge, to_simulator, vehicle_id, latency, seed)) as relay,
    ):
        yield relay


class Relay:
    """Carries one vehicle's topics between two Zenoh sessions, on Zenoh's own threads."""

    def __init__(
        self,
        to_edge: zenoh.Session,
        to_simulator: zenoh.Session,
        vehicle_id: str,
        spec: LatencySpec,
        seed: int,
    ) -> None:
        self.queries = dict.fromkeys(QUERIES, 0)
        self._edge, self._simulator, self._vehicle_id = to_edge, to_simulator, vehicle_id
        self._lock = threading.Lock()
        self._mirrored: dict[str, Any] = {}
        ways = {"state": (to_simulator, to_edge)} | dict.fromkeys(DOWN, (to_edge, to_simulator))
        publishers = {topic: self._publisher(to, topic) for topic, (_, to) in ways.items()}
        self.traffic = RelayTraffic(spec, seed, {name: one.put for name, one in publishers.items()})
        self._declared = list(publishers.values())
        self._declared += [self._hear(source, topic) for topic, (source, _) in ways.items()]
        self._declared += [self._answer(topic) for topic in QUERIES]
        self._mirror(to_edge, to_simulator, key(vehicle_id, "alive"))
        self._mirror(to_simulator, to_edge, simulator_key(vehicle_id))

    def close(self) -> None:
        """Undeclare all, then stop the delay lines. The sessions are the caller's."""
        for declared in reversed(self._declared):
            declared.undeclare()
        # Their listeners went first, so these no longer change.
        for token in self._mirrored.values():
            token.undeclare()
        self.traffic.close()

    def _publisher(self, session: zenoh.Session, topic: str) -> Any:
        # As the ends themselves publish: a slow listener holds nothing up.
        express = topic in DOWN
        return session.declare_publisher(
            key(self._vehicle_id, topic),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME if express else zenoh.Priority.DATA,
            express=express,
        )

    def _hear(self, session: zenoh.Session, topic: str) -> Any:
        own = key(self._vehicle_id, topic)
        hear = only_own(own, lambda sample: self.traffic.take(topic, sample.payload.to_bytes()))
        return session.declare_subscriber(own, hear)

    def _answer(self, topic: str) -> Any:
        """Ask the edge runtime what the simulator's side asks; the query ends when it is freed."""
        asked = key(self._vehicle_id, topic)

        def came(query: zenoh.Query) -> None:
            # As the edge runtime itself: a query for everything (`phil/**`) re-arms no vehicle.
            if topic == REARM and str(query.key_expr) != asked:
                return
            with self._lock:
                self.queries[topic] += 1

            def replied(reply: zenoh.Reply) -> None:
                if reply.ok is not None:
                    query.reply(asked, reply.ok.payload, encoding=reply.ok.encoding)

            self._edge.get(asked, handler=replied, timeout=QUERY_S)

        return self._simulator.declare_queryable(asked, came)

    def _mirror(self, seen_by: zenoh.Session, shown_to: zenoh.Session, token_key: str) -> None:
        """Show a liveliness token on the other side for as long as it is seen on this one."""

        def changed(sample: zenoh.Sample) -> None:
            with self._lock:
                token = self._mirrored.pop(token_key, None)
                if token is not None:
                    token.undeclare()
                if sample.kind == zenoh.SampleKind.PUT:
                    self._mirrored[token_key] = shown_to.liveliness().declare_token(token_key)

        self._declared.append(
            seen_by.liveliness().declare_subscriber(token_key, changed, history=True)
        )


class RelayTraffic:
    """Holds every message back, drops or doubles it, as the specification says.

    Each topic has a model of its own, so that states and commands meet the same luck as in
    ``bridge simulate --latency`` with the same seed, and a rate is each topic's. Time 0 of the
    models, and so of outage windows, is when the first state comes.
    """

    def __init__(self, spec: LatencySpec, seed: int, deliver: dict[str, Publish]) -> None:
        link = make_link(spec, seed)
        self._models = {"state": link.up, "command": link.down}
        for number, name in enumerate(DOWN[1:], start=1):
            self._models[name] = make_link(spec, seed + number).down
        self._deliver = deliver
        self._counts = {name: Counter(dict.fromkeys(COUNTS, 0)) for name in self._models}
        self._lock = threading.Lock()
        self._up_line, self._down_line = DelayLine(), DelayLine()
        self._lags_s: deque[float] = deque(maxlen=LAG_WINDOW)
        self._first_state_s: float | None = None

    def close(self) -> None:
        """Stop delivering."""
        self._up_line.close()
        self._down_line.close()

    def report(self) -> dict[str, Any]:
        """Return the counts of each topic, and how late the timers were."""
        with self._lock:
            lags_ms = [lag_s * 1e3 for lag_s in self._lags_s or (0.0,)]
            counts = {name: dict(counted) for name, counted in self._counts.items()}
        return {"topics": counts, "timer_lag_ms": quantiles(lags_ms)}

    def take(self, name: str, payload: bytes) -> None:
        """Take a payload of a topic, on any thread.

        No radio link carries the end of a simulation: as in ``bridge simulate``, nothing delays or
        loses the final state, and the states of the ended episode are forgotten.
        """
        state = decode_state(payload) if name == "state" else None
        is_final = isinstance(state, State) and state.final
        line = self._down_line if state is None else self._up_line
        if is_final:
            line.clear()
        with self._lock:
            now_s = time.monotonic()
            if state is not None and not is_final and self._first_state_s is None:
                self._first_state_s = now_s
            start_s = now_s if self._first_state_s is None else self._first_state_s
            arrivals: tuple[float, ...] = (now_s - start_s,)
            if not is_final:
                arrivals = self._models[name].arrivals(now_s - start_s, len(payload))
            counts = self._counts[name]
            counts["received"] += 1
            counts["bytes"] += len(payload)
            counts["lost"] += not arrivals
            counts["duplicated"] += len(arrivals) > 1
        if is_final:
            self._come_out(name, payload)
            return
        for arrival_s in arrivals:
            due_s = start_s + arrival_s
            line.push(due_s, partial(self._come_out, name, payload, due_s))

    def _come_out(self, name: str, payload: bytes, due_s: float | None = None) -> None:
        """Deliver it; ``due_s`` is when its timer was to run, None where it passes at once."""
        with self._lock:
            if due_s is not None:
                self._lags_s.append(time.monotonic() - due_s)
            self._counts[name]["delivered"] += 1
        self._deliver[name](payload)


def _add_router_arguments(parser: Any) -> None:
    help_text = f"where all others connect to; may be repeated (default: {DEFAULT_ENDPOINT})"
    add_options(parser, "--listen", action="append", help=help_text)
    add_options(parser, "--tls")
    vehicle = "a vehicle whose parties have rights here, with --tls; may be repeated"
    vehicle += f" (default: {DEFAULT_VEHICLE_ID})"
    add_options(parser, "--vehicle-id", action="append", default=None, help=vehicle)
    config = "all settings from a file of `python -m deploy router`, and no other option"
    parser.add_argument("--config", metavar="FILE.json5", help=config)


def _run_router(arguments: Any) -> int:
    """Route until SIGTERM or ^C; without ``--tls``, everything that anybody sends."""
    listens = list(dict.fromkeys(arguments.listen or [DEFAULT_ENDPOINT]))
    tls, rules, ready = None, None, f"config={arguments.config}"
    if arguments.config is None:
        ready = f"listen={','.join(listens)}"
        tls = access.tls_for(arguments.tls, *listens)
    elif arguments.listen or arguments.tls or arguments.vehicle_id:
        raise UserError("--config goes with no other option: the file says it all")
    if tls is not None:
        access.check_name(tls.name, access.ROUTER)
        rules = access.rules_for_listener(arguments.vehicle_id or [DEFAULT_VEHICLE_ID])
    with contextlib.suppress(KeyboardInterrupt), sigterm_as_interrupt():
        if arguments.config is None:
            session = open_session(listen=listens, mode="router", tls=tls, access=rules)
        else:
            read_bytes(arguments.config, "router's config file")
            try:  # as zenohd would
                session = zenoh.open(zenoh.Config.from_file(arguments.config))
            except zenoh.ZError as error:
                raise UserError(f"Zenoh opens no router with {arguments.config}: {error}") from None
        with contextlib.closing(session):
            print(f"ready {ready}", flush=True)
            wait_to_be_told()
    return 0


RELAY_EXAMPLE = examples(
    "python -m bridge relay --listen tcp/127.0.0.1:7448 --connect tcp/127.0.0.1:7447 \\\n"
    "    --latency 50ms+-10ms,loss=1% --out relay.json",
)
ROUTER_EXAMPLE = examples(
    "python -m bridge router --listen tcp/127.0.0.1:7447",
    "python -m bridge router --listen tls/0.0.0.0:7447 --tls certs/router \\\n"
    "    --vehicle-id hunter01 --vehicle-id hunter02",
)
RELAY = Command(RELAY_EXAMPLE, _add_relay_arguments, _run_relay)
ROUTER = Command(ROUTER_EXAMPLE, _add_router_arguments, _run_router)
