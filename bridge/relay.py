"""``python -m bridge relay``: a slow and lossy network between a simulator and an edge runtime.

Both ends are unmodified: the edge runtime connects to ``--listen``, where the relay is the
simulator's router; to the simulator at ``--connect`` it is a peer. Through the model pass states
(up), commands, feedback and health (down), in real time. Status and re-arm queries and the
liveliness tokens pass at once: they observe the loop, and are no part of it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Iterator
from functools import partial
from typing import Any

import zenoh

from bridge.clocks import DelayLine, Publish
from bridge.commands import add_vehicle_id, wait_to_be_told
from bridge.network import GRAMMAR, LatencyModel, LatencySpec, make_link, parse_spec
from bridge.ports import simulator_key
from bridge.report import quantiles
from edge_runtime.cli import ArgumentParser, examples, not_negative, sigterm_as_interrupt
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.transport import check_endpoint, is_tls, only_own, open_session
from edge_runtime.util import UserError
from edge_runtime.wire import State, check_vehicle_id, decode_state, key

UP = ("state",)
DOWN = ("command", "feedback", "health")
"""The topics that pass the model, by direction; queries and liveliness pass at once."""
REARM = "rearm"
QUERIES = ("status", REARM)
QUERY_S = 2.0
"""As long as the operator's commands wait for an answer."""
LAG_WINDOW = 100_000
EXAMPLE = examples(
    "python -m bridge relay --listen tcp/127.0.0.1:7448 --connect tcp/127.0.0.1:7447 \\\n"
    "    --latency 50ms+-10ms,loss=1% --out relay.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--listen",
        metavar="PROTOCOL/HOST:PORT",
        required=True,
        help="where the edge runtime connects to",
    )
    parser.add_argument(
        "--connect",
        metavar="PROTOCOL/HOST:PORT",
        required=True,
        help="where the simulator listens; it may come later",
    )
    network = "injected network: " + GRAMMAR.replace("%", "%%")
    parser.add_argument("--latency", metavar="SPEC", default="none", help=network)
    parser.add_argument(
        "--seed", metavar="N", type=not_negative, default=0, help="of delays and losses"
    )
    add_vehicle_id(parser, "the vehicle to relay")
    parser.add_argument(
        "--out", metavar="R.json", help="write the counts to this file at the end (SIGTERM or ^C)"
    )


def run(arguments: Any) -> int:
    """Run the command until it is told to end; UserError for anything the caller can put right."""
    spec = _check(arguments)
    began_s = time.monotonic()
    with sigterm_as_interrupt():
        try:
            with open_relay(
                arguments.listen, arguments.connect, arguments.vehicle_id, spec, arguments.seed
            ) as running:
                _carry(arguments, spec, running)
        except KeyboardInterrupt:
            return 0  # Told to end before it had begun.
    report = _report(arguments, spec, running, time.monotonic() - began_s)
    write_json_out(arguments.out, report)
    print(_summary(report))
    return 0


def _carry(arguments: Any, spec: LatencySpec, running: Relay) -> None:
    """Zenoh's threads do the work; being interrupted is the ordinary end."""
    try:
        print(
            f"ready vehicle_id={arguments.vehicle_id} listen={arguments.listen}"
            f" connect={arguments.connect} latency={spec}",
            flush=True,
        )
        wait_to_be_told()
    except KeyboardInterrupt:
        return


def _check(arguments: Any) -> LatencySpec:
    for endpoint in (arguments.listen, arguments.connect):
        _check_plain(check_endpoint(endpoint))
    if arguments.listen == arguments.connect:
        raise UserError(f"--listen and --connect are both {arguments.listen}: that is a circle")
    check_vehicle_id(arguments.vehicle_id)
    if arguments.out is not None:
        check_writable(arguments.out)
    return parse_spec(arguments.latency)


def _check_plain(endpoint: str) -> None:
    """With TLS it would need two certificates: a simulator to one end, an edge to the other."""
    if is_tls(endpoint):
        raise UserError(
            f"endpoint {endpoint} is not for the relay: it speaks plain text only, for the bench;"
            " use tcp/ or udp/"
        )


def _report(arguments: Any, spec: LatencySpec, running: Relay, duration_s: float) -> dict[str, Any]:
    return {
        "vehicle_id": arguments.vehicle_id,
        "listen": arguments.listen,
        "connect": arguments.connect,
        "latency_spec": str(spec),
        "seed": arguments.seed,
        "duration_s": round(duration_s, 3),
        **running.traffic.report(),
        "queries": running.queries,
    }


def _summary(report: dict[str, Any]) -> str:
    parts = [
        f"{name} {row['delivered']} of {row['received']}" for name, row in report["topics"].items()
    ]
    return (
        f"delivered: {', '.join(parts)}; timers late by p99 {report['timer_lag_ms']['p99']:.2f} ms"
    )


@contextlib.contextmanager
def open_relay(
    listen: str, connect: str, vehicle_id: str, spec: LatencySpec, seed: int
) -> Iterator[Relay]:
    """Listen for the edge runtime and connect to the simulator; UserError for a busy port."""
    with (
        contextlib.closing(open_session(listen=listen, mode="router")) as to_edge,
        contextlib.closing(open_session(connect=connect, mode="peer")) as to_simulator,
        contextlib.closing(Relay(to_edge, to_simulator, vehicle_id, spec, seed)) as relay,
    ):
        yield relay


class Relay:
    """Carries one vehicle's topics between two Zenoh sessions.

    Zenoh calls the handlers on its own threads; they only push into delay lines and ask on.
    """

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
        publishers = {"state": self._publisher(to_edge, "state", express=False)}
        for topic in DOWN:
            publishers[topic] = self._publisher(to_simulator, topic, express=True)
        self._declared: list[Any] = list(publishers.values())
        self.traffic = RelayTraffic(
            spec, seed, {topic: publisher.put for topic, publisher in publishers.items()}
        )
        self._listen()

    def close(self) -> None:
        """Undeclare all, then stop the delay lines. The sessions are the caller's."""
        for declared in reversed(self._declared):
            declared.undeclare()
        # Nobody changes these any more: their listeners went first.
        for token in self._mirrored.values():
            token.undeclare()
        self.traffic.close()

    def _publisher(self, session: zenoh.Session, topic: str, express: bool) -> Any:
        # As the ends themselves publish: nobody is held up by a slow listener.
        return session.declare_publisher(
            key(self._vehicle_id, topic),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME if express else zenoh.Priority.DATA,
            express=express,
        )

    def _listen(self) -> None:
        self._declared.append(self._hear(self._simulator, "state"))
        for topic in DOWN:
            self._declared.append(self._hear(self._edge, topic))
        for topic in QUERIES:
            self._declared.append(self._answer(topic))
        self._mirror(self._edge, self._simulator, key(self._vehicle_id, "alive"))
        self._mirror(self._simulator, self._edge, simulator_key(self._vehicle_id))

    def _hear(self, session: zenoh.Session, topic: str) -> Any:
        take = self.traffic.handler(topic)
        own = key(self._vehicle_id, topic)
        hear = only_own(own, lambda sample: take(sample.payload.to_bytes()))
        return session.declare_subscriber(own, hear)

    def _answer(self, topic: str) -> Any:
        """Ask the edge runtime what the simulator's side asks; the query ends when it is freed."""
        asked = key(self._vehicle_id, topic)

        def came(query: zenoh.Query) -> None:
            # As the edge runtime itself: a look at everything (`phil/**`) re-arms nobody.
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
        models = {"state": link.up, "command": link.down}
        for number, name in enumerate(DOWN[1:], start=1):
            models[name] = make_link(spec, seed + number).down
        self._topics = {name: TopicTraffic(models[name], deliver[name]) for name in (*UP, *DOWN)}
        self._lock = threading.Lock()
        self._up_line, self._down_line = DelayLine(), DelayLine()
        self._lags_s: deque[float] = deque(maxlen=LAG_WINDOW)
        self._first_state_s: float | None = None

    def handler(self, name: str) -> Publish:
        """Return what takes a payload of this topic, on any thread."""
        return self._take_state if name == "state" else partial(self._take, name)

    def close(self) -> None:
        """Stop delivering."""
        for line in (self._up_line, self._down_line):
            line.close()

    def report(self) -> dict[str, Any]:
        """Return the counts of each topic, and how late the timers were."""
        with self._lock:
            lags_ms = [lag_s * 1e3 for lag_s in self._lags_s or (0.0,)]
            counts = {name: topic.counts() for name, topic in self._topics.items()}
        return {"topics": counts, "timer_lag_ms": quantiles(lags_ms)}

    def _take_state(self, payload: bytes) -> None:
        state = decode_state(payload)
        if isinstance(state, State) and state.final:
            self._pass_final(payload)
            return
        with self._lock:
            if self._first_state_s is None:
                self._first_state_s = time.monotonic()
        self._take("state", payload)

    def _pass_final(self, payload: bytes) -> None:
        """As in `bridge simulate`: no radio link carries the end of a simulation.

        Nothing injected may delay or lose it, and states of the ended episode are forgotten.
        """
        self._up_line.clear()
        with self._lock:
            topic = self._topics["state"]
            topic.received += 1
            topic.bytes += len(payload)
            topic.delivered += 1
        topic.deliver(payload)

    def _take(self, name: str, payload: bytes) -> None:
        now_s = time.monotonic()
        line = self._up_line if name in UP else self._down_line
        with self._lock:
            topic = self._topics[name]
            start_s = now_s if self._first_state_s is None else self._first_state_s
            arrivals = topic.model.arrivals(now_s - start_s, len(payload))
            topic.received += 1
            topic.bytes += len(payload)
            topic.lost += not arrivals
            topic.duplicated += len(arrivals) > 1
        for arrival_s in arrivals:
            due_s = start_s + arrival_s
            line.push(due_s, partial(self._deliver, topic, payload, due_s))

    def _deliver(self, topic: TopicTraffic, payload: bytes, due_s: float) -> None:
        with self._lock:
            self._lags_s.append(time.monotonic() - due_s)
            topic.delivered += 1
        topic.deliver(payload)


class TopicTraffic:
    """One topic on its way: what came in, what came out. The caller holds the lock."""

    def __init__(self, model: LatencyModel, deliver: Publish) -> None:
        self.model = model
        self.deliver = deliver
        self.received = self.bytes = self.lost = self.duplicated = self.delivered = 0

    def counts(self) -> dict[str, int]:
        """Return the counts for the report; messages still under way are in none but received."""
        names = ("received", "bytes", "lost", "duplicated", "delivered")
        return {name: getattr(self, name) for name in names}
