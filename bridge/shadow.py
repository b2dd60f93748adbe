"""``python -m bridge shadow``: run a second policy beside the driving one, moving nothing.

It decides as the edge runtime would, on the states of the wire or of a recording. Its answers go
into view, recording and report only: a listener cannot publish.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from itertools import chain, takewhile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bridge.environments import say_once
from bridge.messages import SHADOW, Heard
from bridge.ports import add_options, add_view, open_source
from bridge.recording import new_recording, whole_recording
from bridge.replay import Key, key_of
from bridge.report import percentiles
from edge_runtime import cli, wire
from edge_runtime.config import Config, add_trust, load_config
from edge_runtime.controller import Controller, ControllerConfig, Order, Received, shared_limits
from edge_runtime.files import write_json_out
from edge_runtime.latest import LatestState
from edge_runtime.policy import Policy, load_policy
from edge_runtime.util import UserError
from edge_runtime.vehicles import vehicle_limits
from edge_runtime.wire import DRIVE, SAFE_STOP, Command, Rejection, State

MOST_WAITING = 100  # Answers that wait for the driving policy's, which may come late, or never
NICE = 10  # A driving process on this machine has precedence
OOM_SCORE = Path("/proc/self/oom_score_adj")
EXAMPLE = cli.examples(
    "python -m bridge shadow --policy next.onnx --serve --out runs/shadow.json",
    "python -m bridge shadow --policy next.onnx --from drive.mcap --out runs/shadow.json",
)


def add_arguments(parser: cli.ArgumentParser) -> None:
    add = parser.add_argument
    add("--policy", metavar="B.onnx", type="path", required=True, help="the policy in the shadow")
    add_trust(parser)
    text = "take the states of this recording of bridge record, instead of listening"
    add("--from", dest="recording", metavar="F.mcap", help=text)
    add_view(parser)
    text = "settings of the driving edge runtime, for the limits of its vehicle"
    add("--config", metavar="FILE.toml", help=text)
    text = "record the drive and the shadow's answers, as `bridge record` does"
    add("--record", metavar="G.mcap", type=new_recording, help=text)
    add_options(parser, "--out")


def run(arguments: Any) -> int:
    """Run the command until the simulator goes, the recording ends, or somebody interrupts."""
    policy = load_policy(arguments.policy, arguments.public_key, arguments.allow_unsigned)
    config = load_config(arguments.config, {"policy": arguments.policy}, opens_link=False)
    shadow, stop = Shadow(policy, config), threading.Event()
    OOM_SCORE.write_text("1000")  # When memory runs out, the kernel kills this process first

    def messages(all_heard: Iterator[Heard | None]) -> Iterator[Heard]:
        """Yield and record the drive with the shadow's answers; then print the report."""
        until_stop = takewhile(lambda _: not stop.is_set(), all_heard)
        out = whole_recording(arguments.record) if arguments.record else nullcontext()
        # A signal is a usual end: it must not cut a recorded message in two.
        with cli.quit_on_signals(stop.set), out as writer:
            for heard in shadow.stream(until_stop):
                if writer is not None:
                    writer.write(heard)
                yield heard
        report = shadow.report()
        write_json_out(arguments.out, report)
        print(json.dumps(report, indent=2), flush=True)

    if arguments.sink or arguments.port or arguments.foxglove:
        from bridge.rerun import draw  # It loads rerun, which takes a second.

        return draw.run(arguments, messages)
    with cli.sigterm_as_interrupt(), open_source(arguments) as all_heard:
        deque(messages(all_heard), maxlen=0)
    return 0


class Shadow:
    """Answers the states of a driving runtime, and compares its own actions with the driving ones.

    The controller is the edge runtime's without a vehicle, but with the limits of ``config``'s.
    """

    def __init__(self, policy: Policy, config: Config) -> None:
        self._policy, manifest = policy, policy.manifest
        tables, bounds = config.vehicle_settings, config.bounds
        vehicle = vehicle_limits(config.vehicle, tables, manifest, bounds)
        limits, self._period_s = shared_limits(manifest.action, vehicle), manifest.control_period_s
        self._task, ride_s = policy.layout.task_text, config.ride_through.max_s
        settings = ControllerConfig(limits, self._period_s, task=self._task, ride_s=ride_s)
        self._controller, self._latest = Controller(settings), LatestState(self._period_s)
        self._rejected = "none came"  # Why the newest state was not taken
        self._thread: threading.Thread | None = None  # Of the newest inference
        self._inferences_ms: list[float] = []
        self._answered, self._would_stop = 0, Counter[str]()
        self._orders: dict[Key, Order] = {}  # Not yet compared with a command
        self._driving_policy_id: str | None = None
        self._compared: list[list[float]] = []  # For each state, the difference of each action

    def stream(self, all_heard: Iterable[Heard | None]) -> Iterator[Heard]:
        """Yield all messages and, behind each state, this policy's answer as a message of its own.

        A state waits for the next message, mostly its command, to leave the processor to the
        driving runtime until then. UserError if the first state is of another task, or none came.
        """
        held: list[Heard] = []  # The messages since a state
        for heard in chain(all_heard, [None]):
            if heard is None or heard.topic in ("state", "command"):
                for each in held:
                    yield each
                    if each.topic == "state":
                        yield from self._answer(each)
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
            raise UserError(f"there was no state to answer: {self._rejected}")

    def _answer(self, heard: Heard) -> Iterator[Heard]:
        """Answer a state that the runtime would accept, as if it arrived there just now."""
        state, arrived_s = self._policy.layout.decode(heard.payload), heard.arrived_ns * 1e-9
        if isinstance(state, State):
            state = self._latest.offer(state, arrived_s) or state
        if isinstance(state, Rejection):
            self._rejected = state.detail
            return
        foreign = wire.is_foreign(state, self._task)
        if foreign and self._latest.accepted == 1:
            raise UserError(f"the policy is for {self._task!r}, not {state.task!r}")
        # Round trips are measured by the driving runtime's clock, not by ours.
        state = msgspec.structs.replace(state, heard_sent_ns=msgspec.UNSET)
        self._controller.begin(Received(state, arrived_s, heard.arrived_ns), arrived_s)
        output, took_ns = (None, 0) if foreign else self._infer(state)
        self._answered += output is not None and took_ns <= self._period_s * 1e9
        order = self._controller.finish(output, took_ns, arrived_s + took_ns * 1e-9)
        if order is None:
            return
        self._would_stop.update([order.reason] * (order.mode == SAFE_STOP))
        self._orders[key_of(state)] = order
        if len(self._orders) > MOST_WAITING:
            del self._orders[next(iter(self._orders))]
        payload = wire.encode(order.command(self._policy.policy_id, heard.arrived_ns))
        key = f"phil/{heard.vehicle_id}/{SHADOW}"
        yield Heard(key, SHADOW, payload, heard.arrived_ns, len(payload))

    def _infer(self, state: State) -> tuple[np.ndarray | None, int]:
        """Return the network's action (None if it failed or took over T), and its duration, ns."""
        observation, results = self._policy.layout.arrays(state.observation), []

        def infer() -> None:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)  # This thread's
            begun_ns, action = time.perf_counter_ns(), None
            try:
                action = self._policy.act(observation)
            except Exception as error:  # onnxruntime's exceptions share no narrower base
                say_once(f"the policy does not answer: {error}")
            results.append((action, time.perf_counter_ns() - begun_ns))
            self._inferences_ms.append(results[0][1] * 1e-6)

        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=infer, daemon=True)
            self._thread.start()
            self._thread.join(self._period_s)
        return results[0] if results else (None, round(2e9 * self._period_s))

    def _compare(self, command: Command | Rejection) -> None:
        if isinstance(command, Rejection):
            return
        self._driving_policy_id = command.policy_id
        order = self._orders.pop(key_of(command), None) if command.mode == DRIVE else None
        if order and order.mode == DRIVE and len(order.action) == len(command.action):
            pairs = zip(order.action, command.action, strict=True)
            self._compared.append([abs(ours - theirs) for ours, theirs in pairs])

    def report(self) -> dict[str, Any]:
        """Return the report; a number without data is None."""
        names = [row.name for row in self._policy.manifest.action]
        rows: Any = np.array(self._compared).reshape(-1, len(names))
        disagreement = {}
        for name, values in zip(names, rows.T, strict=True):
            mean = float(values.mean()) if len(rows) else None
            disagreement[name] = {"mean": mean, **percentiles(values, p95=95, max=100)}
        return {
            "policy_id": self._policy.policy_id,
            "driving_policy_id": self._driving_policy_id,
            "states": self._latest.accepted,
            "answered": self._answered,
            "compared": len(rows),
            "disagreement": disagreement,
            "would_stop": dict(self._would_stop),
            "inference_ms": percentiles(self._inferences_ms, p50=50, p99=99),
        }
