"""``python -m hil_tests obey``: does the edge runtime know its link, and stop in time?

Real processes behind known networks give the estimate; virtual time the rest, by the drives' own
network (`bridge/virtual_link.py`) and the runtime's own judge (`edge_runtime/link_quality.py`),
whose clock is 3 s ahead: hours inside the envelope (false stops), networks outside it (arming), and
drives whose network gets slowly worse until the runtime stops or the policy fails.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bridge.network import LatencySpec, parse_spec
from bridge.policy_file import make_policy
from bridge.report import GOAL
from bridge.virtual_link import Decision, VirtualLink
from edge_runtime.cli import ArgumentParser, examples, positive
from edge_runtime.commands import ask
from edge_runtime.files import check_writable, write_json_out
from edge_runtime.link_quality import LinkQuality
from edge_runtime.manifest import Manifest, Task
from edge_runtime.policy import load_policy, policy_id_of
from edge_runtime.reach import free_endpoint
from edge_runtime.util import UserError, read_bytes, read_json
from edge_runtime.wire import DRIVE, Command, State
from hil_tests.envelope import network
from hil_tests.processes import POLICY, PUBLIC_KEY, Process, in_parallel, trusting
from trainer.environments import make_environment

KNOWN = ("none", "50ms+-10ms", "delay=100ms,jitter=20ms,loss=2%", "delay=20ms,loss=5%",
         "up.delay=30ms,down.delay=90ms", "delay=50ms,loss=5%,burst=3")  # fmt: skip
"""Networks whose delay and loss the runtime is to tell."""
EXAMPLE = examples("python -m hil_tests obey --envelope runs/left_turn.json --out runs/obey.json")
AHEAD_NS = 3_000_000_000
OUTSIDE, INSIDE = (1.3, 1.6), (0.5, 0.7)  # Parts of a limit, or of what the axes may add up to
EPISODE = 200  # Steps
ZERO = np.zeros(1, np.float32)
FROM, PER_MIN = 0.5, 0.15  # Where a drive that gets worse begins, and how fast: parts of a limit


def network_at(limits: Mapping[str, float], parts: Mapping[str, float]) -> LatencySpec:
    """The network at these parts of the limits."""
    return network({name: part * limits[name] for name, part in parts.items()})


class Loop:
    """Simulator, network and edge runtime in virtual time, drive by drive; what its judge sees."""

    def __init__(self, manifest: Manifest) -> None:
        self.quality, self.period_s = LinkQuality(manifest), manifest.control_period_s
        self.now_s, self._begun_s, self._episode, self._step = 0.0, 0.0, -1, 0
        self._heard = {"heard": 0}

    def begin(self, spec: LatencySpec, seed: int) -> None:
        """The episode before ends, and one begins; the seed decides the network's luck."""
        if self._episode >= 0:
            self._note_state(self._state(final=True))
        self._begun_s, self._step, self._episode = self.now_s + 1.0, 0, self._episode + 1
        self._link: VirtualLink[Any] = VirtualLink(
            spec, seed, self.period_s, 7200, self._admitted, self._came
        )

    def tick(self, seen: Any = None, act: Callable[[Any], Any] = lambda seen: ZERO) -> Decision:
        """One control period: the policy answers what it sees, and the vehicle decides."""
        self._link.send_state(self._step, (self._state(), seen))
        self._step += 1
        while arrival := self._link.next_at_edge():
            state, seen = arrival.message
            edge_ns = self._note_state(state, arrival.arrived_s)
            if not arrival.overtaken:
                command = Command(
                    session="", episode=self._episode, step=arrival.step, mode=DRIVE,
                    action=act(seen).tolist(), policy_id="", received_ns=edge_ns, inference_ns=0,
                    sent_ns=edge_ns,
                )  # fmt: skip
                self._link.answer(arrival, command)
                self.quality.note_command(self._episode, edge_ns)
                self.quality.judge()
        return self._link.decide()

    def _state(self, final: bool = False) -> State:
        self.now_s = self._begun_s + self._step * self.period_s
        heard: Any = self._heard if self._heard["heard"] else {}
        return State(
            session="virtual", episode=self._episode, step=self._step, sim_time_s=0.0, final=final,
            sent_ns=round(self.now_s * 1e9), observation={}, speed_mps=None, **heard,
        )  # fmt: skip

    def _note_state(self, state: State, arrived_s: float = 0.0) -> int:
        edge_ns = round((self._begun_s + arrived_s) * 1e9) + AHEAD_NS
        self.quality.note_state(state, edge_ns)
        return edge_ns

    def _came(self) -> None:
        self._heard["heard"] += 1

    def _admitted(self, latency_s: float) -> None:
        command = self._link.hold.newest
        assert command is not None
        self._came()
        heard_s = self._begun_s + command.step * self.period_s + latency_s
        self._heard |= {"heard_sent_ns": command.sent_ns, "heard_ns": round(heard_s * 1e9)}


def stand(manifest: Manifest, spec: LatencySpec, seconds: float, seed: int) -> dict[str, Any]:
    """How often the judge stops on a network that stays, and in which share of it would arm."""
    loop, was, found = Loop(manifest), "", {"seconds": seconds, "stops": 0, "armable": 0}
    for step in range(round(seconds / manifest.control_period_s)):
        if step % EPISODE == 0:
            loop.begin(spec, seed + step)
        loop.tick()
        found["stops"] += bool(loop.quality.outside and not was)
        found["armable"] += step % 10 == 0 and not loop.quality.refusal()
        was = loop.quality.outside
    return {"network": str(spec), **found, "values": loop.quality.health()["link"]}


def worsen(policy_path: str, manifest: Manifest, axis: str, seed: int) -> dict[str, Any]:
    """Drive while one axis gets worse, until the judge stops or a drive fails that needs no network
    to succeed. ``part`` of the limit is where that was.
    """
    policy = load_policy(policy_path, allow_unsigned=True)
    env, loop = make_environment(manifest.task), Loop(manifest)
    limits, passed, press = loop.quality.limits, 0, getattr(env, "press_brake", None)

    def act(seen: Any) -> Any:
        return policy.act({next(iter(manifest.observation)): seen})

    def drive(spec: LatencySpec, seed: int, judged: bool) -> str:
        seen, _ = env.reset(seed=seed)
        if judged:
            loop.begin(spec, seed)
        while True:
            decision = loop.tick(seen, act) if judged else None
            if judged and loop.quality.outside:
                return "stopped"
            brakes = decision is not None and bool(decision.brake_reason)
            if press is not None:
                press(brakes)
            action = env.brake_action if brakes else np.zeros(env.action_space.shape, np.float32)
            if decision is None:
                action = act(seen)
            elif decision.command is not None and not brakes:
                action = np.array(decision.command.action, np.float32)
            seen, _, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                return str(info["outcome"])

    for episode in range(seed * 1000, seed * 1000 + 1000):
        part = FROM + PER_MIN * loop.now_s / 60.0
        outcome = drive(network_at(limits, {axis: part}), episode, True)
        passed += outcome == GOAL
        failed = outcome not in (GOAL, "stopped")
        if outcome == "stopped" or (failed and drive(LatencySpec(), episode, False) == GOAL):
            break
    return {"axis": axis, "seed": seed, "part": round(part, 3), "end": outcome, "drives": passed}


def estimate(policy: Path, spec: str, seconds: float, env: str) -> dict[str, Any]:
    """What the runtime's status says of a known network, after real processes drove behind it."""
    endpoint, want = free_endpoint(), parse_spec(spec)
    link: dict[str, float] = {}
    where = ("--vehicle-id", "obey")
    edge = ("edge_runtime", "run", *trusting(policy, None), "--connect", endpoint, *where)
    simulator = ("bridge", "simulate", "--env", env, "--clock", "realtime", "--episodes", "1000",
                 "--latency", spec, "--listen", endpoint, *where)  # fmt: skip
    with Process(*edge, ready="ready"), Process(*simulator):
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            time.sleep(2.0)
            with contextlib.suppress(UserError):
                link = ask(endpoint, "obey", "status")["link"] or link
    losses = [way.loss_percent for way in (want.up, want.down)]
    return {
        "network": spec, **link,
        "up_off_ms": link["up_ms"] - want.up.delay_ms,
        "down_off_ms": link["down_ms"] - want.down.delay_ms,
        "loss_off_points": link["lost_percent"] - math.hypot(*losses) / math.sqrt(2.0),
    }  # fmt: skip


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--policy", default=str(POLICY), help="policy file")
    parser.add_argument("--envelope", required=True, metavar="F.json", help="of hil_tests envelope")
    for name, default, text in (
        ("--drives", 100, "in which the network gets worse"),
        ("--minutes", 60, "on each network inside"),
        ("--seconds", 150, "behind each known network, with real processes"),
        ("--jobs", 2, "processes"),
    ):
        parser.add_argument(name, type=positive, default=default, help=text)
    what = "real processes behind known networks, or the rest"
    parser.add_argument("--only", choices=("known", "virtual"), default="virtual", help=what)
    parser.add_argument("--out", metavar="R.json", help="write the report to this file")


def run(arguments: argparse.Namespace) -> int:
    """Measure, and write the JSON."""
    check_writable(arguments.out)
    loaded = load_policy(arguments.policy, PUBLIC_KEY, allow_unsigned=True)
    envelope = read_json(arguments.envelope, "envelope")
    manifest: Any = msgspec.structs.replace(loaded.manifest, envelope=envelope)
    limits = LinkQuality(manifest).limits
    measure = partial(_known, loaded.manifest) if arguments.only == "known" else _virtual
    found = measure(arguments, manifest, limits)
    report = {"policy": arguments.policy, "envelope": envelope, **found}
    write_json_out(arguments.out, report)
    print("\n".join(f"{name}: {value}" for name, value in report["summary"].items()))
    return 0


def _virtual(asked: argparse.Namespace, manifest: Any, limits: dict[str, float]) -> dict[str, Any]:
    axes = [name for name, limit in limits.items() if limit]

    def networks(parts: Sequence[float]) -> list[LatencySpec]:
        each = {axis: manifest.envelope["joint"] / len(axes) for axis in axes}
        of_part = [[*({axis: 1.0} for axis in axes), each] for _ in parts]
        return [
            network_at(limits, {name: part * share for name, share in row.items()})
            for part, rows in zip(parts, of_part, strict=True)
            for row in rows
        ]

    with ProcessPoolExecutor(asked.jobs, get_context("spawn")) as pool:
        rows = {
            name: [pool.submit(stand, manifest, spec, seconds, 0) for spec in networks(parts)]
            for name, parts, seconds in (("inside", INSIDE, 60.0 * asked.minutes),
                                         ("outside", OUTSIDE, 900.0))
        }  # fmt: skip
        rows["worse"] = [
            pool.submit(worsen, asked.policy, manifest, axes[seed % len(axes)], seed)
            for seed in range(asked.drives)
        ]
        found = {name: [future.result() for future in futures] for name, futures in rows.items()}
    stopped = sum(row["end"] == "stopped" for row in found["worse"])
    summary = {
        "false_stops": sum(row["stops"] for row in found["inside"]),
        "hours_inside": sum(row["seconds"] for row in found["inside"]) / 3600.0,
        "armed_outside": sum(row["armable"] for row in found["outside"]),
        "stopped_before_a_failure": f"{stopped} of {asked.drives}",
    }
    return {**found, "summary": summary}


def _known(
    own: Manifest, asked: argparse.Namespace, manifest: Any, limits: dict[str, float]
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        policy, data = Path(folder) / "policy.onnx", read_bytes(asked.policy, "policy file")
        wide = {"limits": dict.fromkeys(limits, 1e6), "joint": 1e6, "policy_id": policy_id_of(data)}
        task = msgspec.convert(msgspec.to_builtins(own), Task)
        policy.write_bytes(make_policy(data, task, "obey", {}, {**manifest.envelope, **wide}))
        work = partial(estimate, policy, seconds=asked.seconds, env=own.task)
        in_parallel(work, KNOWN, asked.jobs, found.__setitem__)
    rows = list(found.values())
    off = {"delay_off_ms": [row["delay_ms"] - mean_ms(row["network"]) for row in rows],
           "loss_off_points": [row["loss_off_points"] for row in rows]}  # fmt: skip
    return {"known": rows, "summary": {name: max(map(abs, off[name])) for name in off}}


def mean_ms(spec: str) -> float:
    """The mean delay of one way, of both."""
    known = parse_spec(spec)
    return (known.up.delay_ms + known.down.delay_ms) / 2.0
