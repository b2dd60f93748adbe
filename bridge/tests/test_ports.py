"""Both ends: what each hears."""

import contextlib
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from bridge import ports
from bridge.environments import say_once
from bridge.messages import Scene, decode_scene
from bridge.ports import ANY_VEHICLE, SimulatorPort, open_listener
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from edge_runtime.wire import TOPICS

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
    for topic in ("command", "feedback"):
        put_wildly(client, topic)
    time.sleep(HEARS_S)
    port.close()
    assert heard == [b"own"] * 2


@pytest.mark.parametrize("scene", [None, [], {"vehicles": [object()]}])
def test_an_environment_that_cannot_be_shown_drives_on(capsys, scene):
    """What is wrong is said once, not at each step."""
    say_once.cache_clear()
    render = Mock(side_effect=[OSError("no picture of step 0"), OSError("no picture of step 1")])
    see_through: Any = SimpleNamespace(render_mode="rgb_array", render=render)
    if scene is not None:
        see_through.scene = lambda: scene
    for step in range(2):
        sent = ports.scene_payload(see_through, Scene(episode=0, step=step, sim_time_s=0.1))
        seen = decode_scene(sent)
        assert isinstance(seen, Scene)
        assert (seen.step, seen.picture) == (step, b"")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("the environment cannot be shown: ")


@pytest.mark.parametrize("vehicle_id", ["v1", ANY_VEHICLE])
def test_a_listener_hears_what_was_put_to_one_vehicle(sessions, vehicle_id):
    endpoint, router, client = sessions
    port = SimulatorPort(router, "v1")
    topics = ("state", "command", "feedback", "health")
    wild = [client.liveliness().declare_token(name) for name in ("phil/**", "phil/*/alive")]
    with open_listener(endpoint, vehicle_id, 5.0) as feed:
        for topic in topics:
            put_wildly(client, topic)
        client.put("phil/v2/state", b"other")
        time.sleep(HEARS_S)
        heard = iter(lambda: feed.next(0.1), None)
        all_heard = list(heard)
        found = {(one.key, one.payload) for one in all_heard if one.topic in TOPICS}
    assert not [one.key for one in all_heard if "*" in one.key]
    for token in wild:
        token.undeclare()
    expected = {(f"phil/v1/{topic}", b"own") for topic in topics}
    if vehicle_id == ANY_VEHICLE:
        expected.add(("phil/v2/state", b"other"))
    assert found == expected
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
    command = [sys.executable, "-c", _ANOTHER_THREAD_TAKES_IT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            process.terminate()
            assert process.communicate(timeout=20)[0] == "told\n"
        finally:
            process.kill()
    assert process.returncode == 0
