"""``python -m bridge shadow``: what it reports, and that the drive beside it goes on as without."""

import contextlib
import queue
import threading
import time
from typing import Any

import msgspec
import numpy as np
import pytest

import bridge.shadow
from bridge import ports
from bridge.__main__ import main
from bridge.recording import Recording, heard_of
from bridge.replay import RecordedDrive
from bridge.shadow import Shadow
from bridge.tests.recordings import SILENCE, Hand, bridge_status, heard, rerun
from edge_runtime import wire
from edge_runtime.config import Config
from edge_runtime.policy import Policy, load_policy
from edge_runtime.reach import free_endpoint
from edge_runtime.transport import open_session
from hil_tests.tests.shared.commands import call
from hil_tests.tests.shared.drives import make_policy, read, start_edge
from hil_tests.tests.shared.messages import BLACK, WHITE, frames, make_state
from hil_tests.tests.shared.policies import T, write_rover


@pytest.fixture(autouse=True)
def score(tmp_path_factory, monkeypatch):
    """This process stays as important as it is."""
    path = tmp_path_factory.mktemp("proc") / "oom_score_adj"
    monkeypatch.setattr(bridge.shadow, "OOM_SCORE", path)
    return path


@pytest.fixture
def hand(tmp_path):
    return Hand(tmp_path / "by_hand.mcap")


def shadow(hand, policy, *options):
    """Run the command on a recording written by hand; return its report."""
    hand.close()
    out = hand.path.with_suffix(".json")
    words = ["--from", str(hand.path), "--policy", str(policy), "--allow-unsigned"]
    assert bridge_status(["shadow", *words, "--out", str(out), *options]) == 0
    return read(out)


def test_the_report_tells_how_far_two_policies_are_apart(hand, tmp_path):
    hand.drive(0, 20)
    hand.drive(20, 25, **SILENCE)  # The driving one stands: nothing to compare.
    hand.command(2.6, 24, action=[0.9])  # A second answer to the same state, and
    hand.state(2.61, 23)  # a state that the network repeats
    report = shadow(hand, make_policy(tmp_path, "constant", 0.5))
    assert (report["states"], report["answered"], report["compared"]) == (25, 25, 21)
    assert report["driving_policy_id"] == "p"
    assert len(report["policy_id"]) == 64
    found = report["disagreement"]["pedal"]
    assert found == pytest.approx({"mean": 4.4 / 21, "p95": 0.2, "max": 0.4}, abs=1e-6)
    assert report["would_stop"] == {}
    assert 0.0 < report["inference_ms"]["p50"] <= report["inference_ms"]["p99"]


def test_a_stop_of_its_own_is_told_by_reason_and_ends_as_the_runtimes_would(hand, tmp_path):
    for step in range(20):
        light = WHITE if step == 5 else BLACK
        hand.state(step * T, step, observation=frames(light))
        hand.command(step * T + 0.01, step)
    report = shadow(hand, make_policy(tmp_path, "nan"))
    assert report["would_stop"] == {"output_not_finite": 5}  # Five fresh states, and it drives.
    assert report["compared"] == 15


def test_what_it_answered_is_recorded_and_shown_and_is_no_part_of_the_drive(hand, tmp_path):
    hand.drive(0, 20)
    kept, again, drawn = (tmp_path / name for name in ("kept.mcap", "again.mcap", "shown.rrd"))
    policy = make_policy(tmp_path, "constant", 0.5)
    report = shadow(hand, policy, "--record", str(kept))
    shadow(Hand(tmp_path / "b.mcap"), policy, "--from", str(kept), "--record", str(again))
    for path in (kept, again):  # Of one shadow only
        found: list[Any] = [
            wire.decode_command(each.payload)
            for each in heard_of(Recording(path), "v")
            if each.topic == "shadow"
        ]
        assert {(each.policy_id, *each.action) for each in found} == {(report["policy_id"], 0.5)}
        assert [each.step for each in found] == list(range(20))
    assert {each.command.policy_id for each in RecordedDrive(kept, "v").answers.values()} == {"p"}
    assert main(["view", str(kept), "--save", str(drawn)]) == 0
    entities = rerun("rrd", "stats", str(drawn))
    for path in ("action/shadow", "action/apart", "latency/shadow", "mode/shadow"):
        assert path in entities


def test_what_cannot_be_shadowed_is_refused_and_leaves_no_file(hand, tmp_path, capsys):
    hand.drive(0, 3, start_s=0.0)
    hand.state(0.3, 3, task="another")
    other = Hand(tmp_path / "other.mcap")
    other.state(0.0, 0, task="another")
    for recording in (hand, other):
        recording.close()
    rover, out = tmp_path / "rover.onnx", tmp_path / "out.mcap"
    write_rover(rover)
    policy = make_policy(tmp_path)
    for path, b, part in ((hand, rover, "bytes"), (other, policy, "another")):
        words = ("--from", path.path, "--policy", b, "--allow-unsigned", "--record", out)
        status, _, err = call(capsys, "shadow", *words, package="bridge")
        assert (status, len(err.splitlines())) == (2, 1)
        assert part in err
        assert {path.suffix for path in tmp_path.iterdir()} == {".mcap", ".onnx"}


class Broken(Policy):
    """A policy that fails in a way of its own."""

    kind = ""

    def act(self, observation):
        if self.kind == "hangs":
            threading.Event().wait()
        if self.kind == "raises":
            raise RuntimeError("it raises")
        return np.full(1, np.nan, np.float32)


KINDS = {"hangs": "inference_too_long", "raises": "inference_failed", "nan": "output_not_finite"}


def broken(kind, path):
    return type(kind, (Broken,), {"kind": kind})(*load_policy(path, allow_unsigned=True))


def test_where_memory_ends_the_shadow_ends_before_what_drives(hand, tmp_path, score):
    hand.drive(0, 3)
    shadow(hand, make_policy(tmp_path))
    assert score.read_text() == "1000"


def test_a_network_that_hangs_costs_one_period_and_is_asked_again_when_it_has_ended(tmp_path):
    policy, ends = make_policy(tmp_path), threading.Event()

    class Slow(Policy):
        def act(self, observation):
            ends.wait()
            return super().act(observation)

    beside = Shadow(Slow(*load_policy(policy, allow_unsigned=True)), Config())
    begun_s = time.monotonic()
    for step in range(30):
        if step == 20:
            ends.set()
            thread: Any = beside._thread
            thread.join()
        at_ns = round(step * T * 1e9)
        state = heard("state", wire.encode(make_state(step, sent_ns=at_ns)), at_ns)
        assert len(list(beside.stream([state]))) == 2
    assert time.monotonic() - begun_s < 5 * T
    report = beside.report()
    # The runtime drives again after five fresh states.
    assert (report["answered"], report["would_stop"]) == (10, {"inference_too_long": 24})
    assert len(beside._inferences_ms) == 11


STATES = 300


def drive(port, commands, episode):
    """Drive an episode in lock-step; return the commands as bytes, without their stamps."""
    answers = []
    for step in range(STATES):
        seen = {"observation": frames(step % 200), "final": step == STATES - 1}
        port.publish_state(wire.encode(make_state(step, episode=episode, **seen)))
        answer = commands.get(timeout=30.0)
        stamps = {"episode": 0, "received_ns": 0, "inference_ns": 0, "sent_ns": 0}
        answers.append(wire.encode(msgspec.structs.replace(answer, **stamps)))
    return answers


def test_a_drive_is_the_same_beside_what_hangs_raises_or_answers_nan(tmp_path, monkeypatch):
    """And nothing on the wire is the shadows'."""
    opened, endpoint, said = threading.Semaphore(0), free_endpoint(), []
    commands: queue.Queue[Any] = queue.Queue()

    def keep(sample: Any) -> None:
        said.append(str(sample.key_expr))

    @contextlib.contextmanager
    def open_source(arguments):
        with ports.open_source(arguments) as source:
            opened.release()
            yield source

    policies = {str(tmp_path / kind): kind for kind in KINDS}
    good = make_policy(tmp_path)
    monkeypatch.setattr(bridge.shadow, "open_source", open_source)
    monkeypatch.setattr(bridge.shadow, "load_policy", lambda path, *_: broken(policies[path], good))
    monkeypatch.setattr(ports.WireListener.until_gone, "__defaults__", (0.2,))
    words = ["shadow", "--connect", endpoint, "--policy"]
    threads = [
        threading.Thread(target=main, args=[[*words, path, "--out", f"{path}.json"]])
        for path in policies
    ]
    with ports.open_port(endpoint, "hunter01") as port, start_edge(endpoint, good):
        port.hear("command", lambda payload: commands.put(wire.decode_command(payload)))
        alone = drive(port, commands, episode=0)
        for thread in threads:
            thread.start()
        for _ in threads:
            assert opened.acquire(timeout=30.0)
        with open_session(connect=endpoint, mode="client") as watch:
            keys = watch.declare_subscriber("**", keep)
            time.sleep(0.2)
            assert drive(port, commands, episode=1) == alone
            tokens = {str(r.ok.key_expr) for r in watch.liveliness().get("**") if r.ok}
            keys.undeclare()
    for thread in threads:
        thread.join(30.0)
    assert {token.split("/")[2] for token in tokens} == {"alive", "simulator"}
    assert set(said) == {f"phil/hunter01/{topic}" for topic in ("state", "command", "health")}
    assert said.count("phil/hunter01/command") == STATES
    for path, kind in policies.items():
        report = read(tmp_path / f"{path}.json")
        assert report["states"] == STATES
        assert report["would_stop"] == {KINDS[kind]: STATES}
        assert report["answered"] == (STATES if kind == "nan" else 0)
        assert report["compared"] == 0
