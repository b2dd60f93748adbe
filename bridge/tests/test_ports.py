"""Both ends and the relay between them: what each hears, takes, and holds back."""

import contextlib
import json
import subprocess
import sys
import time
from functools import partial
from typing import Any

import pytest

from bridge.network import parse_spec
from bridge.ports import ANY_VEHICLE, SimulatorPort, open_listener
from bridge.relay import DOWN, RelayTraffic
from bridge.tests import harness
from edge_runtime.commands import ask
from edge_runtime.tests.harness import make_state, wait_until
from edge_runtime.transport import free_endpoint, open_session
from edge_runtime.wire import TOPICS, encode

HEARS_S = 0.3
WILD = ("phil/*/{}", "phil/**", "phil/v$*/{}", "*/v1/{}", "**/{}")


@pytest.fixture
def sessions():
    """The simulator's router, and somebody else's client."""
    endpoint = free_endpoint()
    with (
        contextlib.closing(open_session(listen=endpoint, mode="router")) as router,
        contextlib.closing(open_session(connect=endpoint, mode="client")) as client,
    ):
        yield endpoint, router, client


def put_wildly(session, topic):
    for pattern in WILD:
        session.put(pattern.format(topic), b"wild")
    session.put(f"phil/v1/{topic}", b"own")


def test_a_simulator_hears_its_own_commands_and_feedback_only(sessions):
    _, router, client = sessions
    port = SimulatorPort(router, "v1")
    heard: list[bytes] = []
    port.hear("command", heard.append)
    port.hear("feedback", heard.append)
    time.sleep(HEARS_S)
    for topic in ("command", "feedback", "health"):
        put_wildly(client, topic)
    time.sleep(HEARS_S)
    port.close()
    assert heard == [b"own"] * 2
    assert port.edge_counts.newest is None


@pytest.mark.parametrize("vehicle_id", ["v1", ANY_VEHICLE])
def test_a_listener_hears_what_was_put_to_one_vehicle(sessions, vehicle_id):
    endpoint, router, client = sessions
    port = SimulatorPort(router, "v1")
    topics = ("state", "command", "feedback", "health")
    with open_listener(endpoint, vehicle_id, 5.0) as feed:
        for topic in topics:
            put_wildly(client, topic)
        time.sleep(HEARS_S)
        heard = iter(lambda: feed.next(0.1), None)
        found = {(one.key, one.payload) for one in heard if one.topic in TOPICS}
    assert found == {(f"phil/v1/{topic}", b"own") for topic in topics}
    port.close()


_ANOTHER_THREAD_TAKES_IT = """
import signal, threading, time
from bridge.ports import wait_to_be_told
from edge_runtime.cli import sigterm_as_interrupt
with sigterm_as_interrupt():
    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        print("ready", flush=True)
        wait_to_be_told()
    except KeyboardInterrupt:
        print("told")
"""


def test_a_signal_that_another_thread_takes_ends_the_wait():
    command = ["timeout", "20", sys.executable, "-c", _ANOTHER_THREAD_TAKES_IT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.terminate()  # `timeout` passes it on.
        assert process.stdout.read() == "told\n"
    assert process.returncode == 0


class Rig:
    def __init__(self, spec: str) -> None:
        self.came: list[tuple[str, bytes, float]] = []
        deliver: Any = {name: partial(self._keep, name) for name in ("state", *DOWN)}
        self.traffic = RelayTraffic(parse_spec(spec), 0, deliver)
        self.take, self.close = self.traffic.take, self.traffic.close

    def _keep(self, name, payload):
        self.came.append((name, payload, time.monotonic()))


def test_every_topic_is_held_back_and_nothing_is_changed():
    state, command = encode(make_state(0)), encode(harness.make_command(0))
    with contextlib.closing(Rig("up.delay=30ms,down.delay=60ms")) as rig:
        began_s = time.monotonic()
        rig.take("command", command)
        rig.take("health", b"anything")
        rig.take("state", state)
        wait_until(lambda: len(rig.came) == 3, "all messages")
    assert [(name, payload) for name, payload, _ in rig.came] == [
        ("state", state), ("command", command), ("health", b"anything"),
    ]  # fmt: skip
    assert rig.came[0][2] - began_s >= 0.03
    assert rig.came[1][2] - began_s >= 0.06


def test_the_final_state_passes_a_dead_link_and_what_was_before_it_is_forgotten():
    with contextlib.closing(Rig("up.delay=50ms")) as rig:
        rig.take("state", encode(make_state(0)))
        rig.take("state", final := encode(make_state(1, final=True)))
        time.sleep(0.1)
    assert [payload for _, payload, _ in rig.came] == [final]
    assert rig.traffic.report()["timer_lag_ms"]["max"] == 0.0  # No timer has run.


def test_outages_begin_to_count_with_the_first_state():
    with contextlib.closing(Rig("outage=10s@0.05s")) as rig:
        for number in range(2):  # Before the first state time stands at 0.
            time.sleep(0.06)
            rig.take("health", b"%d" % number)
        rig.take("state", encode(make_state(0)))
        time.sleep(0.06)
        rig.take("state", encode(make_state(1)))
        rig.take("health", b"2")
        wait_until(lambda: len(rig.came) == 3, "what was sent before the outage")
    topics = rig.traffic.report()["topics"]
    for name, expected in (("state", (1, 1)), ("health", (2, 1))):
        assert (topics[name]["delivered"], topics[name]["lost"]) == expected


def test_two_unmodified_ends_drive_through_a_relay(tmp_path):
    policy, out = harness.make_policy(tmp_path), tmp_path / "relay.json"
    simulator, listen = free_endpoint(), free_endpoint()
    spec = "40ms+-5ms,loss=10%,duplicate=10%"
    link = ("relay", "--listen", listen, "--connect", simulator, "--latency", spec)
    with harness.BridgeProcess(*link, "--seed", "9", "--out", str(out)) as relay:
        assert relay.process.stdout.readline().startswith("ready vehicle_id=hunter01")
        with harness.start_edge(listen, policy):
            options = ["--clock", "realtime"]
            report = harness.simulate(tmp_path, simulator, harness.SHORT_TOY, options)
            assert ask(listen, "hunter01", "status")["accepted"] > 10
        relay.process.terminate()
        assert relay.wait() == 0, relay.errors
    counts = harness.read(out)
    json.dumps(counts, allow_nan=False)
    states, commands, _, health = counts["topics"].values()
    assert report["latency_ms"]["p50"] > 75
    assert report["latency_spec"] == "none"
    assert commands["received"] > 10
    found = (states["lost"], states["duplicated"], health["delivered"])
    assert min(*found, report["rejected_by_edge"].get("duplicate", 0)) > 0
    assert counts["queries"]["status"] >= 2  # The simulator's, before and after the drive.
    assert counts["latency_spec"] == "delay=40ms,jitter=5ms,loss=10%,duplicate=10%"
    assert "delivered: state" in relay.output
