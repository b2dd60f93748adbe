"""A robot's own senses: what is let through, what stops the vehicle, and that nothing holds it."""

import contextlib
import signal
import subprocess
import sys
from typing import Any

import msgspec
import numpy as np
import pytest
from hil_tests.processes import Process, wait_until
from hil_tests.tests.shared.commands import call
from hil_tests.tests.shared.drives import make_policy, run_edge
from hil_tests.tests.shared.policies import PEDAL, ROVER, SHAPE, TASK, T, write_policy
from hypothesis import example, given
from hypothesis import strategies as st

from edge_runtime.controller import Controller, ControllerConfig, Received, shared_limits
from edge_runtime.latest import LatestState
from edge_runtime.link import ask
from edge_runtime.manifest import Entry, Layout
from edge_runtime.policy import load_manifest
from edge_runtime.reach import free_endpoint
from edge_runtime.safety import Mode
from edge_runtime.sense import (
    FROZEN_PERIODS,
    GIVES_UP_S,
    Intake,
    Seen,
    SourceError,
    _Source,
    look,
)
from edge_runtime.util import UserError
from edge_runtime.wire import DRIVE, encode

LIMITS = shared_limits([PEDAL], {})
LAYOUT = Layout(TASK)
BASE_S = 0.02 * T  # of the link, at least
OLDEST_S = T + 2.2 * T + BASE_S
"""A source may be T late in every state, and the edge runtime answers 2.2 T above the quickest."""


class Says:
    """A source that says what a test has put into it."""

    def __init__(self, seen: Any, **offers: Any) -> None:
        self.seen = seen
        self.__dict__.update(offers)

    def observe(self) -> Any:
        if isinstance(self.seen, Exception):
            raise self.seen
        return self.seen


ROVER_TASK = msgspec.structs.replace(TASK, observation=ROVER)
GOOD = {
    "camera": np.ones((4, 6, 3), np.uint8), "ranges": np.array([1.0, 2.0]), "lit": np.True_,
}  # fmt: skip


def test_an_observation_goes_out_as_the_manifest_has_it_with_what_the_source_offers():
    seen = look(Says(GOOD, speed_mps=lambda: np.float32(0.5), episode_over=1), ROVER_TASK)
    arrays = Layout(ROVER_TASK).arrays(seen.observation)
    assert {name: array.dtype.name for name, array in arrays.items()} == {
        "camera": "uint8", "ranges": "float32", "lit": "bool",
    }  # fmt: skip
    assert (arrays["camera"] == 1).all()
    assert arrays["ranges"].tolist() == [1.0, 2.0]
    assert (seen.speed_mps, seen.episode_over) == (0.5, True)
    assert look(Says(GOOD), ROVER_TASK)[1:] == (None, False)


@pytest.mark.parametrize(
    "seen",
    [
        None,
        np.ones(SHAPE),
        {name: GOOD[name] for name in ("camera", "lit")},
        {**GOOD, "more": 1},
        {**GOOD, "camera": np.ones((4, 6), np.uint8)},
        {**GOOD, "camera": np.ones((4, 6, 3), np.int64)},
        {**GOOD, "camera": np.ones((4, 6, 3))},
        {**GOOD, "ranges": np.array([1, 2])},
        {**GOOD, "ranges": ["a", "b"]},
        {**GOOD, "lit": 1},
    ],
)
def test_what_is_not_the_manifests_is_no_observation(seen):
    with pytest.raises(SourceError):
        look(Says(seen), ROVER_TASK)


@pytest.mark.parametrize(
    ("ranges", "speed_mps"),
    [([1.0, np.nan], 0.0), ([np.inf, 1.0], 0.0), ([1e300, 1.0], 0.0), ([1.0, 2.0], np.nan)],
)
def test_what_is_not_finite_is_never_sent(ranges, speed_mps):
    seen = look(Says({**GOOD, "ranges": np.array(ranges)}, speed_mps=speed_mps), ROVER_TASK)
    intake = Intake(ROVER_TASK, "s", 0)
    with pytest.raises(SourceError):
        intake.take(seen, 1.0, 1.0)


def picture(number: int) -> dict[str, bytes]:
    return {"frames": bytes([number % 256]) * LAYOUT.size}


def test_a_state_is_stamped_when_the_source_was_asked_and_an_episode_ends_as_it_says():
    intake, found = Intake(TASK, "s", zero_ns=10**18), list[Any]()
    for number, over in enumerate([False, True, False]):
        seen = Seen(picture(number), None, over)
        found.append(intake.take(seen, number * T, number * T + 0.5 * T))
    assert [(s.episode, s.step, s.final) for s in found] == [
        (0, 0, False), (0, 1, True), (1, 0, False),
    ]  # fmt: skip
    assert [s.sent_ns - 10**18 for s in found] == [0, 100_000_000, 200_000_000]
    assert {s.session for s in found} == {"s"}


def sent(ages: list[float], pictures: list[int]) -> list[bool]:
    """Whether a state comes of each answer of these ages (in T) and pictures, until it fails."""
    intake, now_s, found = Intake(TASK, "s", 0), 100.0, list[bool]()
    for age, number in zip(ages, pictures):
        asked_s, now_s = now_s, now_s + age * T
        try:
            found.append(intake.take(Seen(picture(number)), asked_s, now_s) is not None)
        except SourceError:
            break
    return found


def test_one_slow_answer_is_borne_and_a_second_or_a_late_one_is_not_sent():
    assert sent([1.0, 2.2, 1.0, 2.2, 0.0], [*range(5)]) == [True] * 5
    assert sent([1.0, 1.1, 1.1, 1.0, 1.1], [*range(5)]) == [True, True, False, True, True]
    assert sent([0.0, 2.21, 1.1, 0.0], [*range(4)]) == [True, False, False, True]
    assert sent([1.1, 1.1, 1.0, 1.1], [*range(4)]) == [False, False, True, True]


def test_pictures_that_stay_the_same_are_frozen():
    still = [0] * (2 * FROZEN_PERIODS)
    assert sent([0.1] * len(still), still) == [True] * FROZEN_PERIODS
    twice = [number // 2 for number in range(20)]
    assert sent([0.1] * 20, twice) == [True] * 20
    numbers = msgspec.structs.replace(TASK, observation={"x": Entry(dtype="float32", shape=[1])})
    intake = Intake(numbers, "s", 0)  # a robot that stands may measure the same for hours
    for _ in range(3 * FROZEN_PERIODS):
        assert intake.take(Seen({"x": bytes(4)}), 1.0, 1.0)


KINDS = ("good", "raises", "nan", "shape", "over", "same")
CALLS = st.tuples(
    st.integers(1, 8),  # so often, with
    st.one_of(st.floats(0.0, 1.0), st.floats(0.9, 2.4), st.sampled_from([1.0, 2.0, 2.2, 50.0])),
    st.sampled_from((*KINDS[:1] * 20, *KINDS)),
    st.one_of(st.just(0.0), st.floats(-0.3, 0.3), st.floats(-2.0, 2.0)),  # more time on the link
)


class Story:
    """A source, `Intake` and the edge runtime's real controller in one thread and one time."""

    def __init__(self, needs_rearm: bool) -> None:
        config = ControllerConfig(LIMITS, T, needs_rearm=needs_rearm, task=TASK.text)
        self.controller, self.latest = Controller(config), LatestState(T)
        self.now_s, self.arrived_s = 1000.0, 0.0
        self.needs_rearm, self.stopped = needs_rearm, False
        self.taken_s: dict[Any, float] = {}
        self.drives: list[tuple[float, Any]] = []

    def source(self, session: str, calls: Any) -> None:
        """Live through a session until the source fails, or the calls are over."""
        intake, number, link = Intake(TASK, session, 0), 0, 0.0
        each = (call[1:] for call in calls for _ in range(call[0]))
        measured = False  # whether there was a state, not final, above whose lag all others are
        for age, kind, more in each:
            link = max(0.0, link + more) if measured else 0.0
            begun_s = self.now_s
            if age * T > GIVES_UP_S:
                return
            try:
                number += kind != "same"
                seen = self.says(kind, number)
                state = intake.take(seen, begun_s, begun_s + age * T)
            except (SourceError, ValueError):
                return
            self.now_s = begun_s + max(age, 1.0) * T
            if state is None:
                continue
            measured |= not state.final
            self.taken_s[state.session, state.episode, state.step] = begun_s
            # In order, as on TCP.
            arrives_s = max(begun_s + (age + link) * T + BASE_S, self.arrived_s)
            self.arrive(encode(state), arrives_s)
        self.rest(self.now_s)

    def says(self, kind: str, number: int) -> Seen:
        if kind == "raises":
            raise ValueError
        frames = np.full(SHAPE if kind != "shape" else (2, 45, 81), number % 256, np.uint8)
        speed_mps = np.nan if kind == "nan" else 0.5
        said = Says({"frames": frames}, episode_over=kind == "over", speed_mps=speed_mps)
        return look(said, TASK)

    def arrive(self, payload: bytes, arrived_s: float) -> None:
        self.rest(arrived_s)
        self.arrived_s = arrived_s
        state: Any = LAYOUT.decode(payload)
        assert LAYOUT.refusal(state.observation) is None
        assert np.isfinite(state.speed_mps)
        if self.latest.offer(state, arrived_s) is not None:
            return
        self.controller.begin(Received(state, arrived_s, round(arrived_s * 1e9)), arrived_s)
        answer = np.array([0.5], np.float32)
        self.note(self.controller.finish(answer, 0, arrived_s), arrived_s)

    def rest(self, until_s: float) -> None:
        while (due_s := self.controller.next_deadline_s()) is not None and due_s < until_s:
            due_s = max(due_s, self.arrived_s) + 1e-9
            self.note(self.controller.tick(due_s), due_s)

    def note(self, order: Any, now_s: float) -> None:
        self.stopped |= self.controller.safety.mode is Mode.SAFE_STOP
        if order is not None and order.mode == DRIVE:
            assert not (self.needs_rearm and self.stopped), "it drives on without a re-arm"
            state = order.answers.state
            place = state.session, state.episode, state.step
            assert now_s - self.taken_s[place] <= OLDEST_S + 1e-6, "it acts on the past"
            self.drives.append((now_s, place))


@example([[(8, 2.0, "good", 0.0), (16, 2.0, "good", 0.15)]], False)  # slow in each, and ever later
@example([[(5, 2.0, "good", 1.0), (4, 0.0, "good", 0.0), (1, 1.0, "good", 0.0)]], False)
@example([[(1, 15.0, "good", 0.0)]], False)
@example(  # the first state above whose lag the others are is a slow one
    [[(1, 0.5, "good", 0.0), (1, 0.0, "over", 0.0), (3, 2.0, "good", 1.5), (6, 0.0, "good", 0.0)]],
    False,
)
@given(st.lists(st.lists(CALLS, max_size=12), min_size=1, max_size=3), st.booleans())
def test_nothing_but_a_stop_follows_what_is_too_old_or_wrong(sessions, needs_rearm):
    story = Story(needs_rearm)
    for number, calls in enumerate(sessions):
        before, another = len(story.drives), bool(story.taken_s)
        story.source(f"session-{number}", calls)
        # Whatever ended it: nothing comes any more, and so it stands.
        story.rest(story.now_s + 200 * T)
        assert story.controller.safety.mode is not Mode.DRIVE
        if needs_rearm and another:
            assert len(story.drives) == before, "another session drove without a re-arm"
        story.now_s += 200 * T


SOURCE = """
import pathlib, threading, time
import numpy as np

here = pathlib.Path(__file__).parent  # a thread that hangs outlives its test, and its folder

class Source:
    speed_mps = 0.3

    def __init__(self):
        self.random = np.random.default_rng(0)
        threading.Thread(target=threading.Event().wait).start()  # no daemon: it holds the exit

    def observe(self):
        word = (here / "word").read_text()
        if word == "raises":
            raise OSError("no such\\ncamera")
        if word == "hangs":
            (here / "hanging").touch()
            threading.Event().wait()
        if word == "late":
            time.sleep(0.4)
        return {"frames": self.random.integers(0, 99, (2, 45, 80), np.uint8)}

    def episode_over(self):
        return (here / "word").read_text() == "over"

class Later(Source):
    count = 0  # the first observation is good

    def __init__(self):
        self.random = np.random.default_rng(0)

    def observe(self):
        self.count += 1
        if self.count == 2:
            (here / "word").write_text((here / "then").read_text())
        return super().observe()

class Few(Later):  # one state in time, one too late, and then nothing that can be read
    def observe(self):
        self.count += 1
        time.sleep(0.4 * (self.count == 3))
        return Source.observe(self) if self.count < 4 else 7

def broken():
    raise RuntimeError("no device")
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "my_source.py").write_text(SOURCE)
    (tmp_path / "word").write_text("")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def sense(policy: Any, endpoint: str, source: str = "my_source:Source") -> Process:
    words = ("--source", source, "--policy", str(policy), "--allow-unsigned")
    return Process("edge_runtime", "sense", *words, "--listen", endpoint, ready="ready ")


def test_a_source_drives_a_vehicle_until_it_fails_and_then_only_a_rearm_does(folder):
    policy, endpoint = make_policy(folder, "constant"), free_endpoint()
    trust, stops = ("--policy", str(policy), "--allow-unsigned", "--vehicle", "mock"), 0
    with run_edge(*trust, "--connect", endpoint) as edge:
        for word, why in (("raises", "OSError: no such camera"), ("", "killed")):
            (folder / "word").write_text("")
            with sense(policy, endpoint) as source:

                def drives(source=source):
                    with contextlib.suppress(UserError):  # no runtime has connected yet
                        if ask(endpoint, "hunter01", "status")["needs_rearm"]:
                            ask(endpoint, "hunter01", "rearm")
                    return source.output.rstrip().endswith("says drive")

                wait_until(drives, "a drive", poll_s=0.2)
                (folder / "word").write_text(word)
                if why == "killed":
                    source.kill()
                else:
                    assert source.wait(5.0) == 1
                    (line,) = source.errors.splitlines()
                    assert why in line
            stops += 1

            def stopped(stops=stops):
                return edge.errors.count("reason=no_fresh_state") >= stops

            wait_until(stopped, "a stop")
    assert edge.errors.count("reason=other_session") == 1  # the second found it waiting


def test_an_end_that_the_source_tells_is_no_fault(folder):
    policy, endpoint = make_policy(folder, "constant"), free_endpoint()
    trust = ("--policy", str(policy), "--allow-unsigned")
    with run_edge(*trust, "--connect", endpoint) as edge, sense(policy, endpoint) as source:
        edge.wait_for_line("now=drive")
        (folder / "word").write_text("over")
        edge.wait_for_line("now=standby")
        assert not source.has_ended


def test_what_cannot_begin_is_refused(folder, capsys, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "my_source", raising=False)
    policy = make_policy(folder)
    for source in ("my_source:Nobody", "nowhere:Source", "my_source"):
        words = ("sense", "--source", source, "--policy", policy, "--allow-unsigned")
        found, out, err = call(capsys, *words, package="bridge")
        assert (found, out, len(err.splitlines())) == (2, "", 1)
    with pytest.raises(UserError):
        load_manifest(policy)  # nobody signed it
    words = ("sense", "--source", "my_source:broken", "--policy", policy, "--allow-unsigned")
    listen = ("--listen", free_endpoint())
    found, _, err = call(capsys, *words, *listen, package="edge_runtime")
    assert found == 1
    assert "no device" in err


def test_what_is_too_old_is_said_and_what_cannot_be_read_ends_it(folder, capsys, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "my_source", raising=False)
    words = ("sense", "--source", "my_source:Few", "--policy", make_policy(folder))
    listen = ("--allow-unsigned", "--listen", free_endpoint())
    found, out, err = call(capsys, *words, *listen, package="bridge")
    assert (found, out.count("too old"), len(err.splitlines())) == (1, 1, 1)
    assert "int, not frames" in err


@pytest.mark.parametrize("word", ["late", "hangs"])
def test_a_source_that_no_longer_answers_in_time_ends_it(word, folder, capsys, monkeypatch):
    monkeypatch.setattr("edge_runtime.sense.GIVES_UP_S", 0.5)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "my_source", raising=False)
    (folder / "then").write_text(word)
    words = ("sense", "--source", "my_source:Later", "--policy", make_policy(folder))
    listen = ("--allow-unsigned", "--listen", free_endpoint())
    found, _, err = call(capsys, *words, *listen, package="edge_runtime")
    assert (found, len(err.splitlines())) == (1, 1)
    assert "too slow" in err


def test_an_interrupt_while_a_source_is_imported_is_one(folder, capsys, monkeypatch):
    (folder / "interrupted.py").write_text("raise KeyboardInterrupt")
    monkeypatch.syspath_prepend(folder)
    words = ("--source", "interrupted:Source", "--policy", make_policy(folder), "--allow-unsigned")
    assert call(capsys, "sense", *words, package="edge_runtime")[0] == 130


def test_a_source_that_is_imported_takes_no_signal_away(folder, capsys, monkeypatch):
    (folder / "deaf.py").write_text("import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)")
    monkeypatch.syspath_prepend(folder)
    before = signal.getsignal(signal.SIGINT)
    words = ("--source", "deaf:Source", "--policy", make_policy(folder), "--allow-unsigned")
    try:
        assert call(capsys, "sense", *words, package="edge_runtime")[0] == 2  # there is no Source
        assert signal.getsignal(signal.SIGINT) == before
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_source_that_never_begins_is_waited_for_and_said_to_be(folder, capsys, monkeypatch):
    answers = iter([None, None])

    def answer(*_):
        for each in answers:
            return each
        raise KeyboardInterrupt

    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "my_source", raising=False)
    monkeypatch.setattr(_Source, "answer", answer)
    words = ("--source", "my_source:Few", "--policy", make_policy(folder), "--allow-unsigned")
    listen = ("--listen", free_endpoint())
    status, out, _ = call(capsys, "sense", *words, *listen, package="edge_runtime")
    assert (status, out.count("waiting")) == (130, 2)


def test_a_hanging_source_holds_no_signal(folder):
    policy, endpoint = make_policy(folder), free_endpoint()
    (folder / "word").write_text("hangs")
    words = ("--source", "my_source:Source", "--policy", str(policy), "--allow-unsigned")
    with Process("edge_runtime", "sense", *words, "--listen", endpoint) as source:
        wait_until((folder / "hanging").exists, "the source to hang")
        assert not source.has_ended  # a camera may take long to open
        source.send(signal.SIGINT)
        assert source.wait(3.0) == 130


def test_a_policy_of_another_task_ends_it(folder):
    mine, endpoint = make_policy(folder), free_endpoint()
    other = folder / "other.onnx"
    write_policy(other, manifest_changes={"task": "another"})
    with run_edge("--policy", str(other), "--allow-unsigned", "--connect", endpoint):
        with sense(mine, endpoint) as source:
            assert source.wait(5.0) == 2
        assert "another task" in source.errors


def test_it_needs_the_boards_libraries_alone():
    code = "import edge_runtime.sense, sys; print(*{name.split('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
    assert not {"bridge", "gymnasium", "onnxruntime", "torch", "PIL", "mcap"} & {*loaded.split()}
