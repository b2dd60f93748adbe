"""The relay between real processes, and its traffic without a network."""

from __future__ import annotations

import json
import time

from bridge.network import parse_spec
from bridge.relay import DOWN, RelayTraffic
from bridge.tests.harness import (
    SHORT_TOY,
    BridgeProcess,
    make_command,
    make_policy,
    read,
    simulate,
    start_edge,
)
from edge_runtime.commands import ask
from edge_runtime.tests.harness import make_state, wait_until
from edge_runtime.transport import free_endpoint
from edge_runtime.wire import encode

SPEC = "40ms+-5ms,loss=10%,duplicate=10%"


class Rig:
    """A relay's traffic whose deliveries are kept with their time."""

    def __init__(self, spec: str) -> None:
        self.came: list[tuple[str, bytes, float]] = []
        deliver = {name: self._keeper(name) for name in ("state", *DOWN)}
        self.traffic = RelayTraffic(parse_spec(spec), 0, deliver)

    def _keeper(self, name):
        return lambda payload: self.came.append((name, payload, time.monotonic()))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.traffic.close()


def test_every_topic_is_held_back_and_nothing_is_changed():
    state, command = encode(make_state(0)), encode(make_command(0))
    with Rig("up.delay=30ms,down.delay=60ms") as rig:
        began_s = time.monotonic()
        rig.traffic.take("command", command)
        rig.traffic.take("health", b"anything")
        rig.traffic.take("state", state)
        wait_until(lambda: len(rig.came) == 3, "all messages")
    assert [(name, payload) for name, payload, _ in rig.came] == [
        ("state", state), ("command", command), ("health", b"anything"),
    ]  # fmt: skip
    assert rig.came[0][2] - began_s >= 0.03
    assert rig.came[1][2] - began_s >= 0.06


def test_the_final_state_passes_a_dead_link_and_what_was_before_it_is_forgotten():
    with Rig("up.delay=50ms") as rig:
        rig.traffic.take("state", encode(make_state(0)))
        rig.traffic.take("state", final := encode(make_state(1, final=True)))
        time.sleep(0.1)
    assert [payload for _, payload, _ in rig.came] == [final]
    assert rig.traffic.report()["timer_lag_ms"]["max"] == 0.0  # No timer has run.


def test_outages_begin_to_count_with_the_first_state():
    with Rig("outage=10s@0.05s") as rig:
        for number in range(2):  # Before the first state time stands at 0.
            time.sleep(0.06)
            rig.traffic.take("health", b"%d" % number)
        rig.traffic.take("state", encode(make_state(0)))
        time.sleep(0.06)
        rig.traffic.take("state", encode(make_state(1)))
        rig.traffic.take("health", b"2")
        wait_until(lambda: len(rig.came) == 3, "what was sent before the outage")
    topics = rig.traffic.report()["topics"]
    assert (topics["state"]["delivered"], topics["state"]["lost"]) == (1, 1)
    assert (topics["health"]["delivered"], topics["health"]["lost"]) == (2, 1)


def test_two_unmodified_ends_drive_through_a_relay(tmp_path):
    policy, out = make_policy(tmp_path), tmp_path / "relay.json"
    simulator, listen = free_endpoint(), free_endpoint()
    link = ("relay", "--listen", listen, "--connect", simulator, "--latency", SPEC)
    with BridgeProcess(*link, "--seed", "9", "--out", str(out)) as relay:
        assert relay.process.stdout is not None
        ready = relay.process.stdout.readline()
        assert ready.startswith("ready vehicle_id=hunter01")
        with start_edge(listen, policy):
            options = ["--clock", "realtime", "--episodes", "1"]
            report = simulate(tmp_path, simulator, SHORT_TOY, options)
            assert ask(listen, "hunter01", "status")["accepted"] > 10
        relay.process.terminate()
        assert relay.wait() == 0, relay.errors
    counts = read(out)
    states, commands = counts["topics"]["state"], counts["topics"]["command"]
    assert report["latency_ms"]["p50"] > 75
    assert report["latency_spec"] == "none"
    assert states["lost"] > 0
    assert states["duplicated"] > 0
    assert commands["received"] > 10
    assert counts["topics"]["health"]["delivered"] > 0
    assert report["rejected_by_edge"].get("duplicate", 0) > 0
    assert counts["queries"]["status"] >= 2  # The simulator's, before and after the drive.
    assert counts["latency_spec"] == "delay=40ms,jitter=5ms,loss=10%,duplicate=10%"
    assert "delivered: state" in relay.output
    json.dumps(counts, allow_nan=False)
