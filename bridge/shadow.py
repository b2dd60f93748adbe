"""``python -m bridge shadow``: a policy beside the one that drives; it answers and moves nothing.

It hears the states that the driving runtime gets, on the wire or from a recording, and decides as
the edge runtime would. Its answers go into the view, the recording and the report only: this module
opens a listener, which has no way to publish.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, takewhile
from operator import itemgetter
from typing import Any

import msgspec
import numpy as np

from bridge.environments import say_once
from bridge.messages import SHADOW, Heard, Place, place_of
from bridge.ports import NOT_WRITTEN, add_options, open_source
from bridge.recording import growing_recording, new_recording
from bridge.rerun import add_view, check_view
from edge_runtime import wire
from edge_runtime.cli import ArgumentParser, examples, quit_on_signals, sigterm_as_interrupt
from edge_runtime.config import Config, add_trust, load_config
from edge_runtime.controller import Controller, ControllerConfig, Order, Received, shared_limits
from edge_runtime.files import write_json_out
from edge_runtime.latest import LatestState
from edge_runtime.policy import Policy, load_policy
from edge_runtime.util import UserError, counted, printable
from edge_runtime.vehicles import vehicle_limits
from edge_runtime.wire import DEFAULT_VEHICLE_ID, DRIVE, SAFE_STOP, Command, Rejection, State

MOST_WAITING = 1000  # Answers that wait for the driving policy's; a command may come late, or never
NICE = 10  # Whatever drives on this machine comes first
WORST = 10  # Seconds of the drive that the report tells one by one
EXAMPLE = examples(
    "python -m bridge shadow --policy next.onnx --serve --out runs/shadow.json",
    "python -m bridge shadow --policy next.onnx --from drive.mcap --out runs/shadow.json",
)


def add_arguments(parser: ArgumentParser) -> None:
    add, source = parser.add_argument, parser.add_mutually_exclusive_group()
    add("--policy", metavar="B.onnx", type="path", required=True, help="the policy in the shadow")
    add_trust(parser)
    add_options(source, "--connect")
    text = "take the states of this recording of bridge record, instead of listening"
    source.add_argument("--from", dest="recording", metavar="F.mcap", help=text)
    add_options(parser, "--tls", "--wait-s")
    text = f"the vehicle (default: {DEFAULT_VEHICLE_ID}; of a recording: the only one)"
    add_options(parser, "--vehicle-id", default=None, help=text)
    text = "settings of the driving edge runtime, for the limits of its vehicle"
    add("--config", metavar="FILE.toml", help=text)
    add_view(parser)
    text = "record the drive and the shadow's answers, as `bridge record` does"
    add("--record", metavar="G.mcap", type=new_recording, help=text)
    add_options(parser, "--out")


def run(arguments: Any) -> int:
    """Run the command until the simulator goes, the recording ends, or somebody interrupts."""
    policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
    config = load_config(arguments.config, {"policy": arguments.policy}, opens_link=False)
    shadow, writer = Shadow(policy, config), None
    os.nice(NICE)
    is_shown = arguments.sink or arguments.port or arguments.foxglove
    sink = check_view(arguments) if is_shown else None
    with (
        sigterm_as_interrupt(),
        open_source(arguments) as all_heard,
        contextlib.ExitStack() as stack,
    ):
        outputs = []
        if sink is not None:
            from bridge.rerun import draw  # It loads rerun, which takes a second.

            outputs.append(stack.enter_context(draw.open_view(arguments, sink)))
        stop = threading.Event()

        def ask_to_stop() -> bool:
            stop.set()
            return True

        # A signal is an ordinary end: it must not cut a recorded message in two.
        with quit_on_signals(ask_to_stop), contextlib.ExitStack() as files:
            if arguments.record:
                writer = files.enter_context(growing_recording(arguments.record))
                outputs.append(writer.write)
            for heard in shadow.stream(takewhile(lambda _: not stop.is_set(), all_heard)):
                for put in outputs:
                    put(heard)
        write_json_out(arguments.out, report := shadow.report())
        print(printable(_summary(report)), flush=True)
        if sink is not None and not stop.is_set():
            with contextlib.suppress(KeyboardInterrupt):
                draw.keep_page(arguments)
    return NOT_WRITTEN if writer and writer.is_cut else 0


class Shadow:
    """Answers the states that a driving runtime gets, and compares its actions with that one's.

    The controller is the edge runtime's, without a vehicle; its limits are those of ``config``'s.
    """

    def __init__(self, policy: Policy, config: Config) -> None:
        self._policy, self._layout, manifest = policy, policy.layout, policy.manifest
        vehicle = vehicle_limits(config.vehicle, config.vehicle_settings, manifest)
        limits = shared_limits(manifest.action, vehicle)
        ride_s, self._period_s = config.ride_through.max_s, manifest.control_period_s
        task = self._layout.task_text
        self._controller = Controller(
            ControllerConfig(limits, self._period_s, task=task, ride_s=ride_s)
        )
        self._latest = LatestState(self._period_s)
        self._last_rejection = "no state came"
        self._thread: threading.Thread | None = None  # Of the newest inference
        self._inferences_ns: list[int] = []
        self._answered = 0
        self._would_stop = Counter[str]()
        self._waiting: dict[Place, Order] = {}
        self._driving_policy_id: str | None = None
        self._differences: list[list[float]] = []  # By state, of each action
        self._seconds: dict[Place, tuple[float, dict[str, Any]]] = {}
        """Session, episode and second -> the largest difference in it, and what differed."""

    def stream(self, all_heard: Iterable[Heard | None]) -> Iterator[Heard]:
        """Yield all messages and, behind each state, this policy's answer as a message of its own.

        A state waits for what comes next, mostly its command: until then the machine is the driving
        runtime's. UserError where the first state is of another task, or there was none.
        """
        held: list[Heard] = []  # From a state on
        for heard in chain(all_heard, [None]):
            if heard is None or heard.topic in ("state", "command"):
                for each in held:
                    yield each
                    if each.topic == "state":
                        yield from self._judge(each)
                held = []
            if heard is None or heard.topic == SHADOW:  # Of another shadow, in a recording
                continue
            if heard.topic == "command":
                self._compare(wire.decode_command(heard.payload))
            if held or heard.topic == "state":
                held.append(heard)
            else:
                yield heard
        if not self._latest.accepted:
            raise UserError(f"there was no state to answer: {self._last_rejection}")

    def _judge(self, heard: Heard) -> Iterator[Heard]:
        """Answer a state that the runtime would take."""
        state, arrived_ns = self._layout.decode(heard.payload), heard.arrived_ns
        if isinstance(state, State):
            rejected = self._latest.offer(state, arrived_ns * 1e-9)
            if rejected is None:
                order = self._answer(state, arrived_ns)
                if order is not None:
                    command = order.command(self._policy.policy_id, arrived_ns)
                    payload, key = wire.encode(command), f"phil/{heard.vehicle_id}/{SHADOW}"
                    yield Heard(key, SHADOW, payload, arrived_ns, len(payload))
                return
            state = rejected
        self._last_rejection = state.detail

    def _answer(self, state: State, arrived_ns: int) -> Order | None:
        arrived_s, output, took_ns = arrived_ns * 1e-9, None, 0
        # Round trips are by the clock of the driving runtime, which is not this one.
        state = msgspec.structs.replace(state, heard_sent_ns=msgspec.UNSET)
        self._controller.begin(Received(state, arrived_s, arrived_ns), arrived_s)
        if not wire.is_foreign(state, self._layout.task_text):
            output, took_ns = self._infer(state)
        elif self._latest.accepted == 1:
            raise UserError(f"the policy is for {self._layout.task_text!r}, not {state.task!r}")
        self._answered += output is not None and took_ns <= self._period_s * 1e9
        order = self._controller.finish(output, took_ns, arrived_s + took_ns * 1e-9)
        if order is not None:
            if order.mode == SAFE_STOP:
                self._would_stop[order.reason] += 1
            self._waiting[place_of(state)] = order
            if len(self._waiting) > MOST_WAITING:
                del self._waiting[next(iter(self._waiting))]
        return order

    def _infer(self, state: State) -> tuple[np.ndarray | None, int]:
        """Return the network's action, or None, and how long it took, ns.

        More than T stands for longer. A network that hangs is asked again when it has ended.
        """
        seen, found = self._layout.arrays(state.observation), []

        def infer() -> None:
            begun_ns, action = time.perf_counter_ns(), None
            try:
                action = self._policy.act(seen)
            except Exception as error:  # onnxruntime's exceptions share no narrower base
                say_once(f"the policy does not answer: {error}")
            self._inferences_ns.append(time.perf_counter_ns() - begun_ns)
            found.append((action, self._inferences_ns[-1]))

        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=infer, daemon=True)
            self._thread.start()
            self._thread.join(self._period_s)
        return found[0] if found else (None, round(2e9 * self._period_s))

    def _compare(self, command: Command | Rejection) -> None:
        if isinstance(command, Rejection):
            return
        self._driving_policy_id = command.policy_id
        if command.mode != DRIVE or (order := self._waiting.pop(place_of(command), None)) is None:
            return
        if order.mode != DRIVE or len(order.action) != len(command.action):
            return
        pairs = zip(order.action, command.action, strict=True)
        self._differences.append(apart := [abs(ours - theirs) for ours, theirs in pairs])
        state = order.answers.state
        at = {"session": state.session, "episode": state.episode, "step": state.step}
        told = {**at, "time_s": state.sim_time_s, "driving": command.action, "shadow": order.action}
        second = (state.session, state.episode, int(state.sim_time_s))
        if max(apart) > self._seconds.get(second, (0.0, {}))[0]:
            self._seconds[second] = max(apart), told

    def report(self) -> dict[str, Any]:
        """Return the report: no numbers are null."""
        names = [row.name for row in self._policy.manifest.action]
        apart = zip(*self._differences, strict=True) if self._differences else [()] * len(names)
        of_each = dict(zip(names, apart, strict=True))
        worst = heapq.nlargest(WORST, self._seconds.values(), key=itemgetter(0))
        return {
            "policy_id": self._policy.policy_id,
            "driving_policy_id": self._driving_policy_id,
            "states": self._latest.accepted,
            "answered": self._answered,
            "compared": len(self._differences),
            "disagreement": {
                name: {
                    "mean": float(np.mean(values)) if values else None,
                    **_quantiles(values, p95=95, max=100),
                }
                for name, values in of_each.items()
            },
            "would_stop": dict(self._would_stop),
            "inference_ms": _quantiles([ns * 1e-6 for ns in self._inferences_ns], p50=50, p99=99),
            "worst_seconds": [told for _, told in worst],
        }


def _quantiles(values: Sequence[float], **percents: float) -> dict[str, float | None]:
    """Return percentiles by name; None where there are no values."""
    return {n: float(np.percentile(values, p)) if values else None for n, p in percents.items()}


def _summary(report: dict[str, Any]) -> str:
    answered = f"{report['answered']} of {counted(report['states'], 'state')} answered"
    apart = "; ".join(
        f"{name} differs by {row['mean']:.3g} on average, {row['max']:.3g} at most"
        for name, row in report["disagreement"].items()
        if row["max"] is not None
    )
    stops = ", ".join(f"{count} {reason}" for reason, count in report["would_stop"].items())
    p50_ms, p99_ms = report["inference_ms"].values()
    took = f"inference {p50_ms:.2f} ms, p99 {p99_ms:.2f} ms" if p50_ms is not None else ""
    parts = answered, apart or "nothing to compare", f"would stop: {stops or 'never'}", took
    return "; ".join(filter(None, parts))
