"""Episodes driven side by side are those driven one after the other."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from edge_runtime.util import UserError
from trainer.__main__ import main
from trainer.drivers import BEST_FILE, OnnxDriver, load_actor, load_driver, make_environment
from trainer.evaluate import (
    WORTH_STARTING,
    choose_jobs,
    drive_episodes,
    drive_episodes_in_parallel,
    drive_together,
)
from trainer.evaluate import cores as parallel_cores
from trainer.human.model import HumanModel, HumanModelConfig
from trainer.learner.networks import Actor
from trainer.util import save_torch

POLICY = Path(__file__).parents[2] / "results" / "policies" / "left_turn.onnx"


@pytest.mark.parametrize("frames", [1, 2])
def test_an_actor_is_loaded_with_the_frames_that_it_was_trained_on(tmp_path, frames):
    actor = Actor(frames=frames)
    label = {"scenario": "congestion", "algorithm": "phil_td3", "seed": 0, "episode": 3}
    save_torch(tmp_path / BEST_FILE, {**label, "actor": actor.state_dict()})
    loaded, about = load_actor(tmp_path)
    assert (loaded.picture.frames, about) == (frames, label)
    driver, policy_id = load_driver(str(tmp_path), make_environment("congestion"))
    assert policy_id.startswith("run:")
    assert driver.act(np.zeros((2, 45, 80), np.uint8)).shape == (1,)


@pytest.mark.parametrize(
    "state",
    [
        [1, 2],
        torch.ones(3),
        {"actor": {"picture.trunk.conv1.weight": torch.ones(3), "head.output.bias": torch.ones(1)}},
    ],
    ids=["a list", "a tensor", "wrong shapes"],
)
def test_what_is_no_actor_is_one_line(tmp_path, state):
    save_torch(tmp_path / BEST_FILE, state)
    with pytest.raises(UserError, match="is not a checkpoint of this project"):
        load_actor(tmp_path)


def test_a_policy_file_answers_within_the_domain_as_the_edge_sends_it(monkeypatch):
    driver = OnnxDriver(POLICY)
    beyond = np.array([np.nextafter(np.float32(1.0), np.float32(2.0))])
    monkeypatch.setattr(driver.policy, "act", lambda observation: beyond)
    action = driver.act(np.zeros((2, 45, 80), np.uint8))
    assert (action.dtype, action.tolist()) == (np.float32, [1.0])


@pytest.mark.parametrize("action", ["0", "-1", "0.25"])
def test_one_action_throughout(action):
    driver, policy_id = load_driver(f"constant:{action}", make_environment("congestion"))
    driver.reset()
    answers = [driver.act(np.full((2, 45, 80), shade, np.uint8)) for shade in (0, 255)]
    assert policy_id == f"constant:{action}"
    assert [answer.tolist() for answer in answers] == [[float(action)]] * 2
    assert answers[0].dtype == np.float32


@pytest.mark.parametrize("action", ["", "fast", "nan", "1.5", "-2", "inf"])
def test_an_action_out_of_its_domain_is_one_line(action):
    with pytest.raises(UserError, match="expected an action from -1 to 1"):
        load_driver(f"constant:{action}", make_environment("left_turn"))


class Brightness:
    """A driver without memory whose action follows its pictures."""

    def reset(self):
        """It has no memory."""

    def act(self, observation):
        return self.together(observation[None])[0]

    def together(self, observations):
        means = observations.mean(axis=(2, 3), dtype=np.float64) / 255.0
        return np.tanh(3.0 * (means[:, 1:] - 0.25)).astype(np.float32)


@pytest.mark.parametrize("scenario", ["left_turn", "congestion"])
@pytest.mark.parametrize("condition", ["nominal", "noise"])
@pytest.mark.parametrize("lanes", [1, 3, 8])
def test_side_by_side_is_one_after_the_other(scenario, condition, lanes):
    driver, seeds = Brightness(), range(5)
    wanted = drive_episodes(make_environment(scenario), driver, seeds, condition)
    envs = [make_environment(scenario) for _ in range(lanes)]
    assert drive_together(envs, driver.together, seeds, condition) == wanted


def test_nobody_drives_where_there_is_no_seed():
    assert drive_together([make_environment("left_turn")], Brightness().together, []) == []


@pytest.fixture
def policy(tmp_path):
    """A network of random weights: all of its digits count."""
    model = HumanModel(HumanModelConfig(frames=2), seed=1)
    model.save(tmp_path, {"scenario": "left_turn"})
    return str(tmp_path)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("condition", ["noise", "variant"])
def test_the_results_are_those_of_one_process(policy, condition):
    env = make_environment("left_turn", condition)
    seeds = range(7, 14)
    alone = drive_episodes(env, load_driver(policy, env)[0], seeds, condition)
    seen: list[int] = []
    results = drive_episodes_in_parallel(
        policy, "left_turn", seeds, 2, condition, lambda result: seen.append(result.seed)
    )
    assert results == alone
    assert seen == list(seeds)


def test_a_worker_that_dies_is_said_in_one_line():
    def kill_one(result):
        worker, *_ = multiprocessing.active_children()
        worker.kill()

    with pytest.raises(UserError, match=r"a worker process died after \d+ of 5000 episodes"):
        drive_episodes_in_parallel("expert", "left_turn", range(5000), 2, on_episode=kill_one)
    assert not multiprocessing.active_children()


def test_a_policy_that_is_gone_when_a_worker_looks_is_named(tmp_path):
    gone = str(tmp_path / "gone")
    with pytest.raises(UserError, match="gone is no policy"):
        drive_episodes_in_parallel(gone, "left_turn", range(3), 1)


def workers_of(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in children if is_worker(int(child))]


def is_worker(pid: int) -> bool:
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def wait_until(condition, limit_s: float = 150.0) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.05)


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for children in /proc")
@pytest.mark.parametrize(("sent", "status"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_whatever_ends_the_command_ends_its_workers(sent, status):
    command = ["evaluate", "expert", "--runs", "100000", "--jobs", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "trainer", *command],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        wait_until(lambda: len(workers_of(process.pid)) == 2)
        workers = workers_of(process.pid)
        # To all of them, as a terminal does; while the workers start is the worst moment.
        os.killpg(process.pid, sent) if sent == signal.SIGINT else process.kill()
        _, err = process.communicate(timeout=150)
        assert process.returncode == status
        if sent == signal.SIGINT:
            assert err == "interrupted\n"
        wait_until(lambda: not any(is_worker(worker) for worker in workers))
    finally:
        process.kill()


def test_processes_are_started_only_where_they_pay():
    cores = parallel_cores()
    assert choose_jobs(WORTH_STARTING - 1) == 1
    assert choose_jobs(10 * WORTH_STARTING) == min(cores, 10 * WORTH_STARTING)


def test_the_command_reports_the_same_whatever_the_jobs(policy, tmp_path, capsys):
    reports = []
    for jobs in (1, 2):
        out = tmp_path / f"{jobs}.json"
        arguments = ["evaluate", policy, "--runs", "3", "--jobs", str(jobs), "--out", str(out)]
        assert main(arguments) == 0
        reports.append(out.read_bytes())
    assert reports[0] == reports[1]
