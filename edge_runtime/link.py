"""The edge runtime's end of the wire: its messages and queries, its claim to the vehicle id, and
the quality of the link.

Besides `phil/<id>/alive` each runtime declares `phil/<id>/alive/<claim>`, because Zenoh shows
equal tokens of two sessions as one. Of two runtimes with one vehicle id the younger claim gives
way; a claim is as old as the connection to the router, so a runtime that reconnects loses its
seniority.
"""

from __future__ import annotations

import ctypes
import json
import os
import threading
import time
from collections import deque
from typing import Any, Callable, Deque, Dict, List, Mapping, Optional, Set, Tuple

import msgspec
import numpy as np
import zenoh

from edge_runtime import __version__, log
from edge_runtime.manifest import Manifest
from edge_runtime.reach import Listener
from edge_runtime.tls import TlsFiles
from edge_runtime.transport import LEASE_MS, only_own, open_session
from edge_runtime.util import UserError, parse_json
from edge_runtime.wire import Health, Message, Rejection, State, encode, key

OpenClient = Callable[[], zenoh.Session]

_POLL_S = 0.1
# A claim that is seen in two looks this far apart is no leftover of a lost connection.
_FIRST_LOOKS_S = 0.3
_LOOK_S = 1.0
_JOIN_S = 0.5
_LEFTOVER_S = 1.5 * LEASE_MS / 1000.0


class Link:
    """Declares, sends and replies, and decides nothing. `listener` is None without TLS."""

    def __init__(
        self,
        session: zenoh.Session,
        vehicle_id: str,
        manifest: Manifest,
        listener: Optional[Listener] = None,
    ) -> None:
        self.vehicle_id, self.listener = vehicle_id, listener
        self.gave_way = False  # another runtime speaks for this vehicle
        self._session, self._manifest = session, manifest
        self._declared: List[Any] = []
        self._newest: Dict[str, Message] = {}  # of each topic
        self._presence: Optional[Presence] = None
        self._publishers = {
            # DROP: a full queue must never hold the control loop, and the next message is better.
            topic: session.declare_publisher(
                key(vehicle_id, topic),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            for topic in ("command", "feedback", "health")
        }

    def declare(
        self,
        on_state: Callable[[bytes], None],
        health: Callable[[], Health],
        rearm: Callable[[str], str],
        max_state_bytes: int,
    ) -> None:
        """Subscribe to states and answer queries. Call `appear` afterwards."""

        def state_came(sample: zenoh.Sample) -> None:
            # One byte too many is enough to be rejected; a huge message is not copied.
            is_huge = len(sample.payload) > max_state_bytes
            on_state(bytes(max_state_bytes + 1) if is_huge else bytes(sample.payload))

        def status_asked(query: zenoh.Query) -> None:
            newest = {topic: self._newest.get(topic) for topic in ("command", "feedback")}
            about = {"version": __version__, "manifest": self._manifest, **newest}
            _reply(query, msgspec.to_builtins({**msgspec.structs.asdict(health()), **about}))

        def rearm_asked(query: zenoh.Query) -> None:
            # A query to a wildcard such as `phil/**` explores: it is no permission to move.
            if str(query.key_expr) != rearm_key:
                return
            refusal = rearm(bytes(query.payload or b"").decode(errors="replace"))
            _reply(query, {"accepted": not refusal, "detail": refusal, "mode": health().mode})

        session, state_key = self._session, key(self.vehicle_id, "state")
        rearm_key = key(self.vehicle_id, "rearm")
        self._declared = [
            session.declare_subscriber(state_key, _at_once(only_own(state_key, state_came))),
            session.declare_queryable(key(self.vehicle_id, "status"), status_asked),
            session.declare_queryable(rearm_key, rearm_asked),
        ]

    def appear(self, open_client: OpenClient, stop: Callable[[], None]) -> None:
        """Show that it is alive; call `stop` for an elder runtime or an expired certificate."""

        def give_way() -> None:
            self.gave_way = True
            stop()

        alive = key(self.vehicle_id, "alive")
        self._stop = stop
        self._presence = Presence(self._session, alive, open_client, give_way, self.listener)
        self._declared.append(self._presence)
        self._presence.thread.start()

    @property
    def rivals(self) -> int:
        return self._presence.rivals if self._presence else 0

    def send(self, topic: str, message: Message) -> None:
        """Publish a message. A failure is logged: the receiver's own watchdog handles it."""
        if self.gave_way:
            return
        self._newest[topic] = message
        if self._presence and self.listener and time.time() >= self.listener.own_until_s:
            self._stop()
        try:
            self._publishers[topic].put(encode(message))
        except zenoh.ZError as error:
            log.event("error", "not_sent", topic=topic, detail=error)

    def refusal(self, now_s: float) -> Optional[Rejection]:
        return self.listener.refusal(now_s) if self.listener else None

    def close(self) -> None:
        """Undeclare all, the token first, then close the session (it hangs at exit otherwise)."""
        try:
            for declared in [*reversed(self._declared), *self._publishers.values()]:
                declared.undeclare()
        finally:
            self._session.close()


def _at_once(callback: Callable[[zenoh.Sample], None]) -> Any:
    """Call from Zenoh's own thread: no second thread to wake, no queue of old states in between.

    The callback must be quick. A native thread that calls into Python creates a thread state at
    each call, in tens of microseconds. A PyGILState_Ensure that is never released keeps it.
    """
    thread = threading.local()

    def call(sample: zenoh.Sample) -> None:
        if not hasattr(thread, "keeps_its_state"):
            ctypes.pythonapi.PyGILState_Ensure()
            thread.keeps_its_state = True
        callback(sample)

    return zenoh.handlers.Callback(call, indirect=False)


def _reply(query: zenoh.Query, value: Dict[str, Any]) -> None:
    query.reply(query.key_expr, json.dumps(value).encode(), encoding="application/json")


def require_free(open_client: OpenClient, vehicle_id: str) -> None:
    """Raise UserError where a router knows another runtime with this vehicle id.

    Two peers do not hear each other through a router, so a client asks it. The token of a process
    that was just killed may stay for a lease, so a token counts only if it outlasts that.
    """
    selector = f"{key(vehicle_id, 'alive')}/**"
    if _ask(open_client, selector):
        time.sleep(_LEFTOVER_S)
        if _ask(open_client, selector):
            raise taken(vehicle_id)


def taken(vehicle_id: str) -> UserError:
    found = f"another edge runtime is connected with vehicle id {vehicle_id}"
    return UserError(f"{found}; end that one first")


class Presence:
    """Declares the tokens, and declares them again whenever this session's routers have changed.

    Zenoh 1.5 (the board's) does not announce earlier tokens to a router that appears later. Runs in
    a thread of its own, which may wait for the network; calls `give_way` for an elder claim.
    """

    def __init__(
        self,
        session: zenoh.Session,
        alive_key: str,
        open_client: OpenClient,
        give_way: Callable[[], None],
        listener: Optional[Listener] = None,
    ) -> None:
        self.rivals = 0
        self._session, self._key, self._open_client = session, alive_key, open_client
        self._give_way, self._listener = give_way, listener
        self._known: Set[str] = set()
        self._seen_before: Optional[Set[str]] = None  # the claims of the last look
        self._tokens: List[Any] = []
        self._routers = self._seen_routers()
        self._declare()
        self._stopping = threading.Event()
        self.thread = threading.Thread(target=self._run, name="presence", daemon=True)

    def refresh(self) -> None:
        """Declare the tokens again if other routers are there than the last time."""
        routers = self._seen_routers()
        if routers and routers != self._routers:
            if self._listener:
                self._listener.look()  # before anybody sees the tokens, and sends
            self._declare()  # it is tried again where this fails
        self._routers = routers

    def look(self) -> None:
        """Look for other claims; give way to an elder one that is seen for the second time."""
        pause_s = _FIRST_LOOKS_S if self._seen_before is None else _LOOK_S
        self._look_at_s = time.monotonic() + pause_s
        tokens = _ask(self._open_client, f"{self._key}/*")
        claims = {key.rsplit("/", 1)[1] for key in tokens} - {self.claim}
        seen_twice = claims & (self._seen_before or set())
        for claim in sorted(seen_twice - self._known):
            self._known.add(claim)
            self.rivals += 1
            log.event("error", "another_edge", claim=claim, elder=claim < self.claim)
        self._seen_before = claims
        if any(claim < self.claim for claim in seen_twice):
            self._give_way()

    def undeclare(self) -> None:
        self._stopping.set()
        if self.thread.is_alive() and self.thread is not threading.current_thread():
            self.thread.join(_JOIN_S)
        self._take_back()

    def _declare(self) -> None:
        self._take_back()
        # Wall clock, because two boards compare it; the random part breaks a tie.
        self.claim = f"{time.time_ns():016x}-{os.urandom(4).hex()}"
        self._seen_before, self._look_at_s = None, time.monotonic() + _FIRST_LOOKS_S
        for token in (self._key, f"{self._key}/{self.claim}"):
            self._tokens.append(self._session.liveliness().declare_token(token))

    def _take_back(self) -> None:
        while self._tokens:
            self._tokens.pop(0).undeclare()

    def _seen_routers(self) -> List[str]:
        return sorted(map(str, self._session.info.routers_zid()))

    def _run(self) -> None:
        while not self._stopping.wait(_POLL_S):
            try:
                self.refresh()
                if self._routers and time.monotonic() >= self._look_at_s:
                    if self._listener and self._listener.refusal(time.time()):
                        self._listener.look()
                    self.look()
            except zenoh.ZError as error:
                log.event("error", "token_not_declared", detail=error)


def _ask(open_client: OpenClient, selector: str) -> List[str]:
    """Return the tokens that a router knows; none where no router answers."""
    try:
        session = open_client()
    except UserError:
        return []
    try:
        replies = session.liveliness().get(selector, timeout=1.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
    finally:
        session.close()


def ask(
    connect: str,
    vehicle_id: str,
    topic: str,
    tls: Optional[TlsFiles] = None,
    payload: Optional[str] = None,
) -> Dict[str, Any]:
    """Query a runtime's "status" or "rearm" for its JSON; UserError without an answer in 2 s."""
    selector = key(vehicle_id, topic)
    with open_session(connect=connect, mode="client", tls=tls) as session:
        for reply in session.get(selector, timeout=2.0, payload=payload):
            if reply.ok is not None:
                return parse_json(bytes(reply.ok.payload), f"the answer of {vehicle_id}")
    # A query that access control drops looks the same from here as an absent runtime.
    hint = f", or the certificate of {tls.name} may not ask for its {topic}" if tls else ""
    raise UserError(f"no edge runtime with vehicle id {vehicle_id} is connected to {connect}{hint}")


# Delay, jitter and loss of the link, each way: shown and logged, never a reason to stop.
#
# Each state says when it left, how many commands the simulator has heard, which one last and when.
# With the edge's own stamps this makes NTP's four timestamps (RFC 5905, section 8):
#
#     up   = arrived_ns - sent_ns       = delay + offset      of a state
#     down = heard_ns - heard_sent_ns   = delay - offset      of a command
#
# `offset` is the edge's clock less the simulator's. No delay is negative, so it lies between
# -min(down) and min(up); its middle is wrong by at most half the least round trip (section 10).

# Windows in messages: 300 follow a change of the delay in 30 s at 10 Hz; a loss of 5 % needs 1,200
# to be measured to half a percentage point.
TIMES, MESSAGES = 300, 1200
KNOWN = 50  # Messages needed each way before anything is reported
FLOOR = 0.05  # The quantile taken as the floor of the times: the minimum alone is luck
FIELDS = ("up_ms", "down_ms", "error_ms", "up_jitter_ms", "down_jitter_ms",
          "up_lost_percent", "down_lost_percent")  # fmt: skip
MOST_PERIODS, MOST_LOST_PERCENT = 2.0, 5.0  # A link is poor above this delay or loss in either way
GOOD_AGAIN = 0.8  # A poor link is good again below this share of both limits


class _Way:
    """One way of the link; its messages are numbered in sending order."""

    def __init__(self) -> None:
        self.times_ms: Deque[float] = deque(maxlen=TIMES)
        self.counts: Deque[Tuple[int, int]] = deque(maxlen=MESSAGES)
        """After each arrival: messages sent up to the newest, messages that came."""
        self.sent = self.came = 0
        self.newest = -1

    def note(self, number: int, came: int = 1) -> None:
        self.sent += number - self.newest
        self.came += came
        self.newest = number
        self.counts.append((self.sent, self.came))

    def lost_percent(self) -> float:
        (sent, came), (all_sent, all_came) = self.counts[0], self.counts[-1]
        return 100.0 * max(1.0 - (all_came - came) / max(all_sent - sent, 1), 0.0)


class LinkQuality:
    def __init__(self) -> None:
        self._begin("")

    def _begin(self, session: str) -> None:
        self._session = session
        self.up, self.down = _Way(), _Way()
        self._episode = -1
        self._sent: Dict[int, Tuple[int, int]] = {}  # a command's number and episode by its stamp
        self._commands = self._heard = self._heard_ns = 0
        self._answered = -1  # the episode of the command that was heard last

    def note_command(self, episode: int, sent_ns: int) -> None:
        self._commands += 1
        self._sent[sent_ns] = (self._commands, episode)
        if len(self._sent) > TIMES:
            del self._sent[next(iter(self._sent))]

    def note_state(self, state: State, arrived_ns: int) -> None:
        is_first = state.session != self._session
        if is_first:  # another simulator: another clock, another network
            self._begin(state.session)
        if state.episode != self._episode:  # states under way at the end of an episode are no loss
            self._episode = state.episode
            self.up.newest = state.step - 1 if is_first else -1
        if state.final:  # the simulator sends it past the network that it injects
            return
        self.up.note(state.step)
        self.up.times_ms.append((arrived_ns - state.sent_ns) * 1e-6)
        self._note_heard(state.heard, state.heard_sent_ns, state.heard_ns)

    def _note_heard(self, heard: Any, sent_ns: Any, heard_ns: Any) -> None:
        number, episode = self._sent.get(sent_ns, (0, -1))
        if not number or msgspec.UNSET in (heard, heard_ns) or heard_ns == self._heard_ns:
            return
        came, self._heard, self._heard_ns = heard - self._heard, heard, heard_ns
        if episode != self._answered:  # commands under way at the end of an episode are no loss
            self._answered, self.down.newest = episode, number
        elif came > 0:
            self.down.note(number, came)
        self.down.times_ms.append((heard_ns - sent_ns) * 1e-6)

    def measured(self) -> Dict[str, float]:
        """Return FIELDS: mean delays, the error of both, deviations, losses; empty if not known."""
        ways = self.up, self.down
        if min(len(each) for way in ways for each in (way.times_ms, way.counts)) < KNOWN:
            return {}
        up, down = (np.sort(way.times_ms) for way in ways)
        floors_ms = [times[int(FLOOR * len(times))] for times in (up, down)]
        offset_ms = min(max((floors_ms[0] - floors_ms[1]) / 2.0, -down[0]), up[0])
        error_ms = max(up[0] - offset_ms, down[0] + offset_ms)
        delays_ms = up.mean() - offset_ms, down.mean() + offset_ms
        times_ms = map(float, (*delays_ms, error_ms, up.std(), down.std()))
        return dict(zip(FIELDS, (*times_ms, *(way.lost_percent() for way in ways))))


def is_poor(link: Mapping[str, float], control_period_s: float, was_poor: bool = False) -> bool:
    """Return whether a way has a mean delay over 2 T or loses over 5 %; if unknown, `was_poor`."""
    if not link:
        return was_poor
    late = max(link["up_ms"], link["down_ms"]) / (MOST_PERIODS * control_period_s * 1e3)
    lost = max(link["up_lost_percent"], link["down_lost_percent"]) / MOST_LOST_PERCENT
    return max(late, lost) > (GOOD_AGAIN if was_poor else 1.0)


def link_rows(link: Mapping[str, float]) -> Dict[str, str]:
    """Render each way for a person; with the fields of another version as not known."""
    if not link.keys() >= set(FIELDS):
        return {"link": "not known yet"}
    return {
        f"link {way}": f"{link[f'{way}_ms']:.1f}+-{link['error_ms']:.1f} ms,"
        f" jitter {link[f'{way}_jitter_ms']:.1f}, {link[f'{way}_lost_percent']:.1f}% lost"
        for way in ("up", "down")
    }


def link_words(link: Mapping[str, float]) -> str:
    return "; ".join(f"{way} {words}" for way, words in link_rows(link).items())
