"""``trainer train --rerun``: what is drawn, what it may not change, and that nobody waits."""

import math
import subprocess
import sys
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import cast, get_args

import msgspec
import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader

from bridge.rerun import APPLIED, HUMAN, POLICY, Sink
from bridge.tests.viewers import in_place
from edge_runtime.cli import run_cli
from trainer.__main__ import main
from trainer.drivers import make_environment
from trainer.human.guide import Intervention, Reason
from trainer.learner.config import LearnerConfig
from trainer.learner.networks import Critic
from trainer.person.recording import Recorder, read_steps
from trainer.person.tests.people import record, recorded_step
from trainer.pictures import CURVE_FILE
from trainer.training.config import RunConfig
from trainer.training.metrics import NAMES, EpisodeMetrics, read_metrics
from trainer.training.run import Seen, TrainingRun
from trainer.view import (
    CORRECTIONS,
    DRIVERS,
    LINES,
    MOST_WAITING,
    STEPS_TOGETHER,
    Background,
    Entry,
    Episode,
    Shown,
    Steps,
    TrainingLog,
    Watcher,
    q_advantage,
    watched,
)

ROOT = Path(__file__).parents[2]
TINY = RunConfig(
    seed=3,
    episodes=1,
    evaluate_every_steps=1,
    evaluation_runs=1,
    threads=1,
    learner=LearnerConfig(batch_size=4, replay_capacity=2000, warmup_steps=60),
)
QUICK = ["--episodes", "1", "--threads", "1", "--set", "evaluate_every_steps=0",
         "--set", "warmup_steps=100000"]  # fmt: skip
"""Options of a run that learns nothing."""
TIMINGS = [name for name in NAMES if name.endswith("_s")]


def values_in(rrd):
    """What was logged, by entity: a list of (step or None, value)."""
    found: dict[str, list[tuple[int | None, object]]] = {}
    for chunk in RrdReader(str(rrd)).stream().to_chunks():
        columns = chunk.to_record_batch().to_pydict()
        steps = columns.get("step", [None] * chunk.num_rows)
        for name, values in columns.items():
            if name in ("Scalars:scalars", "StateChange:state"):
                rows = found.setdefault(chunk.entity_path, [])
                rows += [(step, value[0]) for step, value in zip(steps, values, strict=True)]
            elif name not in ("step", "rerun.controls.RowId"):
                found.setdefault(chunk.entity_path, [])
    return {path: sorted(rows, key=lambda row: row[0] or 0) for path, rows in found.items()}


def weights(run):
    learner = run.learning.learner
    return torch.cat([p.detach().flatten() for m in (learner.actor, learner.critics)
                      for p in m.parameters()])  # fmt: skip


def train(directory, rrd=None):
    directory.mkdir()
    run = TrainingRun(TINY, directory)
    if rrd is None:
        run.train()
    else:
        with watched(run, Sink("save", str(rrd))) as on_episode:
            run.train(on_episode)
    return run


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A small run with the view, and what the view holds."""
    folder = tmp_path_factory.mktemp("shown")
    torch.set_num_threads(1)
    return train(folder / "run", folder / "run.rrd"), values_in(folder / "run.rrd")


def test_a_run_that_is_watched_learns_the_same(shown, tmp_path, one_thread):
    run, _ = shown
    alone = train(tmp_path / "alone")
    assert torch.equal(weights(run), weights(alone))
    rows = [read_metrics(each.run_dir) for each in (run, alone)]
    for row in (*rows[0], *rows[1]):
        for name in TIMINGS:
            del row[name]
    assert rows[0] == rows[1]


def test_the_view_holds_the_run(shown):
    run, found = shown
    metrics = read_metrics(run.run_dir)
    steps = run.learning.added
    assert [step for step, _ in found["/action/applied"]] == list(range(steps))
    assert [step for step, _ in found["/speed/ego"]] == list(range(steps))
    ends = np.cumsum([int(row["steps"]) for row in metrics]) - 1
    for path, column in (
        ("/return/episode", "episode_return"),
        ("/priority/human", "human_priority"),
        ("/priority/policy", "policy_priority"),
        ("/loss/critic", "critic_loss"),
        ("/success/validation", "validation_success"),
    ):
        expected = {
            int(end): float(row[column])
            for end, row in zip(ends, metrics, strict=True)
            if row[column] != "nan"
        }
        assert dict(found[path]) == pytest.approx(expected), path
    pictures = ("/frames/now", "/frames/before", "/road/ego/body", "/road/traffic/body",
                "/road/roads", "/status")  # fmt: skip
    assert [path for path in pictures if path not in found] == []


def test_interventions_are_on_the_time_line_with_their_reasons(shown):
    run, found = shown
    replay = run.learning.replay
    human = replay._human[: run.learning.added]
    told = dict(found["/driver"])
    driver = "policy"
    for step, acted in enumerate(human):
        driver = told.get(step, driver)
        assert driver in (("collision", "stuck") if acted else ("policy",)), step
    assert {"policy", "collision"} <= set(told.values())
    corrected = [step for step, _ in found["/advantage/of_the_human"]]
    assert corrected
    assert all(human[step] for step in corrected)


def test_on_the_time_line_policy_and_human_have_their_colours_of_every_view():
    assert {"policy": POLICY, **dict.fromkeys(get_args(Reason), HUMAN)} == DRIVERS
    assert (LINES["action/policy"], LINES["action/applied"]) == (POLICY, APPLIED)


def test_the_q_advantage_is_the_critics():
    torch.manual_seed(1)
    critic = Critic()
    frames = np.random.default_rng(1).integers(0, 255, (2, 45, 80), dtype=np.uint8)
    policy, human = np.array([-0.5], np.float32), np.array([0.75], np.float32)
    batch = torch.from_numpy(frames)[None]
    with torch.no_grad():
        expected = critic(batch, torch.tensor([[0.75]])) - critic(batch, torch.tensor([[-0.5]]))
    found = q_advantage(critic, Seen(frames, policy, None, human, speed_mps=0.0))
    assert found == pytest.approx(float(expected), abs=1e-6)
    assert found != 0.0


def looking_on(kept):
    learner = SimpleNamespace(target_critics=SimpleNamespace(first=Critic()))
    run = SimpleNamespace(
        learning=SimpleNamespace(added=40, learner=learner),
        env=SimpleNamespace(scene=lambda: {"roads": []}),
    )
    return Watcher(cast(TrainingRun, run), kept.append)


def control_period(human):
    action = np.array([0.5], np.float32)
    intervention = Intervention(action, "collision", first=True) if human else None
    return Seen(np.zeros((2, 45, 80), np.uint8), -action, intervention, action, speed_mps=3.0)


def test_pictures_are_at_most_ten_a_second_and_numbers_are_whole(monkeypatch):
    kept: list[Entry] = []
    now_s = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    watcher = looking_on(kept)
    for _ in range(1000):  # Two seconds at 500 steps a second.
        watcher.on_step(control_period(human=False))
        now_s[0] += 0.002
    watcher.on_episode(metrics_of(1000))
    steps = [entry.step for part in kept if isinstance(part, Steps) for entry in part.entries]
    assert steps == list(range(40, 1040))
    assert all(len(part.entries) <= STEPS_TOGETHER for part in kept if isinstance(part, Steps))
    pictures = [part for part in kept if isinstance(part, Steps) and part.frames is not None]
    assert len(pictures) == pytest.approx(20, abs=2)


def test_an_episode_that_is_broken_off_is_handed_over():
    kept: list[Entry] = []
    watcher = looking_on(kept)
    for _ in range(7):
        watcher.on_step(control_period(human=False))
    watcher.hand_over()
    assert sum(len(part.entries) for part in kept if isinstance(part, Steps)) == 7


def metrics_of(steps):
    numbers = dict.fromkeys(NAMES, math.nan)
    return EpisodeMetrics(**{**numbers, "steps": steps, "episode": 0, "outcome": "goal"})


@pytest.mark.parametrize("human_steps", [0, 1, CORRECTIONS, CORRECTIONS + 1, 500])
def test_corrections_are_spread_over_the_episode(human_steps):
    kept: list[Entry] = []
    watcher = looking_on(kept)
    for _ in range(human_steps):
        watcher.on_step(control_period(human=True))
    watcher.on_episode(metrics_of(max(human_steps, 1)))
    episode = kept[-1]
    assert isinstance(episode, Episode)
    assert len(episode.corrections) <= CORRECTIONS
    assert (episode.critic is None) == (human_steps == 0)
    if human_steps:
        steps = [step for step, _ in episode.corrections]
        assert (steps[0], len(set(np.diff(steps)))) == (40, min(len(steps) - 1, 1))
        assert len(steps) >= min(human_steps, CORRECTIONS // 2)


def test_a_slow_view_holds_nobody_up():
    drawn, go_on = [], threading.Event()

    def draw(entry):
        go_on.wait(10.0)
        drawn.append(entry)

    background = Background(lambda: nullcontext(draw))
    entries = [Steps([]) for _ in range(MOST_WAITING + 100)]
    for entry in entries:
        background.put(entry)
    assert background.dropped in (99, 100)  # One may be in its hands already.
    go_on.set()
    background.close()
    assert drawn == entries[: len(drawn)]
    assert len(drawn) + background.dropped == len(entries)


class PanicError(BaseException):
    """As pyo3's, of which rerun is made: no Exception."""


@pytest.mark.parametrize("error", [OSError("disk full"), PanicError("disk full")])
def test_a_view_that_fails_does_not_end_the_run(capsys, error):
    def draw(_entry):
        raise error

    background = Background(lambda: nullcontext(draw))
    for _ in range(3):
        background.put(Steps([]))
    background.close()
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "viewer gone; the run is unharmed: disk full"


@pytest.mark.parametrize("word", ["spawn", "serve"])
@pytest.mark.parametrize("kind", ["ends at once", "is killed", "never listens"])
def test_a_training_outlives_its_viewer(kind, word, tmp_path, capfd, monkeypatch, one_thread):
    drawn = TrainingLog._draw_episode

    def draw_late(self, episode):
        time.sleep(1.5)  # By then it is gone.
        drawn(self, episode)

    monkeypatch.setattr(TrainingLog, "_draw_episode", draw_late)
    out = tmp_path / "run"
    with in_place(kind, tmp_path, monkeypatch):
        assert run_cli(main, ["train", "--rerun", word, "--out", str(out), *QUICK]) == 0
    said = capfd.readouterr().err
    assert said.count("viewer gone; the run is unharmed: ") == 1
    assert "Traceback" not in said
    assert (out / CURVE_FILE).exists()


def test_a_training_is_not_held_up_by_a_viewer_that_hangs(tmp_path, monkeypatch, one_thread):
    out = tmp_path / "run"
    with in_place("hangs", tmp_path, monkeypatch):
        assert main(["train", "--rerun", "serve", "--out", str(out), *QUICK]) == 0
    assert (out / CURVE_FILE).exists()


def test_rerun_is_loaded_only_when_it_is_asked_for(tmp_path):
    code = (
        "import sys; from trainer.__main__ import main; main(sys.argv[1:]); "
        "sys.exit('rerun' in sys.modules)"
    )
    command = [sys.executable, "-c", code, "train", "--out", str(tmp_path / "run"), *QUICK]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_command_writes_a_recording(tmp_path, one_thread):
    rrd = tmp_path / "run.rrd"
    assert main(["train", "--rerun", str(rrd), "--out", str(tmp_path / "run"), *QUICK]) == 0
    assert "/return/episode" in values_in(rrd)
    assert [path.name for path in tmp_path.glob("*.rrd*")] == ["run.rrd"]


BRAKED = [0.5] * 5 + [-1.0] * 5 + [0.5] * 5


def drive(directory, seeds=(4, 9), steps=15, sitting_policy=True, scenario="left_turn"):
    """A recorded sitting: the policy wants half throttle, the person brakes from step 5 to 9."""
    env, recorder = make_environment(scenario), Recorder(directory)
    for episode, seed in enumerate(seeds):
        observation, _ = env.reset(seed=seed)
        for number in range(steps):
            action, taken = BRAKED[number], 5 <= number < 10
            frames = observation
            observation, reward, *_ = env.step(np.array([action], np.float32))
            recorder.write(recorded_step(
                recorder.sitting, recorder.index, scenario=scenario, seed=seed, episode=episode,
                step=number, frames=frames.tobytes(), next_frame=observation[1].tobytes(),
                policy_action=0.5 if sitting_policy else None, action=action, human=taken,
                first=number == 5, reward=float(reward), speed_mps=float(env.ego.speed),
                outcome="restarted" if number == steps - 1 else "",
            ))  # fmt: skip
    recorder.close()
    return recorder.path


def test_a_sitting_is_shown_whole(tmp_path, capsys):
    drive(tmp_path / "drives")
    out = tmp_path / "sitting.rrd"
    assert main(["view", str(tmp_path / "drives"), "--save", str(out)]) == 0
    assert capsys.readouterr().out == "2 episodes, 30 steps, 10 of them the person's\n"
    found = values_in(out)
    assert [value for _, value in found["/action/applied"]] == 2 * BRAKED
    assert {value for _, value in found["/action/policy"]} == {0.5}
    assert found["/driver"] == [
        (0, "policy"), (5, "person"), (10, "policy"), (20, "person"), (25, "policy"),
    ]  # fmt: skip
    assert [step for step, _ in found["/return/episode"]] == [14, 29]
    assert {"/road/ego/body", "/road/roads", "/frames/now"} <= set(found)
    assert "/loss/critic" not in {path for path, rows in found.items() if rows}


def test_each_scenario_is_shown_on_its_own_ground(tmp_path):
    for scenario in ("left_turn", "left_turn", "congestion"):
        drive(tmp_path / "drives", seeds=(4,), steps=6, scenario=scenario)
    out = tmp_path / "both.rrd"
    assert main(["view", str(tmp_path / "drives"), "--save", str(out)]) == 0
    chunks = [c for c in RrdReader(str(out)).stream().to_chunks() if c.entity_path == "/road/roads"]
    drawn = [step for chunk in chunks for step in chunk.to_record_batch().to_pydict()["step"]]
    assert sorted(drawn) == [0, 12]


def test_a_road_that_would_be_driven_differently_is_not_made_up(tmp_path):
    steps = list(read_steps(drive(tmp_path)))
    steps[7] = msgspec.structs.replace(steps[7], frames=bytes(7200))
    shown = Shown()
    entries = list(shown.entries([record(tmp_path, steps)]))
    scenes = [entry.scene is not None for entry in entries if isinstance(entry, Steps)]
    assert scenes == [False] * 15 + [True] * 15
    assert shown.without_road == 1


def test_a_person_who_drives_alone_has_no_policy_beside(tmp_path):
    path = drive(tmp_path, seeds=(4,), sitting_policy=False)
    entries = list(Shown().entries([path]))
    steps = [entry.entries[0] for entry in entries if isinstance(entry, Steps)]
    assert all(math.isnan(step.policy_action) for step in steps)
    (episode,) = (entry for entry in entries if isinstance(entry, Episode))
    assert (episode.metrics.human_steps, episode.metrics.interventions) == (5, 1)
    assert episode.metrics.outcome == "restarted"


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["train", "--out", "run", "--rerun", "window"], "neither spawn nor serve"),
        (["train", "--out", "run", "--rerun", "spawn"], "no display"),
        (["train", "--out", "run", "--rerun", "/dev/null/a.rrd"], "/dev/null"),
        (["view", "none", "--save", "a.rrd"], "no recording in none"),
        (["view", "drives"], "no display for a window here"),
        (["view", "drives", "--save", "/dev/null/a.rrd"], "Not a directory"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_made(words, part, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    drive(tmp_path / "drives", seeds=(4,), steps=2)
    assert run_cli(main, words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line
    assert [path.name for path in tmp_path.iterdir()] == ["drives"]
